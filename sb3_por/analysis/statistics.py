"""Curves, aggregates and comparisons of runs, with 95 % stratified bootstrap intervals by rliable."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import combinations

import numpy as np
import pandas as pd
from rliable import library as rly
from scipy.stats import trim_mean

from sb3_por.analysis.learning_curves import STATE_ALGOS, Grid, read_grid
from sb3_por.analysis.por_logs import ORDER_METRICS
from sb3_por.common.errors import UserError

#: Number of bootstrap samples.
REPS = 2000
#: Metrics whose best value is 1: their optimality gap is the distance to it.
UNIT_METRICS = ("normalized_performance", "success")
#: Number of thresholds of a performance profile.
N_THRESHOLDS = 101


def iqm(scores: np.ndarray) -> np.ndarray:
    """
    Interquartile mean over runs and tasks, for all evaluations at once. Ten times as fast as rliable, which takes one by one.

    :param scores: shape ``(runs, tasks, evaluations)``
    :return: shape ``(evaluations,)``
    """
    return trim_mean(scores.reshape(-1, scores.shape[-1]), 0.25, axis=0)


def iqm_curves(grid: Grid, reps: int = REPS, seed: int = 0) -> pd.DataFrame:
    """
    Sample-efficiency curves: interquartile mean over seeds and tasks at each evaluation.

    :param grid: the learning curves
    :param reps: number of bootstrap samples
    :param seed: seed of the bootstrap; the same scores and seed give the same intervals
    :return: columns algo, step, iqm, low, high, seeds (of each task), tasks, envs (their names)
    """
    _note_single_seeds(grid)
    tables, envs = [], {algo: frozenset(curve.env for curve in grid.of(algo)) for algo in grid.algos}
    if len(set(envs.values())) > 1:
        grid.note("the algorithms were not run on the same tasks, so their means are of different ones; see --kind tasks")
    for algo in grid.algos:
        steps, matrix = grid.matrix(algo)
        value, low, high = _interval(matrix, iqm, reps, seed)
        n_seeds, n_tasks, _ = matrix.shape
        columns = {"algo": algo, "step": steps, "iqm": value, "low": low, "high": high, "seeds": n_seeds, "tasks": n_tasks}
        tables.append(pd.DataFrame({**columns, "envs": " ".join(sorted(envs[algo]))}))
    return pd.concat(tables, ignore_index=True)


def task_curves(grid: Grid) -> pd.DataFrame:
    """
    Mean and standard deviation over seeds for each task, as in the paper's Figure 4.

    :return: columns env, algo, step, mean, std (of the population; 0 for one seed), seeds
    """
    tables = []
    for env in grid.envs:
        for algo in grid.algos:
            curves = grid.of(algo, env)
            if not curves:
                grid.note(f"{algo} was not run on {env}")
                continue
            try:
                steps, scores = grid.table(curves, f"{algo} on {env}")
            except UserError as error:
                grid.note(f"left out: {error}")
                continue
            columns = {"mean": scores.mean(axis=0), "std": scores.std(axis=0), "seeds": len(curves)}
            tables.append(pd.DataFrame({"env": env, "algo": algo, "step": steps, **columns}))
    if not tables:
        raise UserError("; ".join(grid.notes))
    return pd.concat(tables, ignore_index=True)


def order_curves(order: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """
    Loss and accuracy of POR's classifier and of its leak control, mean and standard deviation over seeds, as in the paper's
    Figures 5 and 6.

    :param order: an order table, see :func:`sb3_por.analysis.por_logs.read_order`
    :return: columns of :func:`task_curves` and metric, one of ``ORDER_METRICS``; and a sentence on everything left out
    """
    tables, notes = [], []
    for metric in ORDER_METRICS:
        logged = order.dropna(subset=[metric])  # the leak control is logged less often
        if len(logged):
            grid = read_grid(logged, metric)
            tables.append(task_curves(grid).assign(metric=metric))
            notes += [f"POR's logs: {note}" for note in grid.notes]
    return pd.concat(tables, ignore_index=True), list(dict.fromkeys(notes))


def aggregates(grid: Grid, reps: int = REPS, seed: int = 0) -> pd.DataFrame:
    """
    Interquartile mean and mean of each algorithm at the last step that all runs reach. Metrics whose best value is 1 also
    have the optimality gap: 1 minus the mean of the scores, scores above 1 counted as 1.

    :return: columns algo, statistic, value, low, high, step, seeds, tasks
    """
    _note_single_seeds(grid)
    step, matrices = grid.last()
    names = ["IQM", "mean"] + (["optimality gap"] if grid.metric in UNIT_METRICS else [])

    def measure(scores: np.ndarray) -> np.ndarray:
        return np.array([trim_mean(scores, 0.25, axis=None), scores.mean(), 1 - np.minimum(scores, 1).mean()])[: len(names)]

    tables = []
    for algo, matrix in matrices.items():
        value, low, high = _interval(matrix, measure, reps, seed)
        columns = {"algo": algo, "statistic": names, "value": value, "low": low, "high": high, "step": step}
        tables.append(pd.DataFrame({**columns, "seeds": matrix.shape[0], "tasks": matrix.shape[1]}))
    return pd.concat(tables, ignore_index=True)


def performance_profiles(grid: Grid, reps: int = REPS, seed: int = 0) -> pd.DataFrame:
    """
    Fraction of each algorithm's runs above each threshold, at the last step that all runs reach.

    :return: columns algo, threshold, fraction, low, high, step, seeds, tasks
    """
    _note_single_seeds(grid)
    step, matrices = grid.last()
    all_scores = np.concatenate([matrix.ravel() for matrix in matrices.values()])
    low, high = (0.0, 1.0) if grid.metric in UNIT_METRICS else (float(all_scores.min()), float(all_scores.max()))
    thresholds = np.linspace(low, high, N_THRESHOLDS)

    def above(scores: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
        """Rliable's ``score_distributions``, for all thresholds at once."""
        return 1 - np.searchsorted(np.sort(scores, axis=None), thresholds, side="right") / scores.size

    tables = []
    for algo, matrix in matrices.items():
        with _seeded(seed):
            value, interval = rly.create_performance_profile({"": matrix}, thresholds, custom_profile_func=above, reps=reps)
        low, high = interval[""]
        columns = {"algo": algo, "threshold": thresholds, "fraction": value[""], "low": low, "high": high, "step": step}
        tables.append(pd.DataFrame({**columns, "seeds": matrix.shape[0], "tasks": matrix.shape[1]}))
    return pd.concat(tables, ignore_index=True)


