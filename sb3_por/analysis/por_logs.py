"""The table of order: what POR logs of itself during training, read from runs' TensorBoard files or from a ``.csv``."""

import logging
import math
from collections.abc import Iterable
from pathlib import Path

import pandas as pd
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_por.analysis.scores import RUN_KEYS, join_runs
from sb3_por.common.errors import UserError, one_line
from sb3_por.common.files import atomic_write
from sb3_por.runs.facts import run_identity
from sb3_por.runs.folder import find_runs

#: Chance is ln 2 for the losses and 0.5 for the accuracies; those of the control (k = 0) must stay there.
CLASSIFIER_METRICS = ["por_loss", "por_accuracy", "por_leak_loss", "por_leak_accuracy"]
#: How hard the critic's loss and the weighted POR loss pull at the encoder.
GRADIENT_METRICS = ["encoder_grad_norm_critic", "encoder_grad_norm_por"]
ORDER_METRICS = [*CLASSIFIER_METRICS, *GRADIENT_METRICS]
ORDER_COLUMNS = [*RUN_KEYS, "step", *ORDER_METRICS]


def read_order(paths: Iterable[str | Path]) -> pd.DataFrame:
    """
    :param paths: run folders, folders that hold runs at any depth, and ``.csv`` files that :func:`write_order` wrote
    :return: one row for each step at which a run logged its order objective, columns ``ORDER_COLUMNS``, sorted; NaN where
        one of them was not logged; runs without that objective have no rows
    :raises UserError: if a path holds no run, no run has logged the objective, or two runs of one algorithm and
        environment have one seed
    """
    given = [Path(path) for path in paths]
    tables = [_read_csv(path) for path in given if path.suffix == ".csv"]
    logged = find_order(given)
    if logged is not None:
        tables.append(logged)
    if not tables:
        raise UserError("no run has logged a POR loss; give the folders of runs of sac_por or tqc_por, with their tb/")
    return join_runs(tables)


def find_order(paths: Iterable[str | Path]) -> pd.DataFrame | None:
    """
    :param paths: as :func:`read_order` takes them; tables are passed over
    :return: what the runs in the folders have logged; ``None`` if that is nothing
    """
    folders = [Path(path) for path in paths if Path(path).suffix != ".csv"]
    tables = [table for table in map(read_order_of, find_runs(folders)) if len(table)]
    return join_runs(tables) if tables else None


def read_order_of(run: Path) -> pd.DataFrame:
    """
    :param run: a run folder
    :return: its rows of the table; none if it has no TensorBoard files, or none with the objective
    """
    logging.getLogger("tensorboard").setLevel(logging.ERROR)  # a killed run's last record is cut off, which it would tell
    events: dict[str, list[tuple[float, int, float]]] = {metric: [] for metric in ORDER_METRICS}
    for folder in sorted({file.parent for file in run.glob("tb/**/events.out.tfevents.*")}):
        log = EventAccumulator(str(folder), size_guidance={"scalars": 0})
        log.Reload()
        for metric in set(ORDER_METRICS) & {tag.removeprefix("train/") for tag in log.Tags()["scalars"]}:
            events[metric] += [(event.wall_time, event.step, event.value) for event in log.Scalars(f"train/{metric}")]
    if not events["por_loss"]:
        events = {metric: [] for metric in ORDER_METRICS}  # other objectives log how hard the critic pulls, too
    columns = {metric: _latest(logged) for metric, logged in events.items()}
    table = pd.DataFrame(columns, columns=ORDER_METRICS, dtype=float).rename_axis("step").reset_index()
    for key, value in run_identity(run).items():
        table[key] = value
    return table[ORDER_COLUMNS]


def write_order(order: pd.DataFrame, path: str | Path) -> None:
    """Write a table of order; reading it gives the same table."""
    with atomic_write(path) as temporary:
        order.to_csv(temporary, index=False, columns=ORDER_COLUMNS)


def _latest(events: list[tuple[float, int, float]]) -> pd.Series:
    """Values by step. What a killed run had logged after the checkpoint that it went on from is logged again: it goes."""
    kept: dict[int, float] = {}
    earliest = math.inf
    for _, step, value in sorted(events, reverse=True):
        if step < earliest:
            kept[step], earliest = value, step
    return pd.Series(kept, dtype=float).sort_index()


def _read_csv(path: Path) -> pd.DataFrame:
    try:
        order = pd.read_csv(path, dtype={"env": str, "algo": str})
    except (OSError, ValueError) as error:
        raise UserError(f"cannot read {path}: {one_line(error)}") from error
    missing = [column for column in [*RUN_KEYS, "step", "por_loss"] if column not in order]
    if missing:
        raise UserError(f"{path} has no column {', '.join(missing)}; a table of order has {','.join(ORDER_COLUMNS)}")
    return order.reindex(columns=ORDER_COLUMNS)
