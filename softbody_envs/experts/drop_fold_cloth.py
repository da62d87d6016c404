"""Lower the hanging cloth, lay its lower half on the floor, and fold the upper half over it."""

from functools import partial

import numpy as np

from softbody_envs.experts import fold_cloth
from softbody_envs.experts.fold_cloth import Script, ScriptedExpert, corners, leave, pickers
from softbody_envs.tasks.drop_fold_cloth import PICKER_REACH

#: The cloth hangs free, so that its length can be seen, when its lower corners are this high, m.
HANGING = 0.02
#: How far one step lifts it until then, m.
LIFT = 0.01
#: Control steps of each movement.
LOWER_STEPS = 8
LAY_STEPS = 20
FOLD_STEPS = 16
#: The cloth is laid with its free part at this angle to the vertical, rad, so that it does not fold under itself.
LEAN = 0.3
UP = np.array([0.0, 0.0, 1.0])

go = partial(fold_cloth.go, reach=PICKER_REACH)


class DropFoldClothExpert(ScriptedExpert):
    """Folds without ever letting go."""

    def script(self, state: np.ndarray) -> Script:
        """Lift the cloth until it hangs, then three arcs of the held edge; the pickers stay above the corners they hold."""
        while corners(state)[2:, 2].min() < HANGING:
            state = yield go(pickers(state) + LIFT * UP, state, pick=True)
        held, free = corners(state)[:2], corners(state)[2:]
        grip = (pickers(state) - held) * UP
        length = np.linalg.norm(held - free, axis=1).mean()
        forward = np.cross(held[1] - held[0], UP)
        forward /= np.linalg.norm(forward)
        place = held * (1, 1, 0)  # the free edge belongs on the floor beneath the held one

        for height in np.linspace(held[:, 2].mean(), length, LOWER_STEPS + 1)[1:]:
            state = yield go(place + height * UP + grip, state, pick=True)
        for laid in length / 2 * np.linspace(0, 1, LAY_STEPS + 1)[1:]:
            lean = LEAN * min(1.0, 6 * laid / length)
            rest = (length - laid) * (np.cos(lean) * UP - np.sin(lean) * forward)
            state = yield go(place - laid * forward + rest + grip, state, pick=True)
        start = np.pi / 2 + lean
        for angle in start * np.linspace(1, 0, FOLD_STEPS + 1)[1:]:
            rest = length / 2 * (np.cos(angle) * forward + np.sin(angle) * UP)
            goal = place - length / 2 * forward + rest + grip
            state = yield go(goal, state, pick=True)
        yield from leave(state)