def probability_of_improvement(x: np.ndarray, y: np.ndarray) -> float:
    """
    Probability that a run of one algorithm beats a run of another on the same task, mean over tasks. A draw counts as half.
    Equal to rliable's, which is too slow to be resampled for many pairs.

    :param x: scores ``(runs, tasks)``
    :param y: scores ``(runs, tasks)``; the numbers of runs may differ
    """
    # The sign of the difference is 1, 0 or -1 where a run wins, draws or loses.
    return 0.5 + 0.5 * float(np.sign(x[:, None] - y[None]).mean())


def improvements(grid: Grid, reps: int = REPS, seed: int = 0) -> pd.DataFrame:
    """
    Probability of improvement of each pair of algorithms at the last step that all runs reach.

    :return: columns algo, rival, probability (that algo beats rival), low, high, step, seeds (the smaller number of both),
        tasks; no rows for a single algorithm
    """
    _note_single_seeds(grid)
    step, matrices = grid.last()
    pairs = list(combinations(grid.algos, 2))
    columns = ["algo", "rival", "probability", "low", "high", "step", "seeds", "tasks"]
    if not pairs:
        grid.note(f"there is one algorithm only ({grid.algos[0]}): no probability of improvement")
        return pd.DataFrame(columns=columns)

    def measure(*scores: np.ndarray) -> np.ndarray:
        of = dict(zip(matrices, scores, strict=True))
        return np.array([probability_of_improvement(of[x], of[y]) for x, y in pairs])

    value, low, high = _interval(list(matrices.values()), measure, reps, seed)
    shapes = [np.minimum(matrices[x].shape, matrices[y].shape) for x, y in pairs]
    rows = [(*pair, *numbers, step, *shape) for pair, shape, *numbers in zip(pairs, shapes, value, low, high, strict=True)]
    return pd.DataFrame(rows, columns=columns)


