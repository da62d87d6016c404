"""Training while the environments step."""

from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback, RolloutReturn
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn


class OverlappedEnv(VecEnvWrapper):
    """
    Do some work between sending the actions and waiting for the results, while worker processes step.

    :param venv: The environments; worker processes (``SubprocVecEnv``) for a gain
    :param work: Called in between
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


class OverlappedTraining(OffPolicyAlgorithm):
    """
    A mixin that puts the updates of a rollout into the first step of the next rollout, if ``overlap`` is set. They run
    between sending the actions and waiting for the results, always in the same order, so runs stay reproducible.
    """

    overlap: bool
    actor: Any
    _defers_updates = False
    _updates_due = 0

    def _defer(self, gradient_steps: int) -> bool:
        """
        :param gradient_steps: Number of updates that are due now
        :return: Whether they are deferred to the first step of the next rollout
        """
        deferred, self._defers_updates = self._defers_updates, False
        self._updates_due += gradient_steps * deferred
        return deferred

    def collect_rollouts(self, env: VecEnv, *args: Any, **kwargs: Any) -> RolloutReturn:
        if not self.overlap:
            return super().collect_rollouts(env, *args, **kwargs)
        rollout = super().collect_rollouts(OverlappedEnv(env, self._train_due), *args, **kwargs)
        # SB3 calls train() next
        self._defers_updates = True
        return rollout

    def _train_due(self) -> None:
        """Make the updates that are due; the policy acts in evaluation mode afterwards."""
        self._defers_updates = False
        if self._updates_due > 0:
            updates, self._updates_due = self._updates_due, 0
            self.train(updates, self.batch_size)
            self.policy.set_training_mode(False)
            if self.use_sde:  # the update has drawn one noise matrix for its batch
                self.actor.reset_noise(self.n_envs)

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Any:
        super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        self._train_due()
        return self
