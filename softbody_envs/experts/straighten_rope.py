"""Take the rope by both ends and pull them apart."""

import numpy as np

from softbody_envs.sim.pickers import REACH
from softbody_envs.sim.rope import LENGTH
from softbody_envs.tasks.straighten_rope import LOW

#: A picker grasps when it is this close to its end of the rope, m, and grasps anew when the end is farther away than this.
CLOSE = 0.015
#: Ends nearer to each other than this say nothing about where to pull, m.
APART = 0.01


class StraightenRopeExpert:
    """Each picker goes to the end that is nearer, both grasp, and then they part in the direction in which the ends lie."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget which picker is for which end."""
        self._swapped: bool | None = None

    def act(self, state: np.ndarray) -> np.ndarray:
        nodes, pickers, holds = state[:30].reshape(10, 3), state[30:36].reshape(2, 3), state[36:38] > 0.5
        ends = nodes[[0, -1]]
        if self._swapped is None:
            straight, crossed = np.linalg.norm(pickers - ends), np.linalg.norm(pickers - ends[::-1])
            self._swapped = bool(crossed < straight)
        if self._swapped:
            ends = ends[::-1]
        offsets = np.maximum(ends, LOW) - pickers
        near = np.linalg.norm(offsets, axis=1) < CLOSE
        picks = np.where(near, 1.0, -1.0)
        if (holds & near).all():
            offsets = self._targets(ends) - ends
        return np.concatenate([np.clip(offsets / REACH, -1.0, 1.0), picks[:, None]], axis=1).ravel()

    @staticmethod
    def _targets(ends: np.ndarray) -> np.ndarray:
        """Where the ends belong: a rope's length apart, in the middle of the floor."""
        direction = (ends[1] - ends[0]) * (1.0, 1.0, 0.0)
        distance = np.linalg.norm(direction)
        direction = direction / distance if distance > APART else np.array([0.0, -1.0, 0.0])
        return np.outer([-0.5, 0.5], direction) * LENGTH
