"""Figures that can be read without a caption, each drawn from a table of ``statistics.py``."""

import math

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_por.analysis.learning_curves import sort_algos
from sb3_por.analysis.plot_style import (
    Look,
    curve,
    faint,
    interval,
    legend_below,
    looks,
    name_rows,
    one_panel,
    panels,
    right_title,
    steps_axis,
    strong,
    style,
)
from sb3_por.analysis.por_logs import GRADIENT_METRICS

LABELS = {
    "normalized_performance": "normalized performance",
    "return": "return",
    "success": "success rate",
    "por_loss": "POR loss",
    "por_accuracy": "POR accuracy",
}
#: Metric -> its value at chance, the name of that value, and the limits of the axis.
CHANCE = {"por_loss": (math.log(2), "ln 2", (0, 1.05)), "por_accuracy": (0.5, "½", (0.3, 1.02))}


def draw_iqm(table: pd.DataFrame, metric: str) -> Figure:
    """
    Draw sample-efficiency curves over all tasks.

    :param table: see :func:`sb3_por.analysis.statistics.iqm_curves`
    :param metric: name of the score, a key of ``LABELS``; here and below
    """
    by_algo, tasks = looks(table["algo"]), table["tasks"].max()
    envs = sorted({env for names in table["envs"].unique() for env in names.split()})
    with style():
        figure, axes = one_panel()
        for algo, rows in _algos(table):
            where = f", {_count(rows['tasks'], 'task')}" if tasks > 1 else ""
            label = f"{algo} ({_count(rows['seeds'], 'seed')}{where})"
            curve(axes, rows["step"], rows["iqm"], rows["low"], rows["high"], by_algo[algo], label)
        over = [name for name, several in (("seeds", not _single(table)), ("tasks", tasks > 1)) if several]
        what = f"interquartile mean over {' and '.join(over)}, " if over else ""
        axes.set_title(f"{', '.join(envs)}\n{what}{_interval_of(table)}")
        steps_axis(axes)
        axes.set_ylabel(LABELS[metric])
        axes.legend()
    return figure


def draw_tasks(table: pd.DataFrame, metric: str) -> Figure:
    """
    Draw learning curves, a panel for each task.

    :param table: see :func:`sb3_por.analysis.statistics.task_curves`
    """
    by_algo, envs = looks(table["algo"]), sorted(table["env"].unique())
    with style():
        figure, subplots = panels(len(envs), height=3.2)
        for axes, env in zip(subplots, envs, strict=True):
            for algo, rows in _algos(table[table["env"] == env]):
                low, high = rows["mean"] - rows["std"], rows["mean"] + rows["std"]
                curve(axes, rows["step"], rows["mean"], low, high, by_algo[algo], algo)
            axes.set_title(env)
            axes.set_ylabel(LABELS[metric])
            steps_axis(axes)
        legend_below(figure, subplots, _spread(table))
    return figure


def draw_profiles(table: pd.DataFrame, metric: str) -> Figure:
    """
    Draw performance profiles.

    :param table: see :func:`sb3_por.analysis.statistics.performance_profiles`
    """
    by_algo = looks(table["algo"])
    with style():
        figure, axes = one_panel()
        for algo, rows in _algos(table):
            label = f"{algo} ({_count(rows['seeds'], 'seed')}, {_count(rows['tasks'], 'task')})"
            color, line, _ = by_algo[algo]
            axes.plot(rows["threshold"], rows["fraction"], label=label, color=color, linestyle=line, drawstyle="steps-post")
            axes.fill_between(rows["threshold"], rows["low"], rows["high"], color=color, alpha=0.15, linewidth=0, step="post")
        axes.set_title(f"performance profile at step {_step(table)}, {_interval_of(table)}")
        axes.set_xlabel(f"{LABELS[metric]} τ")
        axes.set_ylabel("fraction of runs above τ")
        axes.set_ylim(-0.02, 1.04)
        axes.legend()
    return figure


def draw_aggregates(table: pd.DataFrame, metric: str) -> Figure:
    """
    Draw aggregate scores with intervals, a panel for each statistic.

    :param table: see :func:`sb3_por.analysis.statistics.aggregates`
    """
    by_algo, names = looks(table["algo"]), list(dict.fromkeys(table["statistic"]))
    with style():
        figure = Figure(figsize=(2.8 * len(names) + 1, 0.45 * table["algo"].nunique() + 1.6), layout="constrained")
        for axes, name in zip(figure.subplots(1, len(names), sharey=True, squeeze=False)[0], names, strict=True):
            algos = _algos(table[table["statistic"] == name])
            for i, (algo, rows) in enumerate(algos):
                row = rows.iloc[0]
                interval(axes, i, row["value"], row["low"], row["high"], by_algo[algo])
            name_rows(axes, [algo for algo, _ in algos])
            axes.set_title(f"{name} ({'lower' if name == 'optimality gap' else 'higher'} is better)")
            axes.set_xlabel(LABELS[metric])
        figure.suptitle(f"all tasks at step {_step(table)}, {_interval_of(table)}", fontsize=11, x=0.01, ha="left")
    return figure


