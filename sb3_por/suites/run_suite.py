"""Suites: a file that names algorithms, environments and seeds becomes runs, on this machine or on a Ray cluster."""

import os
import shlex
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.table import Column, Table

from sb3_por.analysis.scores import read_scores, write_csv
from sb3_por.common.errors import UserNote
from sb3_por.common.files import check_writable, disk_errors
from sb3_por.runs.folder import EVALUATIONS, HYPERPARAMETERS, read_settings, settings_folder
from sb3_por.runs.lock import lock_folder
from sb3_por.suites.cluster import outlive
from sb3_por.suites.inputs import check_inputs
from sb3_por.suites.memory import overcommitment
from sb3_por.suites.pools import LocalPool, Pool
from sb3_por.suites.suite_file import Run, Suite, find_suite, read_suite, suite_runs

#: Lines of a failed run's log that are shown.
LOG_LINES = 8


def run_suite(path: str | Path, root: str | Path = "runs", dry_run: bool = False, ray: str | None = None) -> int:
    """
    Do what is left to do of a suite.

    :param path: the suite file, or the name of a suite that comes with this package
    :param root: the runs go to ``<root>/<name of the file>/<env>/<algo>/seed_<seed>``
    :param dry_run: print the runs and their states, and do nothing
    :param ray: address of a Ray cluster to do the runs on; on this machine if ``None``
    :return: 0 if every run is finished, 1 if some failed
    :raises UserError: if the file is wrong, what the runs read is missing, or the cluster cannot be used
    """
    path = find_suite(path)
    suite = read_suite(path)
    folder = Path(root) / path.stem
    runs = suite_runs(suite, folder)
    workers = suite.workers or max((os.cpu_count() or 1) // suite.threads, 1)
    left = [run for run in runs if run.state() != "finished"]
    too_much = overcommitment(left, workers) if ray is None else None
    if too_much is not None:
        warnings.warn(too_much, UserNote)
    if dry_run:
        for run in runs:
            print(f"{run.state():12} {shlex.join(run.command())}")
        return 0
    if ray is None:  # the machines of a cluster may have folders of their own
        check_inputs(left)
    check_writable(folder)
    lock = lock_folder(folder, f"another process is at work on the suite in {folder}; wait for it, or give another --root")
    try:
        if ray is None:
            return _do(LocalPool(runs, workers, suite.threads), folder)
        with _interruptible():
            return outlive(partial(_do_on_cluster, suite, runs, ray, folder))
    finally:
        lock.release()


def _do_on_cluster(suite: Suite, runs: list[Run], address: str, folder: Path, reached: Callable[[str], None]) -> int:
    from sb3_por.suites.ray_pool import RayPool

    pool = RayPool(runs, suite.threads, suite.gpus, address)
    reached(pool.head)
    return _do(pool, folder)


def _do(pool: Pool, folder: Path) -> int:
    console = Console(stderr=True)
    scores = folder / "scores.csv"
    with disk_errors(scores):
        with _interruptible():
            _show_work(pool, console)
        console.print(progress_table(pool))
        if any(run.run_folder.joinpath(EVALUATIONS).exists() for run in pool.runs):
            write_csv(read_scores([folder]), scores)
            print(scores)
    return _name_failed(pool)


@contextmanager
def _interruptible() -> Iterator[None]:
    """SIGTERM is as Ctrl-C, and both are told as an end from which the suite can be resumed."""
    handler = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt("interrupted; the same command resumes it") from interrupt
    finally:
        signal.signal(signal.SIGTERM, handler)


def _show_work(pool: Pool, console: Console) -> None:
    """On a terminal a table that stays up to date, else a line for each change of state."""
    with closing(pool.work()) as work:
        if console.is_terminal:
            with Live(progress_table(pool), console=console) as live:
                for _ in work:
                    live.update(progress_table(pool))
            return
        shown: dict[Run, str] = {}
        for _ in work:
            for run, state in pool.states.items():
                if shown.get(run) != state:
                    print(f"{state:12} {run.name}", file=sys.stderr, flush=True)
                    shown[run] = state


def _name_failed(pool: Pool) -> int:
    """
    Print the failed runs with the end of their logs.

    :return: the exit code
    """
    failed = [run for run, state in pool.states.items() if state == "failed"]
    for run in failed:
        print(f"failed: {run.name}, {run.log}:", file=sys.stderr)
        for line in run.log.read_text(errors="replace").splitlines()[-LOG_LINES:]:
            print(f"  {line}", file=sys.stderr)
    return 1 if failed else 0


def progress_table(pool: Pool) -> Table:
    """Of each run its state, steps, steps a second, latest score and the time left; below, the same of the suite."""
    table = Table(Column("run", overflow="fold"), "state", "steps", "steps/s", "score", "time left")
    speeds, left = [], 0
    for run in pool.runs:
        steps, score = pool.progress(run)
        total = _total_steps(run)
        speed = _steps_per_second(pool, run, steps)
        if speed:
            speeds.append(speed)
        if pool.states[run] not in ("finished", "failed"):
            left += max(total - steps, 0)
        table.add_row(
            run.name,
            pool.states[run],
            f"{steps}/{total}" if total else str(steps),
            f"{speed:.0f}" if speed else "",
            "" if score is None else f"{score:.3f}",
            _duration((total - steps) / speed) if speed and total else "",
        )
    finished = sum(state == "finished" for state in pool.states.values())
    table.caption = f"{finished} of {len(pool.runs)} runs finished"
    if speeds:
        table.caption += f", {sum(speeds):.0f} steps/s, {_duration(left / sum(speeds))} left"
    return table


def _steps_per_second(pool: Pool, run: Run, steps: int) -> float:
    """Since the run was started; 0 if it does not run."""
    if pool.states[run] != "running":
        return 0.0
    begin, steps_before = pool.started[run]
    return max(steps - steps_before, 0) / max(time.monotonic() - begin, 1e-3)


def _duration(seconds: float) -> str:
    """Such as ``1:05 h``, ``12 min`` or ``30 s``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02} h"


def _total_steps(run: Run) -> int:
    """Steps of a whole run; 0 as long as only its settings say it and it has not written them."""
    if "-n" in run.flags:
        return int(run.flags[run.flags.index("-n") + 1])
    return int(read_settings(settings_folder(run.run_folder, run.env) / HYPERPARAMETERS).get("n_timesteps") or 0)
