"""What all figures share: colours of the algorithms, curves, intervals, panels, legends, and files."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from sb3_por import ALGORITHMS
from sb3_por.common.files import atomic_write, check_output

#: Okabe and Ito's colours, told apart by readers with any colour vision (brown for their yellow, which is faint on white);
#: line styles and markers for print in grey.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#000000", "#E69F00", "#8C510A")
STYLES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (3, 1)), (0, (1, 1)), (0, (8, 2)))
MARKERS = ("o", "s", "^", "D", "v", "p", "h", "X")
FORMATS = (".png", ".pdf", ".svg")
#: An algorithm looks the same in every figure, whoever stands beside it: these have the first looks, others the next.
KNOWN = [*ALGORITHMS, "sac"]
#: Markers on a curve, about.
N_MARKERS = 12
#: Widest row of panels.
MAX_COLUMNS = 3


class Look(NamedTuple):
    """How an algorithm is drawn."""

    color: str
    style: Any
    marker: str


def looks(algos: Iterable[str]) -> dict[str, Look]:
    """The look of each algorithm; 64 are told apart."""
    names = list(dict.fromkeys([*KNOWN, *sorted(algos)]))
    n = len(COLORS)
    return {name: Look(COLORS[i % n], STYLES[(i + i // n) % n], MARKERS[(i + i // n) % n]) for i, name in enumerate(names)}


@contextmanager
def style() -> Iterator[None]:
    """A context in which figures are made."""
    settings = {
        "font.size": 11,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.titlesize": 11,
        "axes.titlelocation": "left",
        "grid.alpha": 0.3,
        "lines.linewidth": 2,
        "lines.markersize": 4,
        "legend.frameon": False,
    }
    with matplotlib.rc_context(settings):
        yield


def one_panel() -> tuple[Figure, Axes]:
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    return figure, figure.add_subplot()


def panels(n: int, height: float) -> tuple[Figure, list[Axes]]:
    """
    :param n: number of panels
    :param height: of each, inches
    :return: a figure with this many panels in rows of at most ``MAX_COLUMNS``
    """
    columns = n if n <= MAX_COLUMNS else int(np.ceil(n / np.ceil(n / MAX_COLUMNS)))
    rows = -(-n // columns)
    figure = Figure(figsize=(max(4 * columns, 6), height * rows + 0.6), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for empty in grid[n:]:
        empty.set_axis_off()
    return figure, list(grid[:n])


def curve(axes: Axes, x: pd.Series, y: pd.Series, low: pd.Series, high: pd.Series, look: Look, label: str) -> None:
    """A line in its band."""
    strong(axes, x, y, look, label)
    axes.fill_between(x, low, high, color=look.color, alpha=0.18, linewidth=0)


def strong(axes: Axes, x: pd.Series, y: pd.Series, look: Look, label: str) -> None:
    """A line with markers."""
    every = -(-len(x) // N_MARKERS)
    axes.plot(x, y, label=label, color=look.color, linestyle=look.style, marker=look.marker, markevery=every)


def faint(axes: Axes, x: pd.Series, y: pd.Series, look: Look, label: str) -> None:
    """A thin line for what a curve is compared with."""
    # The underscore keeps it out of the legend, which has the strong line of the same look.
    axes.plot(x, y, label=f"_{label}", color=look.color, linestyle=look.style, alpha=0.5, linewidth=1)


def right_title(axes: Axes, text: str) -> None:
    """What is to be seen in a panel, in small letters above its right end."""
    axes.set_title(text, loc="right", fontsize=9, color="0.3")


def interval(axes: Axes, row: int, value: float, low: float, high: float, look: Look) -> None:
    """A mark in its interval, on a row of its own."""
    axes.plot([low, high], [row, row], color=look.color, alpha=0.35, linewidth=9, solid_capstyle="butt")
    axes.plot([value], [row], color=look.color, marker=look.marker, markersize=8, markeredgecolor="white")
    axes.xaxis.set_major_locator(MaxNLocator(4))


def name_rows(axes: Axes, names: list[str]) -> None:
    """Names beside the rows of intervals, the first on top."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)


def steps_axis(axes: Axes) -> None:
    axes.set_xlabel("environment steps")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def legend_below(figure: Figure, axes: Iterable[Axes], title: str) -> None:
    """One legend for all panels."""
    entries: dict[str, Any] = {}
    for panel in axes:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    columns = min(len(entries), 3)
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns, title=title)


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, PDF or SVG, byte for byte the same for the same figure."""
    path = check_output(path, FORMATS)
    metadata = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}.get(path.suffix.lower())
    with atomic_write(path) as temporary, matplotlib.rc_context({"svg.hashsalt": "sb3-por"}):
        figure.savefig(temporary, dpi=150, metadata=metadata)
    # Panels, labels and legend have their places: to work them out again takes longer than to write the next format.
    figure.set_layout_engine("none")
