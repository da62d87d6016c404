"""Worker processes of environments: signals are left to the run's process, and a lost worker is an error at once."""

import atexit
import multiprocessing.connection
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_por.common.errors import UserError

#: Seconds within which the end of a lost worker is known
TELL_S = 5.0


class _Pipe:
    """
    A pipe to a worker, which says what has become of a worker that does not answer.

    :param pipe: Its end here
    :param describe: Makes the message
    """

    def __init__(self, pipe: Connection, describe: Callable[[], str]) -> None:
        self._pipe = pipe
        self._describe = describe
        self.close = pipe.close

    def send(self, message: Any) -> None:
        with self._noticing_lost():
            self._pipe.send(message)

    def recv(self) -> Any:
        with self._noticing_lost():
            return self._pipe.recv()

    @contextmanager
    def _noticing_lost(self) -> Iterator[None]:
        """
        :raises UserError: If the worker has ended
        """
        try:
            yield
        except (EOFError, ConnectionError) as error:
            raise UserError(self._describe()) from error


class WorkerProcesses(SubprocVecEnv):
    """
    SB3's ``SubprocVecEnv`` for long runs.

    Ctrl-C and the SIGTERM of a cluster reach all processes of a job. SB3's workers end then, and the run has no environments
    to write its checkpoint with; these go on until the run closes them or ends. A worker that is lost (for want of memory,
    for example) is a ``UserError`` at the next question to it, and closing does not wait for it.

    :param env_fns: Functions that make an environment
    """

    def __init__(self, env_fns: list[Callable[[], gym.Env]]) -> None:
        try:
            super().__init__([partial(_undisturbed, make) for make in env_fns])
        except (ConnectionError, EOFError) as error:
            raise UserError("an environment process ended while it made its environment; its error is above") from error
        self.remotes: Any = tuple(_Pipe(remote, self._describe_lost) for remote in self.remotes)
        self._has_lost = False
        # Before multiprocessing's own exit, which sends SIGTERM and waits.
        atexit.register(self._hang_up)

    def close(self) -> None:
        # SB3's close waits for the answers of all workers, also for those that it has read before it met the lost one.
        with suppress(UserError, OSError):
            if not self._has_lost:
                super().close()
        if not self.closed:
            self._hang_up()
            for process in self.processes:
                process.join()
            self.closed = True
        atexit.unregister(self._hang_up)

    def _hang_up(self) -> None:
        """Close the pipes: the workers end."""
        for remote in self.remotes:
            remote.close()

    def _describe_lost(self) -> str:
        self._has_lost = True
        multiprocessing.connection.wait([process.sentinel for process in self.processes], TELL_S)
        for number, process in enumerate(self.processes):
            code = process.exitcode
            if code is not None:
                how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
                why = "; is there enough memory for all of them?" if code == -signal.SIGKILL else ""
                return f"worker {number} of {len(self.processes)} environment processes {how}{why}"
        return f"a worker of {len(self.processes)} environment processes does not answer"


def _undisturbed(make: Callable[[], gym.Env]) -> gym.Env:
    """Make an environment in a worker process, to which no signal says when to end."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    return make()
