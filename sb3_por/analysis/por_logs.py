"""The order table: what POR's classifier logged during training, read from TensorBoard files or from a ``.csv``."""

import logging
import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_por.analysis.scores import RUN_KEYS, is_table, join_runs, read_table
from sb3_por.common.errors import UserError
from sb3_por.common.files import atomic_write
from sb3_por.runs.facts import run_identity
from sb3_por.runs.folder import ARGUMENTS, TENSORBOARD, find_runs, read_evaluations, run_arguments

#: Chance is ln 2 for losses and 0.5 for accuracies. The leak control (k = 0) must stay there.
CLASSIFIER_METRICS = ["por_loss", "por_accuracy", "por_leak_loss", "por_leak_accuracy"]
#: Gradient norms with respect to the encoder: of the critic's loss, and of the weighted POR loss.
GRADIENT_METRICS = ["encoder_grad_norm_critic", "encoder_grad_norm_por"]
ORDER_METRICS = [*CLASSIFIER_METRICS, *GRADIENT_METRICS]
#: The weight lambda, and the cosine of the two gradients; in tables, not in figures.
BALANCE_METRICS = ["por_coef", "encoder_grad_cosine"]
LOGGED_METRICS = [*ORDER_METRICS, *BALANCE_METRICS]
ORDER_COLUMNS = [*RUN_KEYS, "step", *LOGGED_METRICS]
#: How TensorBoard names its files.
EVENT_FILES = "events.out.tfevents.*"


class NoLogs(UserError):
    """The TensorBoard files of a run are missing, or cannot be told from those of other runs."""


def read_order(paths: Iterable[str | Path]) -> tuple[pd.DataFrame, list[str]]:
    """
    Read the order table of many runs.

    :param paths: run folders, folders that hold runs at any depth, and ``.csv`` files that :func:`write_order` wrote
    :return: the table, sorted, and a sentence on each run of POR that is left out; the table has the columns
        ``ORDER_COLUMNS``, one row for each step at which a run logged the objective, NaN where a metric was not logged, and
        no rows for runs without the objective
    :raises UserError: if a path holds no run, a table lacks a column, or two runs of one algorithm and environment have the
        same seed
    """
    given = [Path(path) for path in paths]
    tables, notes = [_read_csv(path) for path in given if is_table(path)], []
    for run in find_runs(path for path in given if not is_table(path)):
        try:
            tables.append(read_order_of(run))
        except NoLogs as error:
            if "por" in str(run_arguments(run).get("algo", run.parent.name)):
                notes.append(f"POR's logs: {run} is left out: {error}")
    tables = [table for table in tables if len(table)]
    return join_runs(tables) if tables else pd.DataFrame(columns=ORDER_COLUMNS), notes


def read_order_of(run: Path) -> pd.DataFrame:
    """
    Read the order table of one run.

    :param run: a run folder
    :return: its rows; none if it has logged no POR loss
    :raises NoLogs: if it has no TensorBoard files
    """
    events: dict[str, list[tuple[int, float]]] = {metric: [] for metric in LOGGED_METRICS}
    logs = [log for log in _logs_of(run) if log.Tags()["scalars"]]
    for log in sorted(logs, key=lambda log: log.FirstEventTimestamp()):
        for metric in set(LOGGED_METRICS) & {tag.removeprefix("train/") for tag in log.Tags()["scalars"]}:
            events[metric] += [(event.step, event.value) for event in log.Scalars(f"train/{metric}")]
    if not events["por_loss"]:
        events = {metric: [] for metric in LOGGED_METRICS}  # other objectives log gradient norms, too
    columns = {metric: _latest(logged) for metric, logged in events.items()}
    table = pd.DataFrame(columns, columns=LOGGED_METRICS, dtype=float).rename_axis("step").reset_index()
    for key, value in run_identity(run).items():
        table[key] = value
    return table[ORDER_COLUMNS]


def write_order(order: pd.DataFrame, path: str | Path) -> None:
    """Write an order table; reading it gives the same table."""
    with atomic_write(path) as temporary:
        order.to_csv(temporary, index=False, columns=ORDER_COLUMNS)


def _logs_of(run: Path) -> list[EventAccumulator]:
    """
    The TensorBoard logs of a run: those in its ``tb/``, and those in the ``tensorboard_log`` that ``args.yml`` names
    (``train.py -tb DIR`` and ``--track``). Runs may share that folder, so its logs must agree with the run's evaluations.
    """
    own = _open_logs(run / TENSORBOARD)
    shared = run_arguments(run).get("tensorboard_log")
    if not shared:
        if not own:
            raise NoLogs(f"there are no TensorBoard files in {run / TENSORBOARD}")
        return own
    settings = next(run.glob(f"*/{ARGUMENTS}")).parent
    folder = _started_in(run) / shared / settings.name
    arrays = read_evaluations(run)
    evaluations = dict(zip(arrays["timesteps"].tolist(), arrays["results"].mean(axis=1).tolist(), strict=True))
    logs = [log for log in _open_logs(folder) if _agrees(log, evaluations)]
    if not own and not logs:
        raise NoLogs(f"no TensorBoard file in {folder} has its evaluations")
    first = min(evaluations)
    if sum(first in _evaluations(log) for log in logs) > 1:
        raise NoLogs(f"several TensorBoard files in {folder} have its evaluations, and nothing tells which are its own")
    return own + logs


def _open_logs(folder: Path) -> list[EventAccumulator]:
    """All logs at any depth of a folder, loaded."""
    logging.getLogger("tensorboard").setLevel(logging.ERROR)  # it would warn of the last record of a killed run
    logs = []
    for parent in sorted({file.parent for file in folder.rglob(EVENT_FILES)}):
        logs.append(EventAccumulator(str(parent), size_guidance={"scalars": 0}))
        logs[-1].Reload()
    return logs


def _started_in(run: Path) -> Path:
    """The folder that a run's relative paths refer to; the current one if the run was moved."""
    log_folder = run_arguments(run).get("log_folder", "")
    run = run.resolve()
    return next((base for base in run.parents if (base / log_folder).resolve() == run.parents[1]), Path.cwd())


def _evaluations(log: EventAccumulator) -> dict[int, float]:
    """Step -> mean return of each evaluation in a log."""
    tag = "eval/mean_reward"
    return {event.step: event.value for event in log.Scalars(tag)} if tag in log.Tags()["scalars"] else {}


def _agrees(log: EventAccumulator, evaluations: dict[int, float]) -> bool:
    """Whether a log has evaluations of a run, and none that differs from the run's."""
    logged = {step: value for step, value in _evaluations(log).items() if step in evaluations}
    own = [evaluations[step] for step in logged]
    return bool(logged) and np.allclose(list(logged.values()), own, rtol=1e-5)  # TensorBoard keeps float32


def _latest(events: list[tuple[int, float]]) -> pd.Series:
    """
    Values by step, from events in the order in which they were written. A resumed run logs again what was logged after its
    checkpoint: the latest value counts. Times of events would not tell, since clocks jump.
    """
    kept: dict[int, float] = {}
    earliest = math.inf
    for step, value in reversed(events):
        if step < earliest:
            kept[step], earliest = value, step
    return pd.Series(kept, dtype=float).sort_index()


def _read_csv(path: Path) -> pd.DataFrame:
    order = read_table(path, ORDER_COLUMNS, [*RUN_KEYS, "step", "por_loss"], "an order table")
    if order["por_loss"].isna().all():
        raise UserError(f"{path}: the column por_loss is empty")
    return order
