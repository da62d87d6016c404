"""Runs of a suite on a Ray cluster. Its machines need not share a disk: all files come to the machine of the suite."""

import logging
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from sb3_por.common.errors import UserError, UserNote, one_line
from sb3_por.runs.folder import latest_checkpoint
from sb3_por.runs.versions import current_versions, differences
from sb3_por.suites.cluster import ClusterLost, answers
from sb3_por.suites.folder_sync import read_changes, write_changes
from sb3_por.suites.pools import Pool, final_state
from sb3_por.suites.run import Run

try:
    import ray
    from ray.exceptions import RayError, RaySystemError, RayTaskError
except ImportError as _error:
    raise UserError("--ray needs Ray: pip install -c constraints.txt '.[ray]' on every machine of the cluster") from _error

from sb3_por.suites.ray_task import Message, do_run

#: Runs that wait for a place on the cluster at a time: their files take room in its object store.
AHEAD = 8
#: How often in a row a run may be lost with its worker, without a checkpoint in between.
RETRIES = 3
#: Looks in a row at which the head does not answer, after which the cluster is lost. Ray ends this process after a minute.
UNANSWERED = 3
#: Looks between two questions whether this machine still belongs to the cluster
MEMBER_LOOKS = 20


class RayPool(Pool):
    """
    Runs that are tasks of a Ray cluster. A run whose worker or machine is lost is resumed elsewhere, from the last checkpoint
    that was received. If the cluster itself is lost, ``work`` raises ``ClusterLost``, or Ray ends this process.

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
        context = ray.get_runtime_context()
        #: Where the head answers
        self.head: str = context.gcs_address
        self._node: str = context.get_node_id()
        needed = {"CPU": cpus, "GPU": gpus}
        machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if not any(all(machine.get(name, 0) >= n for name, n in needed.items()) for machine in machines):
            ray.shutdown()
            raise UserError(
                f"no machine of the Ray cluster has {cpus} CPUs and {gpus} GPUs; lower threads or gpus in the suite"
            )
        self._tasks: dict[Run, Any] = {}
        self._losses: dict[Run, int] = {}
        #: Machines whose versions have been compared with those here
        self._machines: set[str] = set()
        self._looks = self._unanswered = 0

    def _has_room(self) -> bool:
        return sum(state == "waiting" for state in self.states.values()) < AHEAD

    def _start(self, run: Run) -> None:
        task = do_run.options(num_cpus=self.cpus, num_gpus=self.gpus)
        self._tasks[run] = _answer(task.remote, run, self.cpus, read_changes(run, {}))
        self.states[run] = "waiting"

    def _look(self) -> None:
        self._check_cluster()
        tasks = list(self._tasks.values())
        ready = _answer(ray.wait, tasks, num_returns=len(tasks), timeout=0)[0] if tasks else []
        for run, task in list(self._tasks.items()):
            if task in ready:
                self._receive(run, task)

    def _check_cluster(self) -> None:
        """
        :raises ClusterLost: If the head is gone, or this machine does not belong to the cluster any more. Ray says neither
        """
        self._looks += 1
        self._unanswered = 0 if answers(self.head) else self._unanswered + 1
        if self._unanswered >= UNANSWERED:
            raise ClusterLost("its head does not answer")
        if self._looks % MEMBER_LOOKS == 0 and self._unanswered == 0:
            members = {node["NodeID"] for node in _answer(ray.nodes) if node["Alive"]}
            if self._node not in members:
                raise ClusterLost("this machine is no part of it any more")

    def _receive(self, run: Run, task: Any) -> None:
        try:
            message: Message = _answer(lambda: ray.get(next(task)))
        except RayTaskError as error:
            del self._tasks[run]
            reason = str(error).strip().splitlines()[-1]  # above it is the traceback
            self.states[run] = final_state(run, f"error on the machine {error.ip} of the cluster: {reason}")
            return
        except RayError as error:
            self._lost(run, error)
            return
        if self.states[run] == "waiting":
            self._runs_now(run)
        self._compare_versions(message)
        before = latest_checkpoint(run.run_folder)
        write_changes(run, message.changes)
        if latest_checkpoint(run.run_folder) != before:
            self._losses.pop(run, None)
        if message.returncode is not None:
            del self._tasks[run]
            self.states[run] = final_state(run, message.returncode)

    def _compare_versions(self, message: Message) -> None:
        """Note what differs on a machine, at its first message."""
        if message.versions is None or message.machine in self._machines:
            return
        self._machines.add(message.machine)
        changed = differences(current_versions(), message.versions)
        if changed:
            told = ", ".join(
                f"{name} {there or 'none'} instead of {here or 'none'}" for name, (here, there) in changed.items()
            )
            warnings.warn(f"the machine {message.machine} has {told}: its numbers may differ", UserNote)

    def _lost(self, run: Run, error: RayError) -> None:
        """Retry a limited number of times: a run may itself end its worker, by its need of memory. One that waits does not."""
        del self._tasks[run]
        self._losses[run] = self._losses.get(run, 0) + (self.states[run] == "running")
        if self._losses[run] > RETRIES:
            self.states[run] = final_state(run, f"lost {self._losses[run]} times: {one_line(error)}")
        else:
            self.states[run] = run.state()
            self._todo.insert(0, run)

    def _stop(self) -> None:
        for task in self._tasks.values():
            with suppress(ClusterLost, RayError):
                _answer(ray.cancel, task)
        with suppress(ClusterLost, RayError):
            _answer(ray.shutdown)


def _answer(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """
    :param function: One of Ray's
    :return: Its answer
    :raises ClusterLost: If the cluster gives none: Ray has no error of its own for that
    """
    try:
        return function(*args, **kwargs)
    except (OSError, RaySystemError) as error:
        raise ClusterLost(one_line(error)[:200]) from error


def _connect(address: str) -> None:
    if address.startswith("ray://"):
        raise UserError("give the address that ray start has shown, <host>:6379, on a machine of the cluster; not ray://")
    try:
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, RuntimeError, ValueError) as error:
        if "mismatch" in str(error):
            raise UserError(f"install the same versions as on the Ray cluster at {address}: {one_line(error)}") from error
        hint = "ray start --head starts one; RAY_AUTH_MODE must be the same there and here"
        raise UserError(f"no Ray cluster at {address}: {one_line(error)[:200]} ({hint})") from error
