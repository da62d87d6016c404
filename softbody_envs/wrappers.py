"""Wrappers for training settings (``env_wrapper``)."""

from typing import Any

import gymnasium as gym
import numpy as np


class ActionRepeat(gym.Wrapper[Any, np.ndarray, Any, np.ndarray], gym.utils.RecordConstructorArgs):
    """
    Repeats each action, made smaller first, until the episode ends; the rewards of the repetitions add up.

    Exploration goes on for longer in one direction, and returns have fewer steps. The tasks' grip (a pick above 0) has
    a sign only, which a smaller action keeps.

    :param env: with a ``Box`` action space
    :param repeat: control steps of each action, at least 1
    :param scale: factor on the actions, above 0 and at most 1
    :raises ValueError: on another ``repeat`` or ``scale``
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

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See ``gymnasium.Env.step``; observation and info are those of the last repetition."""
        space = self.action_space
        smaller = self.scale * np.clip(action, space.low, space.high)  # type: ignore[attr-defined]
        total = 0.0
        for _ in range(self.repeat):
            observation, reward, terminated, truncated, info = self.env.step(smaller.astype(np.float32))
            total += float(reward)
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, info
