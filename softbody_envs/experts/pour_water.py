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
#: Tilt per control step near the end of a measured pour, rad.
SLOWEST_TILT_RATE = 0.015


#: What flows now goes on flowing for this many control steps after the cup begins to tilt back.
FORESIGHT = 4
#: What still slips out while the cup tilts back, as a share of all water.
RESERVE = 0.04
#: Tilted slowly, the cup loses these shares of its water at about these tilts (rad), whatever its size: the spheres lie in
#: a lattice that gives way at a certain slope.
SHARE_LEFT = (0.0, 0.2, 0.5, 0.8, 1.0)
TILT_THEN = (1.45, 1.6, 1.69, 1.76, 1.82)
#: The slow part begins this much before, rad.
HEADROOM = 0.25


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
        tilt_change = 0.0
        if np.abs(offset).max() < 0.02:
            tilt_change = np.clip(tilt + self.tilt_rate(state), 0.0, LAST_TILT) - tilt
            offset = place(tilt + tilt_change) - position
        return np.clip(np.array([*offset, tilt_change]) / REACH, -1.0, 1.0)

    def tilt_rate(self, state: np.ndarray) -> float:
        """How far to tilt in this control step, rad."""
        return TILT_RATE


class PourWaterAmountExpert(PourWaterExpert):
    """Tilts quickly to just before the wanted share leaves the cup, then little by little, and back as soon as it has left."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget what had left the cup."""
        self._left = 0.0

    def tilt_rate(self, state: np.ndarray) -> float:
        left, wanted = 1.0 - state[12], state[14]
        flow, self._left = left - self._left, left
        if left + FORESIGHT * flow >= wanted - RESERVE:
            return -REACH[2]
        if flow > 0.0:
            return 0.0
        return TILT_RATE if state[2] < np.interp(wanted, SHARE_LEFT, TILT_THEN) - HEADROOM else SLOWEST_TILT_RATE
