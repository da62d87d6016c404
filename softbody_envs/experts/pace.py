"""Pace of an agent: how far its actions carry, and how long they last."""

import math
from dataclasses import dataclass
from typing import Any

import gymnasium as gym

from softbody_envs.wrappers import ActionRepeat


@dataclass(frozen=True)
class Pace:
    """
    What becomes of an agent's action before it reaches the task.

    :param repeat: Control steps per action
    :param scale: Factor on the actions
    :param keep_hold: Whether pickers hold whatever they reach, regardless of the actions
    """

    repeat: int = 1
    scale: float = 1.0
    keep_hold: bool = False

    @classmethod
    def of(cls, env: gym.Env[Any, Any]) -> "Pace":
        """
        :param env: One of our tasks inside any wrappers
        :return: The pace that its ``ActionRepeat`` wrappers and its arguments set
        """
        repeat, scale = 1, 1.0
        task = env.unwrapped
        while env is not task:
            if isinstance(env, ActionRepeat):
                repeat, scale = repeat * env.repeat, scale * env.scale
            env = env.env  # type: ignore[attr-defined]  # a wrapper, since it is not the task
        return cls(repeat, scale, getattr(task, "keep_hold", False))

    @property
    def stride(self) -> float:
        """Moves of a control step at full speed that an action of 1 carries."""
        return self.repeat * self.scale

    def actions(self, control_steps: int, at_least: int = 1) -> int:
        """
        :param control_steps: Control steps that a movement takes
        :param at_least: Smallest number of actions that it needs
        :return: Number of actions for it
        """
        return max(math.ceil(control_steps / self.repeat), at_least)


#: One action per control step, as it is.
FULL_SPEED = Pace()
