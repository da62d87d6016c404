"""Experts for PourWater and PourWaterAmount: bring the spout to the rim of the target, then tilt the cup about it."""

from typing import Any

import numpy as np

from softbody_envs.experts.pace import FULL_SPEED, Pace
from softbody_envs.sim.cups import WALL
from softbody_envs.tasks.pour_water import MARGIN, REACH
from softbody_envs.tasks.pour_water_amount import PourWaterAmountEnv

#: Distance by which the spout extends over the corner of the zone around the target that the cup may not enter, m.
OVERHANG = 0.11
#: Distance of the cup from that zone, m.
GAP = 0.01
#: Tilt per control step, rad, and tilt at which the cup is empty, rad.
TILT_RATE = 0.06
LAST_TILT = 2.4
#: Largest tilt of one action, rad. The cup turns and moves along a chord of its way, which must not enter that zone.
LARGEST_TILT = 0.4
#: Tilt per control step near the end of a measured pour, rad.
SLOWEST_TILT_RATE = 0.015
#: Control steps for which the present flow continues after the cup begins to tilt back.
FORESIGHT = 4
#: Fraction of the water that leaves the cup while it tilts back, in addition to the flow.
RESERVE = 0.04
#: Fractions of the water that have left a slowly tilted cup of any size, and the tilts at which they have, rad. The spheres
#: form a lattice, which gives way at a certain slope.
FRACTIONS_LEFT = (0.0, 0.2, 0.5, 0.8, 1.0)
TILTS = (1.45, 1.6, 1.69, 1.76, 1.82)
#: Water that leaves the cup in a control step, as a fraction of all, below which the next action need not wait for it.
TRICKLE = 0.002
#: The same fractions and tilts for a cup that actions of several control steps have tilted to there.
QUICK_FRACTIONS_LEFT = (0.0, 0.1, 0.3, 0.5, 0.66, 0.85, 1.0)
QUICK_TILTS = (1.3, 1.38, 1.46, 1.52, 1.62, 1.7, 1.78)
#: Number of such actions until there, and largest tilt of each that follows, rad.
FIRST_ACTIONS = 3.5
LARGEST_CORRECTION = 0.05
#: First distance of the planned tilt from the expected one, and its change with the second attempt, rad.
FIRST_AIM = (-0.08, 0.06)
#: Attempts at one scene.
ATTEMPTS = 8
#: Tilt before the expected one at which slow tilting begins, rad.
HEADROOM = 0.25


class PourWaterExpert:
    """Pours all the water."""

    def __init__(self, pace: Pace = FULL_SPEED) -> None:
        self._pace = pace
        self._reach = REACH * pace.stride
        self.reset()

    def reset(self) -> None:
        """Do nothing: the expert has no memory."""

    def act(self, state: np.ndarray) -> np.ndarray:
        """Move to the pouring position for the present tilt. Once there, tilt further."""
        seen = named(state)
        position, tilt = np.array([seen["cup x"], seen["cup z"]]), seen["cup tilt"]
        half, rim = seen["cup inner length"] / 2 + WALL, seen["cup height"] + WALL
        target_rim, target_half = seen["target height"] + WALL, seen["target inner length"] / 2 + WALL
        corner = np.array([seen["target x"] - target_half - MARGIN, target_rim + MARGIN])

        def place(angle: float) -> np.ndarray:
            """Pouring position: the cup's side lies on a line over the corner, level from a quarter turn on."""
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
        return np.clip(np.array([*offset, tilt_change]) / self._reach, -1.0, 1.0)

    def tilt_rate(self, state: np.ndarray) -> float:
        """Tilt of the next action, rad."""
        return min(self._pace.repeat * TILT_RATE, LARGEST_TILT)


class PourWaterAmountExpert(PourWaterExpert):
    """
    Tilts quickly until shortly before the goal, then in small steps, and back as soon as enough water has left the cup.

    An action that lasts for several control steps cannot be taken back in time when the water comes in a surge. Then the
    expert tilts to where about enough water should leave, waits, and corrects. With another plan it may try a scene again.
    """

    def __init__(self, pace: Pace = FULL_SPEED) -> None:
        super().__init__(pace)
        self.attempts = 1 if pace.repeat == 1 else ATTEMPTS

    def reset(self) -> None:
        """Forget the episode, and the plans of former attempts."""
        self._left = self._goal = 0.0
        self._aim, self._change = FIRST_AIM

    def retry(self) -> None:
        """Plan to tilt further at first if too little water has left the cup, or less far if too much has."""
        self._aim += np.copysign(self._change, self._goal - self._left)
        self._change *= 0.7
        self._left = 0.0

    def tilt_rate(self, state: np.ndarray) -> float:
        seen = named(state)
        left, goal, tilt = 1.0 - seen["fraction in cup"], seen["target fraction"], seen["cup tilt"]
        flow = (left - self._left) / self._pace.repeat
        self._left, self._goal = left, goal
        if left + FORESIGHT * flow >= goal - RESERVE:
            return -self._reach[2]
        if flow > TRICKLE:
            return 0.0
        if self._pace.repeat == 1:
            expected_tilt = np.interp(goal, FRACTIONS_LEFT, TILTS)
            return TILT_RATE if tilt < expected_tilt - HEADROOM else SLOWEST_TILT_RATE
        goal_tilt, tilt_so_far = np.interp([goal, left], QUICK_FRACTIONS_LEFT, QUICK_TILTS)
        planned = goal_tilt + self._aim
        if left < 0.02 and tilt < planned - 0.02:
            return min(planned / FIRST_ACTIONS, planned - tilt)
        return float(np.clip(goal_tilt - tilt_so_far, 0.0, LARGEST_CORRECTION))


def named(state: np.ndarray) -> dict[str, Any]:
    """Elements of the state vector by their names; PourWater has all but the last two."""
    return dict(zip(PourWaterAmountEnv.state_names, state, strict=False))