def draw_improvements(table: pd.DataFrame, metric: str) -> Figure:
    """
    Draw probabilities of improvement with intervals.

    :param table: see :func:`sb3_por.analysis.statistics.improvements`
    """
    by_algo = looks(table["algo"])
    with style():
        figure = Figure(figsize=(7, 0.4 * len(table) + 1.7), layout="constrained")
        axes = figure.add_subplot()
        for i, row in enumerate(table.itertuples()):
            interval(axes, i, row.probability, row.low, row.high, by_algo[row.algo])
        name_rows(axes, [f"{row.algo} over {row.rival}" for row in table.itertuples()])
        axes.axvline(0.5, color="0.4", linewidth=1)
        axes.set_xlim(-0.03, 1.03)
        axes.set_xticks([0, 0.25, 0.5, 0.75, 1])
        axes.set_title(f"probability of improvement at step {_step(table)}\n{_interval_of(table)}")
        axes.set_xlabel(f"probability that a run of the first has the higher {LABELS[metric]}")
    return figure


def draw_ratios(table: pd.DataFrame, metric: str) -> Figure:
    """
    Draw ratios to the best rival with intervals, a panel for each task.

    :param table: see :func:`sb3_por.analysis.statistics.ratios`
    """
    by_algo, envs = looks(table["algo"]), sorted(table["env"].unique())
    with style():
        figure, subplots = panels(len(envs), height=0.4 * table.groupby("env").size().max() + 1.3)
        for axes, env in zip(subplots, envs, strict=True):
            rows = table[table["env"] == env]
            for i, row in enumerate(rows.itertuples()):
                if np.isfinite(row.ratio):
                    interval(axes, i, row.ratio, row.low, row.high, by_algo[row.algo])
            name_rows(axes, [f"{row.algo} : {row.rival}" for row in rows.itertuples()])
            axes.axvline(1, color="0.4", linewidth=1)
            axes.set_title(env)
            axes.set_xlabel(f"ratio at step {_step(rows)}")
        title = f"mean {LABELS[metric]} : the best rival's, {_interval_of(table)}"
        figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    return figure


def draw_order(table: pd.DataFrame) -> Figure:
    """
    Draw loss and accuracy of POR's classifier and the gradient norms, a column for each task.

    :param table: see :func:`sb3_por.analysis.statistics.order_curves`
    """
    by_algo, envs = looks(table["algo"]), sorted(table["env"].unique())
    n_rows = len(CHANCE) + table["metric"].isin(GRADIENT_METRICS).any()
    with style():
        figure = Figure(figsize=(max(4 * len(envs), 6), 3.2 * n_rows), layout="constrained")
        subplots = figure.subplots(n_rows, len(envs), sharex="col", squeeze=False)
        for j, env in enumerate(envs):
            here = table[table["env"] == env]
            if n_rows > len(CHANCE):
                _gradients(subplots[-1, j], here, by_algo)
            for axes, (metric, (chance, name, limits)) in zip(subplots[: len(CHANCE), j], CHANCE.items(), strict=True):
                for algo, rows in _algos(here[here["metric"] == metric]):
                    low, high = rows["mean"] - rows["std"], rows["mean"] + rows["std"]
                    curve(axes, rows["step"], rows["mean"], low, high, by_algo[algo], algo)
                for algo, rows in _algos(here[here["metric"] == metric.replace("por_", "por_leak_")]):
                    faint(axes, rows["step"], rows["mean"], by_algo[algo], algo)
                right_title(axes, "faint: a frame and itself (k = 0)")
                axes.axhline(chance, color="0.3", linewidth=1, linestyle=(0, (1, 2)), label="chance")
                axes.text(1, chance, name, transform=axes.get_yaxis_transform(), va="bottom", ha="right", color="0.3")
                axes.set_ylabel(LABELS[metric])
                axes.set_ylim(limits[0], max(limits[1], axes.dataLim.y1 + 0.02))
            subplots[0, j].set_title(env)
            steps_axis(subplots[-1, j])
        legend_below(figure, subplots.ravel(), _spread(table))
    return figure


def _gradients(axes: Axes, table: pd.DataFrame, by_algo: dict[str, Look]) -> None:
    """Draw the gradient norms with respect to the encoder, means over seeds."""
    for metric, draw in zip(GRADIENT_METRICS, (faint, strong), strict=True):
        for algo, rows in _algos(table[table["metric"] == metric]):
            draw(axes, rows["step"], rows["mean"], by_algo[algo], algo)
    right_title(axes, "λ POR; faint: the critic")
    axes.set_yscale("log", nonpositive="mask")
    axes.set_ylabel("gradient norm, encoder")


def _algos(table: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    return [(algo, table[table["algo"] == algo]) for algo in sort_algos(table["algo"])]


def _count(column: pd.Series, noun: str) -> str:
    """``3 seeds``; ``3-5 seeds`` where the number varies."""
    low, high = column.min(), column.max()
    return f"{low}{f'-{high}' if high > low else ''} {noun}{'s' if high > 1 else ''}"


def _single(table: pd.DataFrame) -> bool:
    return bool(table["seeds"].max() == 1)


def _interval_of(table: pd.DataFrame) -> str:
    # The bootstrap resamples runs within each task, so one run per task has no interval, unless its rival has several.
    has_none = _single(table) and bool((table["low"] == table["high"]).all())
    return "one seed, no interval" if has_none else "95 % stratified bootstrap interval"


def _spread(table: pd.DataFrame) -> str:
    if _single(table):
        return "one seed, no spread"
    return f"mean ± standard deviation over {_count(table['seeds'], 'seed')}"


def _step(table: pd.DataFrame) -> str:
    """The step of a table with a single one, with spaces between thousands."""
    return f"{table['step'].iloc[0]:,}".replace(",", " ")
