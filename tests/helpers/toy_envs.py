"""Tiny pixel environments in pure numpy, fast enough for tests."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class DotEnv(gym.Env):
    """
    A bright dot moves left and right as the action says; the reward is 1 minus its distance from the middle.
    The time limit truncates. With ``falling=True`` the dot also falls one row a step: an order to learn.

    :param size: Height and width in pixels
    :param horizon: Steps until truncation
    :param falling: Let the dot fall
    :param obs_type: ``"pixels"``, ``"state"`` or ``"dict"``
    """

    def __init__(self, size: int = 32, horizon: int = 20, falling: bool = False, obs_type: str = "pixels"):
        self.size, self.horizon, self.falling, self.obs_type = size, horizon, falling, obs_type
        image = spaces.Box(0, 255, (size, size, 3), np.uint8)
        state = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = {
            "pixels": image,
            "state": state,
            "dict": spaces.Dict({"image": image, "state": state}),
        }[obs_type]
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x = float(self.np_random.uniform(0, 1))
        self.t = 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.x = float(np.clip(self.x + 0.1 * float(action[0]), 0, 1))
        self.t += 1
        return self._observe(), 1 - 2 * abs(self.x - 0.5), False, self.t >= self.horizon, {}

    def _observe(self) -> Any:
        image = np.zeros((self.size, self.size, 3), np.uint8)
        row = int(self.t / self.horizon * (self.size - 6)) if self.falling else self.size // 2 - 3
        column = round(self.x * (self.size - 6))
        image[row : row + 6, column : column + 6] = (255, 200, 100)
        state = np.array([2 * self.x - 1, 2 * self.t / self.horizon - 1], np.float32)
        return {"pixels": image, "state": state, "dict": {"image": image, "state": state}}[self.obs_type]
