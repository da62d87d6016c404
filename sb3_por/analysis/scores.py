"""The table of scores: one row for each evaluation, read from runs or from ``scores.csv``."""

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_por.analysis.names import METRICS
from sb3_por.common.errors import UserError, UserNote, one_line
from sb3_por.common.files import atomic_write
from sb3_por.runs.facts import control_steps, run_identity
from sb3_por.runs.folder import (
    HYPERPARAMETERS,
    find_runs,
    read_evaluations,
    read_settings,
    run_arguments,
    settings_folder,
)

#: Columns that identify a run, and columns that an evaluation measures.
RUN_KEYS = ["env", "algo", "seed"]
#: Settings in which the seeds of one algorithm may differ: how long they are, and where files were
PER_RUN = ("n_timesteps", "demos")
COLUMNS = [*RUN_KEYS, "step", *METRICS, "wall_clock_s", "commit"]


def read_scores(paths: Iterable[str | Path]) -> pd.DataFrame:
    """
    Read the scores of many runs.

    :param paths: run folders, folders that hold runs at any depth, and ``.csv`` files of scores, in any mixture
    :return: one row for each evaluation with the columns ``COLUMNS``, sorted; a metric that was not recorded is NaN
    :raises UserError: if a path holds no scores, or two runs of one algorithm and environment have one seed
    """
    given = [Path(path) for path in paths]
    tables = [read_csv(path) for path in given if is_table(path)]
    folders = [path for path in given if not is_table(path)]
    runs = find_runs(folders)
    for note in unlike_runs(runs):
        warnings.warn(note, UserNote)
    return join_runs(tables + [read_run(run) for run in runs])


def unlike_runs(runs: Iterable[Path]) -> list[str]:
    """
    :param runs: run folders
    :return: a sentence for each algorithm whose runs have other settings though they count as its seeds, and for each task
        whose runs share an axis of steps that are not the same
    """
    runs = list(runs)
    return _unlike_settings(runs) + _unlike_steps(runs)


def _unlike_settings(runs: Iterable[Path]) -> list[str]:
    settings: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for run in runs:
        identity = run_identity(run)
        one = read_settings(settings_folder(run, identity["env"]) / HYPERPARAMETERS)
        if one:
            settings.setdefault((identity["env"], identity["algo"]), []).append(one)
    notes = []
    for (env, algo), of_runs in settings.items():
        names = {name for one in of_runs for name in one if name not in PER_RUN}
        differ = sorted(name for name in names if any(one.get(name) != of_runs[0].get(name) for one in of_runs))
        if differ:
            notes.append(
                f"the runs of {algo} on {env} count as its seeds, and differ in {', '.join(differ)}: label them apart "
                "(train.py --label NAME, or label: NAME in the run's args.yml)"
            )
    return notes


def _unlike_steps(runs: Iterable[Path]) -> list[str]:
    lengths: dict[str, dict[int, str]] = {}
    for run in runs:
        identity = run_identity(run)
        lengths.setdefault(identity["env"], {}).setdefault(control_steps(run), identity["algo"])
    notes = []
    for env, algos in lengths.items():
        if len(algos) > 1:
            told = ", ".join(f"{n} of {algo}" for n, algo in sorted(algos.items()))
            notes.append(
                f"on {env} an agent's step is not the same number of control steps ({told}): compare runs that hold "
                "actions for as long (ActionRepeat)"
            )
    return notes


def join_runs(tables: list[pd.DataFrame]) -> pd.DataFrame:
    """
    Join tables of different runs.

    :param tables: at least one table, with the columns ``RUN_KEYS`` and step; each run stands in a single table
    :return: all rows, sorted
    :raises UserError: if two runs of one algorithm and environment have one seed
    """
    rows = pd.concat(tables, ignore_index=True)
    rows.attrs.clear()
    runs = pd.concat([table[RUN_KEYS].drop_duplicates() for table in tables])
    doubled = pd.concat([runs[runs.duplicated()], rows[rows.duplicated([*RUN_KEYS, "step"])]])
    if len(doubled):
        env, algo, seed = doubled.iloc[0][RUN_KEYS]
        same = doubled.iloc[:1][RUN_KEYS]
        where = sorted({str(table.attrs["source"]) for table in tables if len(table.merge(same)) and "source" in table.attrs})
        raise UserError(
            f"there are two runs of {algo} on {env} with seed {seed}{': ' if where else ''}{' and '.join(where)}; give one of "
            "them, or label them: train.py --label NAME, or label: NAME in the run's args.yml"
        )
    return rows.sort_values([*RUN_KEYS, "step"], kind="stable", ignore_index=True)


