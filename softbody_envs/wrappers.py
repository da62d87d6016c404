"""Wrappers for training settings (``env_wrapper``)."""

from typing import Any

import gymnasium as gym
import numpy as np


class ActionRepeat(gym.Wrapper[Any, np.ndarray, Any, np.ndarray], gym.utils.RecordConstructorArgs):
    """
    Scale each action and repeat it. Rewards of the repetitions are summed; the end of an episode ends the repetition.

    Random exploration moves farther in one direction, and returns have fewer steps. Scaling does not affect grasping, for
    which only the sign of the action counts.

    :param env: Environment with a ``Box`` action space
    :param repeat: Control steps per action, at least 1
    :param scale: Factor on the actions, above 0 and at most 1
    :raises ValueError: If ``repeat`` or ``scale`` is out of range
    """

    def __init__(self, env: gym.Env[Any, np.ndarray], repeat: int, scale: float = 1.0):
        gym.utils.RecordConstructorArgs.__init__(self, repeat=repeat, scale=scale)
        gym.Wrapper.__init__(self, env)
        if repeat < 1 or repeat != int(repeat):
            raise ValueError(f"repeat must be a whole number of at least 1, got {repeat!r}")
        if not 0.0 < scale <= 1.0:
            raise ValueError(f"scale must be above 0 and at most 1, got {scale!r}")
        self.repeat = int(repeat)
        self.scale = scale
        if "render_fps" in env.metadata:  # video recorders get one frame per repeated action
            self.metadata = env.metadata | {"render_fps": env.metadata["render_fps"] / self.repeat}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See ``gymnasium.Env.step``. Observation and info are those of the last repetition."""
        space = self.action_space
        assert isinstance(space, gym.spaces.Box)
        scaled = self.scale * np.clip(action, space.low, space.high)
        total = 0.0
        for _ in range(self.repeat):
            observation, reward, terminated, truncated, info = self.env.step(scaled.astype(np.float32))
            total += float(reward)
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, info


class ProgressReward(gym.Wrapper[Any, np.ndarray, Any, np.ndarray], gym.utils.RecordConstructorArgs):
    """
    Reward the change of ``info["normalized_performance"]`` instead of its level.

    SoftGym's rewards are levels: an episode that starts far from the goal pays for the distance at every step, whatever the
    agent does. The undiscounted sum of the progress is the final performance times ``scale``, which is the score of these
    tasks. With a discount gamma the return weighs early progress more: it is the level-based return of
    ``(1 - gamma) * performance``, plus a term for the end of the episode. In contrast to potential-based shaping, which adds
    ``gamma * potential' - potential`` to a reward and keeps its optimal policies, progress *replaces* the reward: an agent may
    prefer a quick half of the task to a slow whole one if gamma is small.

    :param env: Environment that reports ``info["normalized_performance"]`` at resets and steps
    :param scale: Factor on the change, above 0
    :raises ValueError: If ``scale`` is not above 0
    """

    def __init__(self, env: gym.Env[Any, np.ndarray], scale: float = 10.0):
        gym.utils.RecordConstructorArgs.__init__(self, scale=scale)
        gym.Wrapper.__init__(self, env)
        if not scale > 0.0:
            raise ValueError(f"scale must be above 0, got {scale!r}")
        self.scale = scale
        self._performance = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See ``gymnasium.Env.reset``."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._performance = info["normalized_performance"]
        return observation, info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See ``gymnasium.Env.step``; the reward is ``scale`` times the change of the normalized performance."""
        observation, _, terminated, truncated, info = self.env.step(action)
        change = info["normalized_performance"] - self._performance
        self._performance = info["normalized_performance"]
        return observation, self.scale * change, terminated, truncated, info
