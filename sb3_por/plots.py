"""Learning curves with the interquartile mean and stratified bootstrap intervals, through rliable."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rliable import library as rly
from scipy.stats import trim_mean

from sb3_por.errors import UserError
from sb3_por.files import atomic_write, check_output
from sb3_por.scores import METRICS

#: Okabe and Ito's colours, told apart by readers with any colour vision, and line styles for print in grey.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
STYLES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (3, 1)), (0, (1, 1)))
FORMATS = (".png", ".pdf", ".svg")

LABELS = {"normalized_performance": "normalized performance", "return": "return", "success": "success rate"}


@dataclass(frozen=True)
class Curve:
    """
    Interquartile mean over runs and tasks, with its interval, at each evaluation.

    :param steps: environment steps, shape ``(evaluations,)``
    :param iqm: same shape
    :param low: lower end of the 95 % interval
    :param high: upper end of the 95 % interval
    :param n_seeds: runs of each task
    :param envs: the tasks
    """

    steps: np.ndarray
    iqm: np.ndarray
    low: np.ndarray
    high: np.ndarray
    n_seeds: int
    envs: tuple[str, ...]


def iqm(scores: np.ndarray) -> np.ndarray:
    """
    Interquartile mean over runs and tasks, all evaluations at once: ten times as fast as rliable's one by one.

    :param scores: shape ``(runs, tasks, evaluations)``
    :return: shape ``(evaluations,)``
    """
    return trim_mean(scores.reshape(-1, scores.shape[-1]), 0.25, axis=0)


def learning_curves(
    scores: pd.DataFrame, metric: str = "normalized_performance", reps: int = 2000, seed: int = 0
) -> tuple[dict[str, Curve], list[str]]:
    """
    :param scores: a table of scores
    :param metric: one of ``METRICS``
    :param reps: bootstrap samples
    :param seed: of the bootstrap; the same scores and seed give the same intervals
    :return: algorithm -> curve, and what was left out of them, one sentence each
    :raises UserError: if nothing of the metric is recorded
    """
    notes: list[str] = []
    sound = scores.dropna(subset=[metric])
    if sound.empty:
        recorded = [name for name in METRICS if scores[name].notna().any()]
        raise UserError(f"no {metric} is recorded; there is {' and '.join(recorded) or 'no score at all'} (--metric)")
    if len(sound) < len(scores):
        notes.append(f"{len(scores) - len(sound)} of {len(scores)} evaluations have no {metric} and are left out")
    curves = {}
    for algo, rows in sound.groupby("algo", sort=True):
        steps, matrix, envs = _matrix(str(algo), rows, metric, notes)
        curves[str(algo)] = _curve(steps, matrix, envs, reps, seed)
    return curves, notes


def _matrix(algo: str, rows: pd.DataFrame, metric: str, notes: list[str]) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Steps, scores of shape ``(runs, tasks, evaluations)``, and tasks; what does not fit into them is noted."""
    runs = {
        env: [(run["step"].to_numpy(), run[metric].to_numpy()) for _, run in of_env.groupby("seed", sort=True)]
        for env, of_env in rows.groupby("env", sort=True)
    }
    n_runs = min(map(len, runs.values()))
    for env, of_env in runs.items():
        if len(of_env) > n_runs:
            notes.append(f"{algo}: {len(of_env)} seeds on {env} but {n_runs} elsewhere, so the first {n_runs} are used")
        runs[env] = of_env[:n_runs]
    every = [run for of_env in runs.values() for run in of_env]
    first, last = max(steps[0] for steps, _ in every), min(steps[-1] for steps, _ in every)
    if first > last:
        raise UserError(f"{algo}: the runs have no step in common ({first} > {last})")
    if last < max(steps[-1] for steps, _ in every):
        notes.append(f"{algo}: the runs differ in length, so the curve ends with the shortest, at step {last}")
    grid = np.unique(np.concatenate([steps for steps, _ in every]))
    grid = grid[(grid >= first) & (grid <= last)]
    matrix = np.array([[np.interp(grid, *run) for run in of_env] for of_env in runs.values()])
    return grid, matrix.swapaxes(0, 1), tuple(runs)


def _curve(steps: np.ndarray, matrix: np.ndarray, envs: tuple[str, ...], reps: int, seed: int) -> Curve:
    # rliable draws from NumPy's global generator and ignores its own argument for one.
    state = np.random.get_state()
    np.random.seed(seed)
    try:
        point, interval = rly.get_interval_estimates({"": matrix}, iqm, reps=reps)
    finally:
        np.random.set_state(state)
    return Curve(steps, point[""], interval[""][0], interval[""][1], len(matrix), envs)


def draw_curves(curves: dict[str, Curve], metric: str = "normalized_performance") -> Figure:
    """
    :param curves: algorithm -> curve
    :param metric: what the curves show, for the label
    :return: a figure, readable without a caption
    """
    with matplotlib.rc_context({"font.size": 11, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(7, 4.5), layout="constrained")
        axes = figure.add_subplot()
        for i, (algo, curve) in enumerate(curves.items()):
            seeds = f"{curve.n_seeds} seed{'s' if curve.n_seeds > 1 else ''}"
            label = f"{algo} ({seeds}, {len(curve.envs)} tasks)" if len(curve.envs) > 1 else f"{algo} ({seeds})"
            look: dict[str, Any] = dict(color=COLORS[i % len(COLORS)], linestyle=STYLES[i % len(STYLES)])
            marker = "o" if len(curve.steps) < 30 else None
            axes.plot(curve.steps, curve.iqm, label=label, linewidth=2, marker=marker, markersize=4, **look)
            axes.fill_between(curve.steps, curve.low, curve.high, color=look["color"], alpha=0.2, linewidth=0)
        envs = sorted({env for curve in curves.values() for env in curve.envs})
        # The bootstrap draws runs within each task: one run a task leaves nothing to draw.
        single = all(curve.n_seeds == 1 for curve in curves.values())
        spread = "one seed, no interval" if single else "interquartile mean, 95 % stratified bootstrap interval"
        axes.set_title(f"{', '.join(envs)}\n{spread}", fontsize=11, loc="left")
        axes.set_xlabel("environment steps")
        axes.set_ylabel(LABELS[metric])
        axes.grid(alpha=0.3)
        axes.legend(frameon=False)
    return figure


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, PDF or SVG, byte for byte the same for the same figure."""
    path = check_output(path, FORMATS)
    metadata = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}.get(path.suffix.lower())
    with atomic_write(path) as temporary, matplotlib.rc_context({"svg.hashsalt": "sb3-por"}):
        figure.savefig(temporary, dpi=150, metadata=metadata)


def plot(
    scores: pd.DataFrame, path: str | Path, metric: str = "normalized_performance", reps: int = 2000, seed: int = 0
) -> Iterable[str]:
    """
    Draw the learning curve of each algorithm in a table of scores.

    :param scores: a table of scores
    :param path: ``.png``, ``.pdf`` or ``.svg``
    :param metric: one of ``METRICS``
    :param reps: bootstrap samples
    :param seed: of the bootstrap
    :return: what was left out, one sentence each
    """
    path = check_output(path, FORMATS)
    curves, notes = learning_curves(scores, metric, reps, seed)
    save_figure(draw_curves(curves, metric), path)
    return notes
