"""Pools that do the runs of a suite: processes of this machine here, a cluster in ``ray_pool.py``."""

import signal
import subprocess
import time
from abc import ABC, abstractmethod
from collections.abc import Generator

from sb3_por.runs.facts import progress
from sb3_por.suites.run import Run, start_process

#: Seconds between two looks at what runs.
POLL_S = 0.5


class Pool(ABC):
    """
    Does runs: finished ones are skipped, interrupted ones are resumed.

    :param runs: the runs
    """

    def __init__(self, runs: list[Run]) -> None:
        self.runs = runs
        #: ``Run.state()`` to begin with, then ``"waiting"``, ``"running"``, ``"failed"`` or ``"finished"``
        self.states = {run: run.state() for run in runs}
        #: When a run began to run (``time.monotonic``) and how many steps it had then
        self.started: dict[Run, tuple[float, int]] = {}
        self._todo = [run for run in runs if self.states[run] != "finished"]
        self._progress: dict[tuple[Run, str], tuple[int, float | None]] = {}

    def work(self) -> Generator[None, None, None]:
        """Do all runs. Yields after each look at them; closing the generator interrupts them."""
        try:
            while self._todo or self._active():
                while self._todo and self._has_room():
                    self._start(self._todo.pop(0))
                self._look()
                yield
                if self._todo or self._active():
                    time.sleep(POLL_S)
        finally:
            active = self._active()
            self._stop()
            self.states |= {run: "interrupted" for run in active}

    def progress(self, run: Run) -> tuple[int, float | None]:
        """As :func:`sb3_por.runs.facts.progress`; the files of what does not run are read once."""
        key = run, self.states[run]
        if key not in self._progress or self.states[run] == "running":
            self._progress[key] = progress(run.run_folder)
        return self._progress[key]

    def _active(self) -> list[Run]:
        return [run for run, state in self.states.items() if state in ("waiting", "running")]

    def _runs_now(self, run: Run) -> None:
        self.states[run] = "running"
        self.started[run] = time.monotonic(), progress(run.run_folder)[0]

    @abstractmethod
    def _has_room(self) -> bool:
        """Whether one more run may be started."""

    @abstractmethod
    def _start(self, run: Run) -> None:
        """Begin with a run: its state becomes ``"waiting"`` or ``"running"``."""

    @abstractmethod
    def _look(self) -> None:
        """Bring the states up to date."""

    @abstractmethod
    def _stop(self) -> None:
        """Interrupt the active runs, so that they can be resumed."""


class LocalPool(Pool):
    """
    Runs that are processes of this machine.

    :param runs: the runs
    :param workers: processes at a time
    :param threads: threads of a process
    """

    def __init__(self, runs: list[Run], workers: int, threads: int) -> None:
        super().__init__(runs)
        self.workers = workers
        self.threads = threads
        self._processes: dict[Run, subprocess.Popen] = {}

    def _has_room(self) -> bool:
        return len(self._processes) < self.workers

    def _start(self, run: Run) -> None:
        self._processes[run] = start_process(run, self.threads)
        self._runs_now(run)

    def _look(self) -> None:
        for run, process in list(self._processes.items()):
            if process.poll() is not None:
                del self._processes[run]
                self.states[run] = final_state(run, process.returncode)

    def _stop(self) -> None:
        """Let the active runs save and stop."""
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            process.wait()


def final_state(run: Run, end: int | str) -> str:
    """
    :param end: the return code of the run's process, or what kept it from ending; the run's log says it
    :return: ``"finished"`` or ``"failed"``
    """
    if end == 0:
        return "finished"
    if isinstance(end, int):
        end = f"killed by {signal.Signals(-end).name}" if end < 0 else f"exit code {end}"
    run.folder.mkdir(parents=True, exist_ok=True)
    with open(run.log, "a") as log:
        print(f"[{end}]", file=log)
    return "failed"
