"""Bring the spout beside the target's rim, then tilt about it."""

import numpy as np

from softbody_envs.sim.cups import WALL
from softbody_envs.tasks.pour_water import MARGIN, REACH

#: The spout reaches this far over the corner of the zone around the target that the cup may not enter, m.
OVERHANG = 0.11
#: Distance kept from that zone, m.
GAP = 0.01
#: Tilt per control step, rad, and the tilt at which nothing is left.
TILT_RATE = 0.06
LAST_TILT = 2.4


class PourWaterExpert:
    """Pours all of it."""

    def reset(self) -> None:
        """There is nothing to forget."""

    def act(self, state: np.ndarray) -> np.ndarray:
        """Go to where the spout belongs at the present tilt; once there, tilt on."""
        position, tilt = state[:2], state[2]
        half, rim = state[3] / 2 + WALL, state[5] + WALL
        target_x, target_rim, target_half = state[6], state[7] + WALL, state[8] / 2 + WALL
        corner = np.array([target_x - target_half - MARGIN, target_rim + MARGIN])

        def place(angle: float) -> np.ndarray:
            """Where the cup belongs: its spout lies on the wall that leans over the corner, from a quarter turn on level."""
            lean = min(angle, np.pi / 2)
            along, away = np.array([np.sin(lean), np.cos(lean)]), np.array([-np.cos(lean), np.sin(lean)])
            cos, sin = np.cos(angle), np.sin(angle)
            spout = np.array([cos * half + sin * rim, cos * rim - sin * half])
            return corner + OVERHANG * along + GAP * away - spout

        offset = place(tilt) - position
        if np.abs(offset).max() < 0.02 and self.wants_more(state):
            tilt_change = min(TILT_RATE, LAST_TILT - tilt)
            offset = place(tilt + tilt_change) - position
        else:
            tilt_change = 0.0
        return np.clip(np.array([*offset, tilt_change]) / REACH, -1.0, 1.0)

    def wants_more(self, state: np.ndarray) -> bool:
        """Whether to go on pouring."""
        return True
