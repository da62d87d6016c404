"""
Minutes and agent steps until an agent can do a task: the first evaluation at or above a score.

    python benchmarks/time_to_score.py results/demos/scores.csv runs/my_suite ...

The score is 0.8 on PourWater and half of what a trained agent should have on the other tasks (``WANTED``). Minutes are
those of a run's clock, evaluations included: beside other programs they are too many.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_por.analysis.scores import RUN_KEYS, read_scores

DEMOS = Path(__file__).parents[1] / "results" / "demos" / "scores.csv"
#: Task -> score that counts as a beginning
WANTED = {
    "PourWater-v0": 0.8,
    "PourWaterAmount-v0": 0.4,
    "StraightenRope-v0": 0.45,
    "FoldCloth-v0": 0.4,
    "DropFoldCloth-v0": 0.35,
}


def time_to_score(scores: pd.DataFrame) -> pd.DataFrame:
    """
    :param scores: A table of scores
    :return: A row for each run of a task in ``WANTED``: env, algo, seed, wanted, and step and minutes of the first evaluation
        with that score; NaN where none has it
    """
    rows = []
    for run, evaluations in scores[scores["env"].isin(WANTED)].sort_values("step").groupby(RUN_KEYS):
        reached = evaluations[evaluations["normalized_performance"] >= WANTED[run[0]]]
        step, seconds = reached[["step", "wall_clock_s"]].iloc[0] if len(reached) else (np.nan, np.nan)
        rows.append((*run, WANTED[run[0]], step, seconds / 60))
    return pd.DataFrame(rows, columns=[*RUN_KEYS, "wanted", "step", "minutes"])


def main() -> None:
    """Parse the command line and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="*", type=Path, default=[DEMOS], help="tables of scores, or folders of runs")
    table = time_to_score(read_scores(parser.parse_args().paths))
    print(table.to_string(index=False, formatters={name: "{:.0f}".format for name in ("step", "minutes")}))


if __name__ == "__main__":
    main()
