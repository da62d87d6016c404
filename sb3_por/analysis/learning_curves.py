"""Runs laid side by side: what of a table of scores can be compared, and a word on everything that cannot."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pandas as pd

from sb3_por.analysis.scores import RUN_KEYS
from sb3_por.common.errors import UserError

#: Algorithms that see the state: a ceiling for those that see images, not a rival of theirs.
STATE_ALGOS = ("sac",)


def in_order(algos: Iterable[str]) -> list[str]:
    """POR first, then its rivals, then what sees the state: the order of tables, figures, and sides of a comparison."""
    return sorted(set(algos), key=lambda algo: (algo in STATE_ALGOS, "por" not in algo, algo))


class Run(NamedTuple):
    """
    The scores of one run.

    :param steps: of the evaluations that have a score, rising
    :param scores: same shape
    """

    env: str
    algo: str
    seed: int
    steps: np.ndarray
    scores: np.ndarray

    def __str__(self) -> str:
        return f"{self.algo} on {self.env}, seed {self.seed}"


@dataclass
class Grid:
    """
    Runs of algorithms, environments and seeds; cells may be empty, and runs differ in length.

    :param metric: what the scores are
    :param runs: at least one, in order of environment, algorithm and seed
    :param notes: what was left out so far, one sentence each; the methods add to it
    """

    metric: str
    runs: list[Run]
    notes: list[str] = field(default_factory=list)

    @property
    def algos(self) -> list[str]:
        return in_order(run.algo for run in self.runs)

    @property
    def envs(self) -> list[str]:
        return sorted({run.env for run in self.runs})

    def of(self, algo: str | None = None, env: str | None = None) -> list[Run]:
        """The runs of an algorithm, an environment, or both."""
        return [run for run in self.runs if algo in (None, run.algo) and env in (None, run.env)]

    def note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    def table(self, runs: list[Run], what: str) -> tuple[np.ndarray, np.ndarray]:
        """
        :param runs: some of the grid's
        :param what: what they are, for the notes
        :return: every step at which one of the runs was evaluated, as far as all of them go, and the scores of the runs
            there, ``(runs, steps)``, interpolated where a run was not evaluated
        :raises UserError: if the runs have no step in common
        """
        first, last = self._span(runs, what)
        steps = np.unique(np.concatenate([run.steps for run in runs]))
        steps = steps[(steps >= first) & (steps <= last)]
        return steps, np.array([np.interp(steps, run.steps, run.scores) for run in runs])

    def matrix(self, algo: str) -> tuple[np.ndarray, np.ndarray]:
        """
        :return: steps as :meth:`table`, and the algorithm's scores there, ``(seeds, environments, steps)``: as many seeds
            as the environment with the fewest has
        """
        by_env = self._same_number(algo, sorted({run.env for run in self.of(algo)}))
        steps, rows = self.table([run for runs in by_env for run in runs], algo)
        return steps, rows.reshape(len(by_env), -1, len(steps)).swapaxes(0, 1)

    def last(self) -> tuple[int, dict[str, np.ndarray]]:
        """
        :return: the last step that every run has reached, and for each algorithm its scores there, ``(seeds,
            environments)``, over the environments that every algorithm was run on
        :raises UserError: if there is no such environment, or no such step
        """
        envs = [env for env in self.envs if all(self.of(algo, env) for algo in self.algos)]
        if not envs:
            raise UserError("no environment was run with every algorithm; give runs that can be compared")
        for env in set(self.envs) - set(envs):
            missing = [algo for algo in self.algos if not self.of(algo, env)]
            self.note(f"{env} was not run with {' and '.join(missing)}, so comparisons of all algorithms leave it out")
        compared = [run for run in self.runs if run.env in envs]
        step = self._span(compared, "the comparison")[1]
        matrices = {}
        for algo in self.algos:
            by_env = self._same_number(algo, envs)
            matrices[algo] = np.array([[np.interp(step, run.steps, run.scores) for run in runs] for runs in by_env]).T
        return step, matrices

    def _span(self, runs: list[Run], what: str) -> tuple[int, int]:
        """The first and the last step that all of some runs have; a note if one is shorter than others."""
        latest, shortest = max(runs, key=lambda run: run.steps[0]), min(runs, key=lambda run: run.steps[-1])
        first, last = int(latest.steps[0]), int(shortest.steps[-1])
        if first > last:
            raise UserError(f"{what}: the runs have no step in common: {latest} begins at {first}, {shortest} ends at {last}")
        if last < max(run.steps[-1] for run in runs):
            self.note(f"{what}: the runs differ in length, so it ends with the shortest at step {last} ({shortest})")
        return first, last

    def _same_number(self, algo: str, envs: Iterable[str]) -> list[list[Run]]:
        """The algorithm's runs on each environment, the same number everywhere: the first seeds."""
        by_env = {env: self.of(algo, env) for env in envs}
        n_runs = min(map(len, by_env.values()))
        for env, runs in by_env.items():
            if len(runs) > n_runs:
                self.note(f"{algo}: {len(runs)} seeds on {env} but {n_runs} elsewhere, so the first {n_runs} are used")
        return [runs[:n_runs] for runs in by_env.values()]


def read_grid(scores: pd.DataFrame, metric: str = "normalized_performance", step: int | None = None) -> Grid:
    """
    :param scores: a table with the columns env, algo, seed, step, and the metric
    :param metric: name of a column
    :param step: cut the runs off here, and leave out those that end before or begin after; ``None``: as long as they are
    :return: its runs; scores that are NaN or infinite are left out, which is noted
    :raises UserError: if nothing of the metric is recorded, or no run reaches the step
    """
    finite = np.isfinite(scores[metric].astype(float))
    if not finite.any():
        others = [name for name in scores.columns if name not in (*RUN_KEYS, "step", "wall_clock_s", "commit")]
        recorded = [name for name in others if scores[name].notna().any()]
        raise UserError(f"no {metric} is recorded; there is {' and '.join(recorded) or 'no score at all'} (--metric)")
    grid = Grid(metric, [])
    if not finite.all():
        grid.note(f"{(~finite).sum()} of {len(scores)} evaluations have no {metric} and are left out")
    for (env, algo, seed), rows in scores.assign(finite=finite).groupby(RUN_KEYS, sort=True):
        sound = rows[rows["finite"]].sort_values("step")
        run = Run(env, algo, int(seed), sound["step"].to_numpy(), sound[metric].to_numpy(float))
        if not len(sound):
            grid.note(f"{run}: no {metric} at all, so the run is left out")
        elif step is not None and not run.steps[0] <= step <= run.steps[-1]:
            grid.note(f"{run}: evaluated from step {run.steps[0]} to {run.steps[-1]}, not at {step}, so it is left out")
        else:
            grid.runs.append(run if step is None else _cut(run, step))
    if not grid.runs:
        raise UserError(f"no run was evaluated at step {step}; the last evaluation is at step {scores['step'].max()}")
    return grid


def _cut(run: Run, step: int) -> Run:
    """A run up to a step, with its score there, interpolated if it was not evaluated."""
    before = run.steps < step
    last = np.interp(step, run.steps, run.scores)
    return run._replace(steps=np.append(run.steps[before], step), scores=np.append(run.scores[before], last))
