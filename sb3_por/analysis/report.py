"""A self-contained HTML page about a set of runs: no network, no scripts, no other file."""

import base64
import mimetypes
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jinja2
import numpy as np
import pandas as pd

from sb3_por.analysis.diagnostics import check_order
from sb3_por.analysis.figures import Plot, plot_all, save_all
from sb3_por.analysis.learning_curves import sort_algos
from sb3_por.analysis.plots import LABELS
from sb3_por.analysis.por_logs import read_order
from sb3_por.analysis.saliency import draw_saliency
from sb3_por.analysis.scores import METRICS, RUN_KEYS, is_table, join_runs, read_csv, read_run, unlike_runs
from sb3_por.common.errors import UserError
from sb3_por.common.files import atomic_write, check_writable
from sb3_por.evaluation.loading import LOADABLE, resolve
from sb3_por.evaluation.video import record_video
from sb3_por.runs.facts import RunFacts, orphaned_logs, take_inventory
from sb3_por.runs.folder import BEST_MODEL, EVALUATIONS

PAGE = "index.html"
FIGURES = "figures"
TEMPLATE = "report.html.jinja"
#: Cell of a table without a number.
NOTHING = "-"
#: Height and width of the videos: small, since a page holds one for each task and algorithm.
VIDEO_SIZE = 200
#: Tables of curves, and the columns that name a curve. The page shows the last row of each curve, the ``.csv`` all rows.
CURVES = {"iqm": ["algo"], "tasks": ["env", "algo"], "order": ["env", "algo", "metric"]}
#: Tables too long to print.
UNREADABLE = ("profile",)


@dataclass(frozen=True)
class Picture:
    """
    A picture on the page.

    :param title: its caption
    :param uri: the image as a data URI
    """

    title: str
    uri: str


@dataclass(frozen=True)
class Section:
    """
    A figure on the page.

    :param title: the question that it answers
    :param name: name of its file
    :param picture: the figure
    :param header: header of the table below it; empty for no table
    :param rows: printed rows of that table
    """

    title: str
    name: str
    picture: Picture
    header: list[str]
    rows: list[list[str]]


def write_report(
    paths: list[str | Path],
    folder: str | Path,
    metric: str | None = None,
    step: int | None = None,
    seed: int = 0,
    videos: bool = True,
) -> Path:
    """
    Write a page about runs.

    :param paths: run folders, folders that hold runs at any depth, and tables of scores (``.csv``), in any mixture
    :param folder: folder for ``index.html`` and for ``figures/``, the same figures for print with their numbers
    :param metric: score to compare; by default the first of ``METRICS`` that is recorded
    :param step: see :func:`sb3_por.analysis.learning_curves.read_grid`
    :param seed: seed of the bootstrap
    :param videos: record videos and saliency maps of the best models, a few seconds each
    :return: the page
    :raises UserError: if there is neither a run nor a score
    """
    folder = Path(folder)
    check_writable(folder)
    given = [Path(path) for path in paths]
    folders = [path for path in given if not is_table(path)]
    for path in folders:
        if not path.is_dir():
            raise UserError(f"there is no folder {path}")
    runs, orphans = take_inventory(folders), orphaned_logs(folders)
    scores = _scores([path for path in given if is_table(path)], runs)
    if scores is None and not runs and not orphans:
        raise UserError(f"no run under {' '.join(map(str, folders))}")

    plots: list[Plot] = []
    shown: dict[str, list[Picture]] = {}
    notes: list[str] = []
    if not runs:
        notes.append("made from scores alone: settings, machines, failures and videos need run folders")
    if scores is None:
        notes.append("no run was evaluated: there is nothing to plot")
    else:
        metric = metric or next((name for name in METRICS if scores[name].notna().any()), METRICS[0])
        order, without_logs = read_order([run.folder for run in _evaluated(runs)])
        plots, left_out = plot_all(scores, order, metric, step, seed=seed)
        notes += unlike_runs(run.folder for run in _evaluated(runs)) + without_logs + left_out
        save_all(plots, folder / FIGURES)
        if videos:
            shown = _show_models(_best_runs(runs, metric), notes)
    page = _template().render(
        title=", ".join((path.parent if is_table(path) else path).resolve().name for path in given),
        metric=LABELS.get(metric or "", ""),
        n_runs=len({(run.env, run.algo, run.seed) for run in runs} | _identities(scores)),
        n_scores=0 if scores is None else len(scores),
        runs=[_run_row(run, metric) for run in runs],
        commits=sorted({run.commit for run in runs} | (set() if scores is None else set(scores["commit"])) - {""}),
        machines=sorted({run.machine for run in runs} - {""}),
        settings=_settings(runs),
        sections=[_section(one, folder / FIGURES) for one in plots],
        videos=shown,
        unfinished=[run for run in runs if run.state != "finished"],
        orphans=orphans,
        notes=notes,
    )
    with atomic_write(folder / PAGE) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return folder / PAGE


# -- parts of the page -------------------------------------------------------------------------------------------------


def _evaluated(runs: list[RunFacts]) -> list[RunFacts]:
    return [run for run in runs if (run.folder / EVALUATIONS).is_file()]


