"""Worker processes of environments: signals are left to the run's process, and a lost worker is an error at once."""

import atexit
import multiprocessing.connection
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import SubprocVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_por.common.errors import UserError

#: Seconds within which the end of a lost worker is known
TELL_S = 5.0


class WorkerProcesses(SubprocVecEnv):
    """
    SB3's ``SubprocVecEnv`` for long runs.

    Ctrl-C and the SIGTERM of a cluster reach all processes of a job. SB3's workers end then, and the run has no environments
    to write its checkpoint with; these go on until the run closes them or ends. A worker that is lost (for want of memory,
    for example) is a ``UserError`` at the next step, and closing does not wait for it.

    :param env_fns: Functions that make an environment
    """

    def __init__(self, env_fns: list[Callable[[], gym.Env]]) -> None:
        super().__init__([partial(_undisturbed, make) for make in env_fns])
        self._has_lost = False
        # Before multiprocessing's own exit, which sends SIGTERM and waits.
        atexit.register(self._hang_up)

    def step_async(self, actions: np.ndarray) -> None:
        with self._noticing_lost():
            super().step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        with self._noticing_lost():
            return super().step_wait()

    def reset(self) -> VecEnvObs:
        with self._noticing_lost():
            return super().reset()

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        with self._noticing_lost():
            return super().env_method(method_name, *args, indices=indices, **kwargs)

    def close(self) -> None:
        # SB3's close waits for the answers of all workers, also for those that it has read before it met the lost one.
        with suppress(EOFError, OSError):
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

    @contextmanager
    def _noticing_lost(self) -> Iterator[None]:
        """
        :raises UserError: If a worker has ended
        """
        try:
            yield
        except (EOFError, ConnectionError) as error:
            self._has_lost = True
            raise UserError(self._describe_lost()) from error

    def _describe_lost(self) -> str:
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
