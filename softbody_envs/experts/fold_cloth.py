"""Expert for FoldCloth: grasp two corners and carry them over the cloth to the opposite corners."""

from abc import ABC, abstractmethod
from collections.abc import Generator

import numpy as np

from softbody_envs.experts.pace import FULL_SPEED, Pace
from softbody_envs.sim.pickers import REACH

#: Height of a picker's centre above a corner when it grasps it, m, and while it travels to it, m.
GRASP_HEIGHT = 0.045
TRAVEL_HEIGHT = 0.10
#: Control steps in which the edge is carried, and its largest height, as a fraction of half the length of the cloth.
CARRY_STEPS = 28
ARCH = 0.95
#: Fewest actions in which the edge is carried: their chords must draw an arc.
FEWEST_CARRIES = 5
#: Distance at which a position counts as reached, m.
NEAR = 0.01

#: A script yields actions and is sent the states that follow.
Script = Generator[np.ndarray, np.ndarray, None]


class ScriptedExpert(ABC):
    """An expert that follows a script: one action after the other."""

    #: Largest move of a picker along each axis in one control step at full speed, m.
    reach = REACH

    def __init__(self, pace: Pace = FULL_SPEED) -> None:
        self.pace = pace
        self._script: Script | None = None

    def reset(self) -> None:
        """Restart the script at the next state."""
        self._script = None

    def act(self, state: np.ndarray) -> np.ndarray:
        """Return the next action of the script."""
        state = np.asarray(state, dtype=np.float64)
        if self._script is not None:
            return self._script.send(state)
        self._script = self.script(state)
        return next(self._script)

    def go(self, goals: np.ndarray, state: np.ndarray, pick: bool) -> np.ndarray:
        """Action that moves the pickers to their goals, m, ``(2, 3)``, or as far toward them as they come on each axis."""
        move = np.clip((goals - pickers(state)) / (self.reach * self.pace.stride), -1.0, 1.0)
        return np.column_stack([move, np.full(2, 1.0 if pick or self.pace.keep_hold else -1.0)]).ravel()

    def leave(self, state: np.ndarray) -> Script:
        """Release, rise, and stay there; only stay if the hands cannot open."""
        goals = pickers(state)
        state = yield self.go(goals, state, pick=False)
        if not self.pace.keep_hold:
            goals = goals + (0.0, 0.0, TRAVEL_HEIGHT)
        while True:
            state = yield self.go(goals, state, pick=False)

    @abstractmethod
    def script(self, state: np.ndarray) -> Script:
        """Start a script, which never ends, in a state."""


def corners(state: np.ndarray) -> np.ndarray:
    """Corners of the cloth: the two to carry, then the two where those belong, m, ``(4, 3)``."""
    return state[:12].reshape(4, 3)


def pickers(state: np.ndarray) -> np.ndarray:
    """Centres of the pickers, m, ``(2, 3)``."""
    return state[12:18].reshape(2, 3)


def holding(state: np.ndarray) -> np.ndarray:
    """Whether each picker holds the cloth, bool ``(2,)``."""
    return state[18:20] > 0.5


class FoldClothExpert(ScriptedExpert):
    """Folds the cloth along its middle."""

    def script(self, state: np.ndarray) -> Script:
        """Travel to the corners, descend, grasp them, carry them along an arc, and release."""
        for height in (TRAVEL_HEIGHT, GRASP_HEIGHT):
            while True:
                goals = corners(state)[:2] + (0.0, 0.0, height)
                if np.abs(goals - pickers(state)).max() < NEAR or holding(state).all():
                    break
                state = yield self.go(goals, state, pick=False)
        while not holding(state).all():
            state = yield self.go(pickers(state), state, pick=True)

        start, way = pickers(state), corners(state)[2:] - corners(state)[:2]
        radius = np.linalg.norm(way, axis=1, keepdims=True) / 2
        for angle in np.pi * np.linspace(0, 1, self.pace.actions(CARRY_STEPS, FEWEST_CARRIES) + 1)[1:]:
            rise = ARCH * radius * np.sin(angle) * (0.0, 0.0, 1.0)
            state = yield self.go(start + way * (1 - np.cos(angle)) / 2 + rise, state, pick=True)
        yield from self.leave(state)