def _scores(tables: list[Path], runs: list[RunFacts]) -> pd.DataFrame | None:
    rows = [read_csv(path) for path in tables] + [read_run(run.folder) for run in _evaluated(runs)]
    return join_runs(rows) if rows else None


def _identities(scores: pd.DataFrame | None) -> set[tuple[str, str, int]]:
    return set() if scores is None else set(scores[RUN_KEYS].itertuples(index=False, name=None))


def _template() -> jinja2.Template:
    loader = jinja2.PackageLoader("sb3_por.analysis", package_path="")
    return jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True).get_template(TEMPLATE)


def _section(plot: Plot, figures: Path) -> Section:
    """
    Make the section of a figure.

    :param plot: the figure and its numbers
    :param figures: folder where the figure was saved
    """
    table = plot.table
    if plot.name in CURVES:
        table = table.groupby(CURVES[plot.name], sort=False).tail(1)
    header, rows = [], []
    if plot.name not in UNREADABLE:
        header = [name.replace("_", " ") for name in table.columns]
        rows = [[_printed(value) for value in row] for row in table.itertuples(index=False)]
    return Section(plot.title, plot.name, _picture(plot.title, figures / f"{plot.name}.png"), header, rows)


def _run_row(run: RunFacts, metric: str | None) -> dict[str, str]:
    """One row of the table of runs."""
    row = {
        "algorithm": run.algo,
        "environment": run.env,
        "seed": str(run.seed),
        "state": run.state,
        "steps": f"{run.steps} of {run.planned}" if run.planned else str(run.steps),
        "last score": NOTHING,
        "best score": NOTHING,
        "hours": NOTHING,
        "commit": run.commit or "not recorded",
        "machine": run.machine or "not recorded",
    }
    if metric is not None and _evaluated([run]):
        rows = read_run(run.folder)
        values = rows[metric].dropna()
        if len(values):
            row |= {"last score": _printed(values.iloc[-1]), "best score": _printed(values.max())}
        if rows["wall_clock_s"].notna().any():
            row["hours"] = f"{rows['wall_clock_s'].max() / 3600:.2f}"
    return row


def _settings(runs: list[RunFacts]) -> list[dict[str, Any]]:
    """Group the runs that share all settings."""
    groups: dict[tuple[str, str, str], list[RunFacts]] = {}
    for run in runs:
        groups.setdefault((run.env, run.algo, repr(sorted(run.settings.items(), key=str))), []).append(run)
    return [
        {
            "title": f"{algo} on {env}, seed{'s' if len(members) > 1 else ''} {', '.join(str(run.seed) for run in members)}",
            "values": sorted(members[0].settings.items()),
        }
        for (env, algo, _), members in groups.items()
    ]


def _best_runs(runs: list[RunFacts], metric: str) -> Iterator[tuple[str, str, RunFacts, float]]:
    """The run with the best evaluation for each task and algorithm, among runs with a saved model."""
    with_model = [run for run in _evaluated(runs) if (run.folder / BEST_MODEL).is_file()]
    for env in sorted({run.env for run in with_model}):
        for algo in sort_algos(run.algo for run in with_model if run.env == env):
            members = [run for run in with_model if (run.env, run.algo) == (env, algo)]
            best = [read_run(run.folder)[metric].max() for run in members]
            if np.isfinite(best).any():
                yield env, algo, members[int(np.nanargmax(best))], float(np.nanmax(best))


def _show_models(best: Iterator[tuple[str, str, RunFacts, float]], notes: list[str]) -> dict[str, list[Picture]]:
    """
    Record a video of each algorithm's best model, and a saliency map if it learns an order from images. A model that cannot
    be shown gets a note, so one broken run does not stop the page.

    :param best: task, algorithm, run, score
    :param notes: the list for the notes
    :return: task -> pictures
    """
    shown: dict[str, list[Picture]] = {}
    for env, algo, run, score in best:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "video.gif"
            try:
                model, environment = resolve(run.folder, env, algo=algo if algo in LOADABLE else None)
                record_video(model, env, path, size=VIDEO_SIZE, **environment)
                title = f"{algo}, seed {run.seed}: best of its evaluations {_printed(score)}"
                shown.setdefault(env, []).append(_picture(title, path))
                if _learns_order(model):
                    path = Path(folder) / "saliency.png"
                    frame = draw_saliency(model, env, path, **environment)
                    title = f"{algo}, seed {run.seed}: saliency of its classifier in frame {frame}"
                    shown[env].append(_picture(title, path))
            except UserError as error:
                notes.append(f"{run.name}: its model cannot be shown: {error}")
    return shown


def _learns_order(model: Any) -> bool:
    try:
        check_order(model)
    except UserError:
        return False
    return True


def _picture(title: str, path: Path) -> Picture:
    kind = mimetypes.guess_type(path.name)[0]
    return Picture(title, f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}")


def _printed(value: Any) -> str:
    """A cell as the page prints it."""
    if not isinstance(value, float | np.floating):
        return str(value)
    if np.isnan(value):
        return NOTHING
    return "∞" if np.isinf(value) else f"{value:.3f}"