def ratios(grid: Grid, reps: int = REPS, seed: int = 0) -> pd.DataFrame:
    """
    Ratio of each algorithm's mean over seeds to its best rival's, for each task, at the last step that the task's runs
    reach. Each bootstrap sample chooses the best rival anew, so the interval includes that choice. Algorithms that observe
    the state (``STATE_ALGOS``) are left out.

    :return: columns env, algo, score, rival, rival_score, ratio, low, high, step, seeds; NaN or infinite where the rival's
        mean is not positive
    """
    _note_single_seeds(grid)
    algos = [algo for algo in grid.algos if algo not in STATE_ALGOS]
    if set(grid.algos) - set(algos):
        grid.note(f"{' and '.join(STATE_ALGOS)} observes the state, so the ratios leave it out")
    rows = []
    for env in grid.envs:
        curves = [curve for curve in grid.of(env=env) if curve.algo in algos]
        here = [algo for algo in algos if grid.of(algo, env)]
        if len(here) < 2:
            grid.note(f"{env}: no two algorithms that learn from images, so no ratio")
            continue
        steps, table = grid.table(curves, f"{env}, all algorithms")
        scores = [table[[curve.algo == algo for curve in curves], -1:] for algo in here]
        means = np.array([one.mean() for one in scores])
        value, low, high = _interval(scores, _ratios, reps, seed)
        for i, algo in enumerate(here):
            best = _best_rival(means, i)
            numbers = value[i], low[i], high[i]
            rows.append((env, algo, means[i], here[best], means[best], *numbers, steps[-1], len(scores[i])))
            if not np.isfinite(numbers).all():
                grid.note(f"{env}: rivals of {algo} score 0 or less, at least in some samples, where no ratio is finite")
    columns = ["env", "algo", "score", "rival", "rival_score", "ratio", "low", "high", "step", "seeds"]
    return pd.DataFrame(rows, columns=columns)


def _best_rival(means: np.ndarray, i: int) -> int:
    return int(np.argmax(np.where(np.arange(len(means)) == i, -np.inf, means)))


def _ratios(*scores: np.ndarray) -> np.ndarray:
    """Ratio of each algorithm's mean to its best rival's."""
    means = np.array([one.mean() for one in scores])
    best = np.array([means[_best_rival(means, i)] for i in range(len(means))])
    undefined = np.where(means > 0, np.inf, np.nan)
    return np.divide(means, best, out=undefined, where=best > 0)


def _note_single_seeds(grid: Grid) -> None:
    single = [algo for algo in grid.algos if any(len(grid.of(algo, env)) == 1 for env in grid.envs)]
    if single:
        grid.note(f"one seed of {' and '.join(single)}: how far its seeds differ is not known, and no interval includes it")


def _interval(
    scores: np.ndarray | list[np.ndarray], measure: Callable[..., np.ndarray], reps: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Measure scores, with a bootstrap interval.

    :param scores: scores of one algorithm, ``(runs, tasks, ...)``, or of several, which are resampled independently
    :param measure: scores -> array
    :param reps: number of bootstrap samples
    :param seed: seed of the bootstrap
    :return: the measure, and the low and the high end of its interval
    """
    with _seeded(seed), np.errstate(invalid="ignore"):
        value, interval = rly.get_interval_estimates({"": scores}, measure, reps=reps)
    return value[""], interval[""][0], interval[""][1]


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Seed NumPy's global generator and restore it: rliable draws from it and ignores its own argument."""
    state = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(state)
