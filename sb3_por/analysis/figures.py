"""Which figures there are, the table behind each, and how both become files."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from sb3_por.analysis import plots, statistics
from sb3_por.analysis.learning_curves import Grid, read_grid
from sb3_por.analysis.plot_style import FORMATS, save_figure
from sb3_por.common.errors import UserError
from sb3_por.common.files import atomic_write, check_output, check_writable

#: What a figure can be saved as; ``.csv`` has its numbers.
SUFFIXES = (*FORMATS, ".csv")


@dataclass(frozen=True)
class Kind:
    """
    A figure of scores.

    :param title: what it answers
    :param measure: grid, bootstrap samples, seed -> its table
    :param draw: table, metric -> the figure
    """

    title: str
    measure: Callable[[Grid, int, int], pd.DataFrame]
    draw: Callable[[pd.DataFrame, str], Figure]


KINDS = {
    "iqm": Kind("How fast do they learn, over all tasks?", statistics.iqm_curves, plots.draw_iqm),
    "tasks": Kind("How fast do they learn each task?", lambda grid, *_: statistics.task_curves(grid), plots.draw_tasks),
    "aggregates": Kind("How good are they in the end?", statistics.aggregates, plots.draw_aggregates),
    "profile": Kind("How many runs are how good?", statistics.performance_profiles, plots.draw_profiles),
    "improvement": Kind("How likely is one better than another?", statistics.improvements, plots.draw_improvements),
    "ratio": Kind("How far ahead of its best rival is each?", statistics.ratios, plots.draw_ratios),
}
#: The figure of the order objective, which is drawn from another table.
ORDER = "order"
ORDER_TITLE = "What does the partial-order classifier learn?"


@dataclass(frozen=True)
class Plot:
    """
    A figure and its numbers.

    :param name: of ``KINDS``, or ``ORDER``
    :param title: what it answers
    :param table: its numbers
    :param figure: the figure
    """

    name: str
    title: str
    table: pd.DataFrame
    figure: Figure

    def save(self, path: str | Path) -> None:
        """
        :param path: ends in one of ``SUFFIXES``
        """
        path = check_output(path, SUFFIXES)
        if path.suffix.lower() != ".csv":
            return save_figure(self.figure, path)
        with atomic_write(path) as temporary:
            self.table.to_csv(temporary, index=False, float_format="%.6g")


def plot(
    scores: pd.DataFrame,
    kind: str = "iqm",
    metric: str = "normalized_performance",
    step: int | None = None,
    reps: int = statistics.REPS,
    seed: int = 0,
) -> tuple[Plot, list[str]]:
    """
    :param scores: a table of scores
    :param kind: one of ``KINDS``
    :param metric: one of ``METRICS``
    :param step: see :func:`sb3_por.analysis.learning_curves.read_grid`
    :param reps: bootstrap samples
    :param seed: of the bootstrap
    :return: the figure, and what was left out, one sentence each
    :raises UserError: if there is nothing to draw
    """
    grid = read_grid(scores, metric, step)
    one = _plot(grid, kind, reps, seed)
    if one is None:
        raise UserError("; ".join(grid.notes))
    return one, grid.notes


def _plot(grid: Grid, kind: str, reps: int, seed: int) -> Plot | None:
    """``None`` if there is nothing to draw, which the grid's notes explain."""
    table = KINDS[kind].measure(grid, reps, seed)
    return None if table.empty else Plot(kind, KINDS[kind].title, table, KINDS[kind].draw(table, grid.metric))


def plot_order(order: pd.DataFrame) -> tuple[Plot, list[str]]:
    """
    :param order: of :func:`sb3_por.analysis.por_logs.read_order`
    :return: the figure, and what was left out
    """
    table, notes = statistics.order_curves(order)
    return Plot(ORDER, ORDER_TITLE, table, plots.draw_order(table)), notes


def plot_all(
    scores: pd.DataFrame,
    order: pd.DataFrame | None = None,
    metric: str = "normalized_performance",
    step: int | None = None,
    reps: int = statistics.REPS,
    seed: int = 0,
) -> tuple[list[Plot], list[str]]:
    """
    :param scores: a table of scores
    :param order: of :func:`sb3_por.analysis.por_logs.read_order`, if there is one
    :param metric: one of ``METRICS``
    :param step: see :func:`sb3_por.analysis.learning_curves.read_grid`
    :param reps: bootstrap samples
    :param seed: of the bootstrap
    :return: every figure that can be drawn, and what was left out
    :raises UserError: if nothing of the metric is recorded, or no run reaches the step
    """
    grid = read_grid(scores, metric, step)
    drawn = []
    for kind in KINDS:
        try:
            drawn.append(_plot(grid, kind, reps, seed))
        except UserError as error:
            grid.note(f"no figure {kind}: {error}")
    notes = grid.notes
    if order is not None:
        try:
            figure, left_out = plot_order(order)
            drawn.append(figure)
            notes = [*notes, *left_out]
        except UserError as error:
            notes = [*notes, f"no figure {ORDER}: {error}"]
    return [one for one in drawn if one is not None], notes


def save_all(plots: list[Plot], folder: str | Path) -> None:
    """Write every figure as PNG, PDF and table (``.csv``) under its name."""
    check_writable(folder)
    for one in plots:
        for suffix in (".png", ".pdf", ".csv"):
            one.save(Path(folder) / f"{one.name}{suffix}")
