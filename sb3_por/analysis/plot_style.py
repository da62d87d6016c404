"""Shared parts of all figures: looks of algorithms, curves, intervals, panels, legends, and files."""

import zlib
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

from sb3_por.common.files import atomic_write, check_output

#: Colours of the algorithms that the documentation compares. A look depends on the name alone, so that an algorithm looks
#: the same in every figure, independent of the others. These are Okabe and Ito's colours, which readers with any colour
#: vision can tell apart (brown stands for their yellow, which is faint on white), and a wine red.
COLORS = {
    "sac_por": "#0072B2",
    "sac_drq": "#D55E00",
    "sac_curl": "#009E73",
    "sac_spr": "#CC79A7",
    "tqc_por": "#56B4E9",
    "sac": "#000000",
    "por_lambda_0": "#E69F00",
    "por_paper": "#8C510A",
    "sac_mrq": "#882255",
}
#: Colours of all other names: Tol's "muted" scheme, without those close to one above.
OTHER_COLORS = ("#332288", "#44AA99", "#117733", "#999933", "#DDCC77", "#CC6677", "#AA4499")
#: Line styles and markers keep curves apart in grey print.
STYLES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (3, 1)), (0, (1, 1)), (0, (8, 2)), (0, (4, 1, 1, 1)))
MARKERS = ("o", "s", "^", "D", "v", "p", "h", "X", "P")
FORMATS = (".png", ".pdf", ".svg")
#: Approximate number of markers on a curve.
N_MARKERS = 12
#: Most panels in a row.
MAX_COLUMNS = 3


class Look(NamedTuple):
    """Colour, line style and marker of an algorithm."""

    color: str
    style: Any
    marker: str


def looks(algos: Iterable[str]) -> dict[str, Look]:
    """
    Look up how to draw algorithms.

    :param algos: names of algorithms or labels
    :return: name -> look. Names in ``COLORS`` have fixed looks. Of other names 63 are told apart: a hash of the name chooses
        the look; where two names of one figure choose the same, the later in the alphabet takes the next free one.
    """
    names = set(algos)
    known = [name for name in COLORS if name in names]
    found = {name: Look(COLORS[name], STYLES[i], MARKERS[i]) for i, name in enumerate(COLORS) if name in known}
    n = len(OTHER_COLORS) * len(STYLES)
    taken: set[int] = set()
    for name in sorted(names - set(known)):
        first = zlib.crc32(name.encode())
        i = next((j % n for j in range(first, first + n) if j % n not in taken), first % n)
        taken.add(i)
        color, line = i % len(OTHER_COLORS), i // len(OTHER_COLORS)
        found[name] = Look(OTHER_COLORS[color], STYLES[line], MARKERS[line])
    return found


@contextmanager
def style() -> Iterator[None]:
    """Matplotlib settings shared by all figures, as a context."""
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
    """Make a figure with a single panel."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    return figure, figure.add_subplot()


def panels(n: int, height: float) -> tuple[Figure, list[Axes]]:
    """
    Make a figure with panels in rows of at most ``MAX_COLUMNS``.

    :param n: number of panels
    :param height: height of a panel, inches
    :return: the figure and its panels
    """
    columns = n if n <= MAX_COLUMNS else int(np.ceil(n / np.ceil(n / MAX_COLUMNS)))
    rows = -(-n // columns)
    figure = Figure(figsize=(max(4 * columns, 6), height * rows + 0.6), layout="constrained")
    subplots = figure.subplots(rows, columns, squeeze=False).ravel()
    for empty in subplots[n:]:
        empty.set_axis_off()
    return figure, list(subplots[:n])


def curve(axes: Axes, x: pd.Series, y: pd.Series, low: pd.Series, high: pd.Series, look: Look, label: str) -> None:
    """Draw a line with a band from low to high."""
    strong(axes, x, y, look, label)
    axes.fill_between(x, low, high, color=look.color, alpha=0.18, linewidth=0)


def strong(axes: Axes, x: pd.Series, y: pd.Series, look: Look, label: str) -> None:
    """Draw a line with markers."""
    every = -(-len(x) // N_MARKERS)
    axes.plot(x, y, label=label, color=look.color, linestyle=look.style, marker=look.marker, markevery=every)


def faint(axes: Axes, x: pd.Series, y: pd.Series, look: Look, label: str) -> None:
    """Draw a thin line: the reference that a curve is compared with."""
    # The underscore keeps it out of the legend, where the strong line of the same look stands.
    axes.plot(x, y, label=f"_{label}", color=look.color, linestyle=look.style, alpha=0.5, linewidth=1)


def right_title(axes: Axes, text: str) -> None:
    """Write a small title at the right end above a panel."""
    axes.set_title(text, loc="right", fontsize=9, color="0.3")


def interval(axes: Axes, row: int, value: float, low: float, high: float, look: Look) -> None:
    """Draw a value with its interval on a row."""
    axes.plot([low, high], [row, row], color=look.color, alpha=0.35, linewidth=9, solid_capstyle="butt")
    axes.plot([value], [row], color=look.color, marker=look.marker, markersize=8, markeredgecolor="white")
    axes.xaxis.set_major_locator(MaxNLocator(4))


def name_rows(axes: Axes, names: list[str]) -> None:
    """Write names beside the rows of intervals, the first on top."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)


def steps_axis(axes: Axes) -> None:
    """Label an x axis as environment steps, with few ticks in units such as 20k."""
    axes.set_xlabel("environment steps")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def legend_below(figure: Figure, axes: Iterable[Axes], title: str) -> None:
    """Draw one legend for all panels."""
    entries: dict[str, Any] = {}
    for panel in axes:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    columns = min(len(entries), 3)
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns, title=title)


def save_figure(figure: Figure, path: str | Path) -> None:
    """Save a figure as PNG, PDF or SVG. The same figure gives the same bytes."""
    path = check_output(path, FORMATS)
    metadata = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}.get(path.suffix.lower())
    with atomic_write(path) as temporary, matplotlib.rc_context({"svg.hashsalt": "sb3-por"}):
        figure.savefig(temporary, dpi=150, metadata=metadata)
    # The layout is final: computing it again takes longer than saving the next format.
    figure.set_layout_engine("none")
