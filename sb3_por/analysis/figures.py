"""All figures, the table behind each, and how both are saved."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from sb3_por.analysis import plots, statistics
from sb3_por.analysis.learning_curves import Grid, read_grid
from sb3_por.analysis.names import ORDER
from sb3_por.analysis.plot_style import FORMATS, save_figure
from sb3_por.common.errors import UserError
from sb3_por.common.files import atomic_write, check_output, check_writable

#: Formats of a figure; ``.csv`` holds its numbers.
SUFFIXES = (*FORMATS, ".csv")


@dataclass(frozen=True)
class Kind:
    """
    A kind of figure.

    :param title: the question that it answers
    :param measure: grid, number of bootstrap samples, seed -> the table
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
#: Title of the figure of POR's classifier, which is drawn from the order table instead of the scores.
ORDER_TITLE = "What does the partial-order classifier learn?"


@dataclass(frozen=True)
class Plot:
    """
    A figure and its numbers.

    :param name: one of ``KINDS``, or ``ORDER``
    :param title: the question that it answers
    :param table: its numbers
    :param figure: the figure
    """

    name: str
    title: str
    table: pd.DataFrame
    figure: Figure

    def save(self, path: str | Path) -> None:
        """
        Save the figure, or its numbers.

        :param path: its suffix, one of ``SUFFIXES``, decides the format
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
    Draw one figure of scores.

    :param scores: a table of scores
    :param kind: one of ``KINDS``
    :param metric: one of ``METRICS``
    :param step: see :func:`sb3_por.analysis.learning_curves.read_grid`
    :param reps: number of bootstrap samples
    :param seed: seed of the bootstrap
    :return: the figure, and a sentence on everything left out
    :raises UserError: if there is nothing to draw
    """
    grid = read_grid(scores, metric, step)
    one = _plot(grid, kind, reps, seed)
    if one is None:
        raise UserError("; ".join(grid.notes))
    return one, grid.notes


def _plot(grid: Grid, kind: str, reps: int, seed: int) -> Plot | None:
    """One figure; ``None`` if there is nothing to draw, which the grid's notes explain."""
    table = KINDS[kind].measure(grid, reps, seed)
    return None if table.empty else Plot(kind, KINDS[kind].title, table, KINDS[kind].draw(table, grid.metric))


def plot_order(order: pd.DataFrame) -> tuple[Plot, list[str]]:
    """
    Draw the figure of POR's classifier.

    :param order: an order table, see :func:`sb3_por.analysis.por_logs.read_order`
    :return: the figure, and a sentence on everything left out
    :raises UserError: if the table is empty
    """
    if order.empty:
        raise UserError("no run has logged a POR loss; give run folders of sac_por or tqc_por, with their TensorBoard files")
    table, notes = statistics.order_curves(order)
    return Plot(ORDER, ORDER_TITLE, table, plots.draw_order(table)), notes


def plot_all(
    scores: pd.DataFrame,
    order: pd.DataFrame,
    metric: str = "normalized_performance",
    step: int | None = None,
    reps: int = statistics.REPS,
    seed: int = 0,
) -> tuple[list[Plot], list[str]]:
    """
    Draw every figure that can be drawn.

    :param scores: a table of scores
    :param order: an order table, see :func:`sb3_por.analysis.por_logs.read_order`; may be empty
    :param metric: one of ``METRICS``
    :param step: see :func:`sb3_por.analysis.learning_curves.read_grid`
    :param reps: number of bootstrap samples
    :param seed: seed of the bootstrap
    :return: the figures, and a sentence on everything left out
    :raises UserError: if the metric was never recorded, or no run covers the step
    """
    grid = read_grid(scores, metric, step)
    drawn = []
    for kind in KINDS:
        try:
            drawn.append(_plot(grid, kind, reps, seed))
        except UserError as error:
            grid.note(f"no figure {kind}: {error}")
    try:
        figure, notes = plot_order(order)
        drawn.append(figure)
    except UserError as error:
        notes = [f"no figure {ORDER}: {error}"]
    return [one for one in drawn if one is not None], [*grid.notes, *notes]


def save_all(plots: list[Plot], folder: str | Path) -> None:
    """Save every figure as PNG, PDF and table (``.csv``) under its name."""
    check_writable(folder)
    for one in plots:
        for suffix in (".png", ".pdf", ".csv"):
            one.save(Path(folder) / f"{one.name}{suffix}")
