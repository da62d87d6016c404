"""Expert for StraightenRope: grasp both ends of the rope and pull them apart."""

import numpy as np

from softbody_envs.experts.pace import FULL_SPEED, Pace
from softbody_envs.sim.pickers import REACH
from softbody_envs.sim.rope import LENGTH
from softbody_envs.tasks.straighten_rope import LOW

#: Distance between picker and end of the rope at which the picker grasps, m, within the range of the task and more than the
#: error of who sees images only. It grasps again if the end is farther away.
CLOSE = 0.025
#: Height above an end at which a picker that cannot open travels to it, out of reach of the rope, m.
TRAVEL_HEIGHT = 0.07
#: Smallest distance between the ends at which it defines the direction of the pull, m.
APART = 0.01


class StraightenRopeExpert:
    """
    Sends each picker to its own end, the red one to the yellow end and the green one to the magenta end. Once both hold, they
    move apart along the line through the ends. Pickers that cannot open would grasp what lies on their way: they come from
    above, and keep what they have got.
    """

    def __init__(self, pace: Pace = FULL_SPEED) -> None:
        self._reach = REACH * pace.stride
        self._keep_hold = pace.keep_hold

    def reset(self) -> None:
        """Do nothing: the expert has no memory."""

    def act(self, state: np.ndarray) -> np.ndarray:
        nodes, pickers, holds = state[:30].reshape(10, 3), state[30:36].reshape(2, 3), state[36:38] > 0.5
        ends = nodes[[0, -1]]
        offsets = np.maximum(ends, LOW) - pickers
        if self._keep_hold:
            offsets[np.linalg.norm(offsets[:, :2], axis=1) >= CLOSE, 2] += TRAVEL_HEIGHT
            offsets[holds] = 0.0
            near = np.full(2, True)
        else:
            near = np.linalg.norm(offsets, axis=1) < CLOSE
        picks = np.where(near, 1.0, -1.0)
        if (holds & near).all():
            offsets = self._targets(ends) - ends
        return np.concatenate([np.clip(offsets / self._reach, -1.0, 1.0), picks[:, None]], axis=1).ravel()

    @staticmethod
    def _targets(ends: np.ndarray) -> np.ndarray:
        """Goals of the ends: a rope's length apart, centred at the origin."""
        direction = (ends[1] - ends[0]) * (1.0, 1.0, 0.0)
        distance = np.linalg.norm(direction)
        direction = direction / distance if distance > APART else np.array([0.0, -1.0, 0.0])
        return np.outer([-0.5, 0.5], direction) * LENGTH
