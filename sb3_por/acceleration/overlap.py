"""Training while the environments step."""

from collections.abc import Callable

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn


class OverlappedEnv(VecEnvWrapper):
    """
    Do some work between sending the actions and waiting for the results, while worker processes step.

    :param venv: The environments; worker processes (``SubprocVecEnv``) for a gain
    :param work: What to do in between
    """

    def __init__(self, venv: VecEnv, work: Callable[[], None]):
        super().__init__(venv)
        self.work = work

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        self.work()
        return self.venv.step_wait()
