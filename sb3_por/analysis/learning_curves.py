"""Learning curves aligned for comparison, with a note on each run left out."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pandas as pd

from sb3_por.analysis.scores import RUN_KEYS
from sb3_por.common.errors import UserError

#: Algorithms that observe the state. They bound what algorithms on images can reach, and are no rivals of theirs.
STATE_ALGOS = ("sac",)


def sort_algos(algos: Iterable[str]) -> list[str]:
    """Sort algorithms for tables, figures and comparisons: POR first, then its rivals, then those that observe the state."""
    return sorted(set(algos), key=lambda algo: (algo in STATE_ALGOS, "por" not in algo, algo))


class LearningCurve(NamedTuple):
    """
    The scores of one run.

    :param env: environment id
    :param algo: name of the algorithm, or the run's label
    :param seed: seed
    :param steps: environment steps of the evaluations with a score, rising
    :param scores: the scores, same shape
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
    A grid of algorithms, environments and seeds with a learning curve in each cell. Cells may be empty, and curves may
    differ in length.

    :param metric: name of the score
    :param curves: at least one, sorted by environment, algorithm and seed
    :param notes: a sentence on everything left out so far; the methods add to it
    """

    metric: str
    curves: list[LearningCurve]
    notes: list[str] = field(default_factory=list)

    @property
    def algos(self) -> list[str]:
        return sort_algos(curve.algo for curve in self.curves)

    @property
    def envs(self) -> list[str]:
        return sorted({curve.env for curve in self.curves})

    def of(self, algo: str | None = None, env: str | None = None) -> list[LearningCurve]:
        """The curves of an algorithm, an environment, or both."""
        return [curve for curve in self.curves if algo in (None, curve.algo) and env in (None, curve.env)]

    def note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    def table(self, curves: list[LearningCurve], what: str) -> tuple[np.ndarray, np.ndarray]:
        """
        Align curves at every step at which one of them has an evaluation, within the range that all of them cover.

        :param curves: some of the grid's
        :param what: name of this selection, for the notes
        :return: the steps, and the scores there, ``(curves, steps)``, interpolated between evaluations
        :raises UserError: if the curves have no step in common
        """
        first, last = self._span(curves, what)
        steps = np.unique(np.concatenate([curve.steps for curve in curves]))
        steps = steps[(steps >= first) & (steps <= last)]
        return steps, np.array([np.interp(steps, curve.steps, curve.scores) for curve in curves])

    def matrix(self, algo: str) -> tuple[np.ndarray, np.ndarray]:
        """
        Align all curves of an algorithm, with the same number of seeds on each environment: the smallest.

        :return: steps as in :meth:`table`, and the scores there, ``(seeds, environments, steps)``
        """
        by_env = self._same_number(algo, sorted({curve.env for curve in self.of(algo)}))
        steps, rows = self.table([curve for curves in by_env for curve in curves], algo)
        return steps, rows.reshape(len(by_env), -1, len(steps)).swapaxes(0, 1)

    def last(self) -> tuple[int, dict[str, np.ndarray]]:
        """
        Compare at the last step that every curve reaches, over the environments that every algorithm was run on.

        :return: the step, and each algorithm's scores there, ``(seeds, environments)``
        :raises UserError: if there is no such environment, or no such step
        """
        envs = [env for env in self.envs if all(self.of(algo, env) for algo in self.algos)]
        if not envs:
            raise UserError("no environment was run with every algorithm; give runs that can be compared")
        for env in set(self.envs) - set(envs):
            missing = [algo for algo in self.algos if not self.of(algo, env)]
            self.note(f"{env} was not run with {' and '.join(missing)}, so comparisons of all algorithms leave it out")
        compared = {algo: self._same_number(algo, envs) for algo in self.algos}
        kept = [curve for by_env in compared.values() for curves in by_env for curve in curves]
        step = self._span(kept, "the comparison")[1]
        matrices = {}
        for algo, by_env in compared.items():
            ends = [[np.interp(step, curve.steps, curve.scores) for curve in curves] for curves in by_env]
            matrices[algo] = np.array(ends).T
        return step, matrices

    def _span(self, curves: list[LearningCurve], what: str) -> tuple[int, int]:
        """First and last step that all curves cover; notes if one is shorter than the others."""
        latest, shortest = max(curves, key=lambda curve: curve.steps[0]), min(curves, key=lambda curve: curve.steps[-1])
        first, last = int(latest.steps[0]), int(shortest.steps[-1])
        if first > last:
            raise UserError(f"{what}: the runs have no step in common: {latest} begins at {first}, {shortest} ends at {last}")
        if last < max(curve.steps[-1] for curve in curves):
            self.note(f"{what}: the runs differ in length, so it ends with the shortest at step {last} ({shortest})")
        return first, last

    def _same_number(self, algo: str, envs: Iterable[str]) -> list[list[LearningCurve]]:
        """The algorithm's curves on each environment, the same number everywhere: the first seeds."""
        by_env = {env: self.of(algo, env) for env in envs}
        n_seeds = min(map(len, by_env.values()))
        for env, curves in by_env.items():
            if len(curves) > n_seeds:
                self.note(f"{algo}: {len(curves)} seeds on {env} but {n_seeds} elsewhere, so the first {n_seeds} are used")
        return [curves[:n_seeds] for curves in by_env.values()]


def read_grid(scores: pd.DataFrame, metric: str = "normalized_performance", step: int | None = None) -> Grid:
    """
    Arrange a table of scores as a grid. Scores that are NaN or infinite are left out, with a note.

    :param scores: a table with the columns env, algo, seed, step, and the metric
    :param metric: name of a column
    :param step: cut the curves off at this step and leave out those that do not cover it; ``None`` keeps all
    :return: the grid
    :raises UserError: if the metric was never recorded, or no curve covers the step
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
        curve = LearningCurve(env, algo, int(seed), sound["step"].to_numpy(), sound[metric].to_numpy(float))
        if not len(sound):
            grid.note(f"{curve}: no {metric} at all, so the run is left out")
        elif step is not None and not curve.steps[0] <= step <= curve.steps[-1]:
            grid.note(f"{curve}: evaluated from step {curve.steps[0]} to {curve.steps[-1]}, not at {step}, so it is left out")
        else:
            grid.curves.append(curve if step is None else _cut(curve, step))
    if not grid.curves:
        raise UserError(f"no run was evaluated at step {step}; the last evaluation is at step {scores['step'].max()}")
    return grid


def _cut(curve: LearningCurve, step: int) -> LearningCurve:
    """A curve up to a step, interpolated there if the run was not evaluated at that step."""
    before = curve.steps < step
    last = np.interp(step, curve.steps, curve.scores)
    return curve._replace(steps=np.append(curve.steps[before], step), scores=np.append(curve.scores[before], last))
