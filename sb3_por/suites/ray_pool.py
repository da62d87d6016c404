"""Runs of a suite on a Ray cluster. Its machines need not share a disk: all files come to the machine of the suite."""

import logging
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from sb3_por.common.errors import UserError, one_line
from sb3_por.runs.checkpoints import latest_checkpoint
from sb3_por.suites.folder_sync import Changes, Stamps, read_changes, write_changes
from sb3_por.suites.pools import Pool, final_state, start_process
from sb3_por.suites.suite_file import Run

try:
    import ray
    from ray.exceptions import RayError, RayTaskError
except ImportError as _error:
    raise UserError("--ray needs Ray: pip install -c constraints.txt '.[ray]' on every machine of the cluster") from _error

#: Seconds between two messages of a run about the files that it has written.
SEND_S = 2.0
#: Runs that wait for a place on the cluster at a time: their files take room in its object store.
AHEAD = 8
#: How often in a row a run may be lost with its worker, without a checkpoint in between.
RETRIES = 3


class RayPool(Pool):
    """
    Runs that are tasks of a Ray cluster. A run whose worker or machine is lost is resumed elsewhere, from the last checkpoint
    that was received.

    :param runs: the runs
    :param cpus: CPUs of a run, and threads of its process
    :param gpus: GPUs of a run, parts of one allowed
    :param address: Address of the cluster, as ``ray.init`` takes it: ``"auto"``, or ``"<host>:<port>"``
    :raises UserError: if there is no such cluster, or none of its machines has room for a run
    """

    def __init__(self, runs: list[Run], cpus: int, gpus: float, address: str) -> None:
        super().__init__(runs)
        self.cpus = cpus
        self.gpus = gpus
        _connect(address)
        needed = {"CPU": cpus, "GPU": gpus}
        machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if not any(all(machine.get(name, 0) >= n for name, n in needed.items()) for machine in machines):
            ray.shutdown()
            raise UserError(
                f"no machine of the Ray cluster has {cpus} CPUs and {gpus} GPUs; lower threads or gpus in the suite"
            )
        self._tasks: dict[Run, Any] = {}
        self._losses: dict[Run, int] = {}

    def _has_room(self) -> bool:
        return sum(state == "waiting" for state in self.states.values()) < AHEAD

    def _start(self, run: Run) -> None:
        task = _do_run.options(num_cpus=self.cpus, num_gpus=self.gpus)
        self._tasks[run] = task.remote(run, self.cpus, read_changes(run, {}))
        self.states[run] = "waiting"

    def _look(self) -> None:
        tasks = list(self._tasks.values())
        ready = ray.wait(tasks, num_returns=len(tasks), timeout=0)[0] if tasks else []
        for run, task in list(self._tasks.items()):
            if task in ready:
                self._receive(run, task)

    def _receive(self, run: Run, task: Any) -> None:
        try:
            changes, returncode = ray.get(next(task))
        except RayTaskError as error:
            del self._tasks[run]
            self.states[run] = final_state(run, f"error on the cluster: {one_line(error)}")
            return
        except RayError as error:
            self._lost(run, error)
            return
        if self.states[run] == "waiting":
            self._runs_now(run)
        before = latest_checkpoint(run.run_folder)
        write_changes(run, changes)
        if latest_checkpoint(run.run_folder) != before:
            self._losses.pop(run, None)
        if returncode is not None:
            del self._tasks[run]
            self.states[run] = final_state(run, returncode)

    def _lost(self, run: Run, error: RayError) -> None:
        """Retry a limited number of times: the run itself may end its worker, by its need of memory."""
        del self._tasks[run]
        self._losses[run] = self._losses.get(run, 0) + 1
        if self._losses[run] > RETRIES:
            self.states[run] = final_state(run, f"lost {self._losses[run]} times: {one_line(error)}")
        else:
            self._start(run)

    def _stop(self) -> None:
        for task in self._tasks.values():
            ray.cancel(task)
        ray.shutdown()


def _connect(address: str) -> None:
    if address.startswith("ray://"):
        raise UserError("give the address that ray start has shown, <host>:6379, on a machine of the cluster; not ray://")
    try:
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, RuntimeError, ValueError) as error:
        hint = "ray start --head starts one; RAY_AUTH_MODE must be the same there and here"
        raise UserError(f"no Ray cluster at {address}: {one_line(error)[:200]} ({hint})") from error


@ray.remote(num_returns="streaming", max_retries=0)
def _do_run(run: Run, threads: int, files: Changes) -> Iterator[tuple[Changes, int | None]]:
    """
    On a machine of the cluster: do a run in a folder of its own, and tell of every change there.

    :param files: Files of the run's folder at the start
    :return: changes since the last message, and with the last one the return code of the run's process
    """
    with tempfile.TemporaryDirectory(prefix="sb3_por_") as folder:
        here = replace(run, folder=Path(folder))
        write_changes(here, files)
        known: Stamps = {}
        read_changes(here, known)
        process = start_process(here, threads)
        try:
            returncode = None
            while returncode is None:
                yield read_changes(here, known), None
                try:
                    returncode = process.wait(SEND_S)
                except subprocess.TimeoutExpired:
                    pass
            yield read_changes(here, known), returncode
        finally:
            process.kill()
            process.wait()