def read_run(run: Path) -> pd.DataFrame:
    """
    Read the scores of one run.

    :param run: a run folder; identity missing in its settings is read from its path, ``<algo>/<env>_<n>``
    :return: its rows of the table of scores, means over the episodes of each evaluation
    :raises UserError: if its evaluations cannot be read
    """
    arrays = read_evaluations(run)
    steps = arrays["timesteps"]
    unknown = np.full(len(steps), np.nan)
    scores = pd.DataFrame(
        {
            **run_identity(run),
            "step": steps.astype(int),
            "normalized_performance": _episode_mean(arrays, "normalized_performance", unknown),
            "return": arrays["results"].mean(axis=1),
            "success": _episode_mean(arrays, "successes", unknown),
            "wall_clock_s": arrays.get("wall_clock_s", unknown),
            "commit": run_arguments(run).get("commit", ""),
        },
        columns=COLUMNS,
    )
    scores.attrs["source"] = str(run)
    return scores


def is_table(path: Path) -> bool:
    """Whether a path names a table, and no folder of runs."""
    return path.suffix.lower() == ".csv"


def read_csv(path: Path) -> pd.DataFrame:
    """
    Read a table of scores.

    :param path: a file that :func:`write_csv` wrote, or one with its columns
    :return: the table
    :raises UserError: if it cannot be read or lacks a column
    """
    scores = read_table(path, COLUMNS, [*RUN_KEYS, "step"], "a table of scores")
    if scores.empty:
        raise UserError(f"{path} holds no scores")
    scores["commit"] = scores["commit"].fillna("")
    for column in ("seed", "step"):
        if not pd.api.types.is_integer_dtype(scores[column]):
            raise UserError(f"{path}: the column {column} must hold integers")
    for column in [*METRICS, "wall_clock_s"]:
        scores[column] = pd.to_numeric(scores[column], errors="coerce")
    scores.attrs["source"] = str(path)
    return scores


def read_table(path: Path, columns: list[str], needed: list[str], what: str) -> pd.DataFrame:
    """
    Read a table of runs, whatever their labels: ``None`` and ``NA`` are names here.

    :param path: A ``.csv`` file
    :param columns: Its columns; those that it lacks are NaN
    :param needed: Columns that it must have
    :param what: Name of such a table, for messages
    :return: The table
    :raises UserError: If it cannot be read, lacks a column, or has a row without an environment or algorithm
    """
    try:
        # Pandas' faster way changes last digits, and with them the lines of a table that is written again
        names = dict.fromkeys(("env", "algo", "commit"), str)
        table = pd.read_csv(path, converters=names, float_precision="round_trip")
    except (OSError, ValueError) as error:
        raise UserError(f"cannot read {path}: {one_line(error)}") from error
    missing = [column for column in needed if column not in table]
    if missing:
        raise UserError(f"{path} has no column {', '.join(missing)}; {what} has {','.join(columns)}")
    for column in ("env", "algo"):
        if (table[column] == "").any():
            raise UserError(f"{path}: a row has no {column}")
    return table.reindex(columns=columns)


def write_csv(scores: pd.DataFrame, path: str | Path) -> None:
    """Write a table of scores; reading it gives the same table."""
    with atomic_write(path) as temporary:
        scores.to_csv(temporary, index=False, columns=COLUMNS)


def _episode_mean(arrays: dict[str, np.ndarray], name: str, otherwise: np.ndarray) -> np.ndarray:
    return arrays[name].astype(float).mean(axis=1) if name in arrays else otherwise
