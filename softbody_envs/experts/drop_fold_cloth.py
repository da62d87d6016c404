"""Expert for DropFoldCloth: lower the cloth, lay its lower half on the floor, and fold the upper half over it."""

import numpy as np

from softbody_envs.experts.fold_cloth import Script, ScriptedExpert, corners, pickers
from softbody_envs.tasks.drop_fold_cloth import PICKER_REACH

#: Height of the lower corners at which the cloth hangs freely, so that its length is known, m.
HANGING = 0.02
#: Lift per control step until then, m.
LIFT = 0.01
#: Control steps of each movement.
LOWER_STEPS = 8
LAY_STEPS = 20
FOLD_STEPS = 16
#: Angle between the hanging part and the vertical while the cloth is laid down, rad: it must not fold under itself.
LEAN = 0.3
UP = np.array([0.0, 0.0, 1.0])


class DropFoldClothExpert(ScriptedExpert):
    """Folds without releasing the cloth before the end."""

    reach = PICKER_REACH

    def script(self, state: np.ndarray) -> Script:
        """Lift the cloth until it hangs freely, lower it, lay its lower half on the floor, fold the upper half, release."""
        while corners(state)[2:, 2].min() < HANGING:
            state = yield self.go(pickers(state) + LIFT * UP, state, pick=True)
        held, free = corners(state)[:2], corners(state)[2:]
        grip = (pickers(state) - held) * UP
        length = np.linalg.norm(held - free, axis=1).mean()
        forward = np.cross(held[1] - held[0], UP)
        forward /= np.linalg.norm(forward)
        place = held * (1, 1, 0)  # the goal of the free edge is on the floor below the held edge

        for height in np.linspace(held[:, 2].mean(), length, self.pace.actions(LOWER_STEPS) + 1)[1:]:
            state = yield self.go(place + height * UP + grip, state, pick=True)
        for laid in length / 2 * np.linspace(0, 1, self.pace.actions(LAY_STEPS) + 1)[1:]:
            lean = LEAN * min(1.0, 6 * laid / length)
            rest = (length - laid) * (np.cos(lean) * UP - np.sin(lean) * forward)
            state = yield self.go(place - laid * forward + rest + grip, state, pick=True)
        start = np.pi / 2 + lean
        for angle in start * np.linspace(1, 0, self.pace.actions(FOLD_STEPS) + 1)[1:]:
            rest = length / 2 * (np.cos(angle) * forward + np.sin(angle) * UP)
            goal = place - length / 2 * forward + rest + grip
            state = yield self.go(goal, state, pick=True)
        yield from self.leave(state)
