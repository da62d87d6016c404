"""FallingBall: a diagnostic in which the order of any two frames shows."""

from typing import ClassVar

import numpy as np

from softbody_envs.env import SoftbodyEnv
from softbody_envs.rendering import Camera
from softbody_envs.sim.ball import RADIUS, Ball
from softbody_envs.sim.world import World

#: Control steps of an episode, and how far the ball sinks in each, m: more than a pixel of 64.
HORIZON = 50
SINK = 0.034
#: Height of the centre at first, m, and of the lowest ball's centre at the end.
STARTS = (1.83, 1.87)
LOWEST = STARTS[0] - HORIZON * SINK
#: How far an action moves the ball sideways, m, and how far from the middle it may be.
DRIFT = 0.01
SIDE = 0.6


class FallingBallEnv(SoftbodyEnv):
    """
    ## Description

    A ball sinks at a constant speed, as in oil, through the whole episode. There is nothing to achieve: of any two frames
    of an episode the one with the lower ball is the later one, so that a method that learns the order of frames must
    succeed here.

    ## Action Space

    `Box(-1, 1, (1,), float32)`: moves the ball sideways by up to 1 cm in a step, which changes neither its fall nor the
    reward.

    ## Observation Space

    `obs_type="pixels"`: an RGB image. `obs_type="state"`: `Box(-10, 10, (2,), float32)`:

    | Num | Observation | Unit |
    |-----|-------------|------|
    | 0 | x of the ball, to the right | m |
    | 1 | height of the ball | m |

    ## Rewards

    Each step: the fraction of its way that the ball has come, whatever the action.

    `performance` and `normalized_performance` are this reward; `is_success` from 0.9 on; `monotone` is how far the ball has
    sunk, in m: it rises in every step.

    ## Starting State

    The ball near the upper edge of the image. A variation draws its height (1.83 to 1.87 m) and x (-0.5 to 0.5 m).

    ## Episode End

    Truncation after 50 steps (4 s), when the ball is near the lower edge of the image.

    ## Arguments

    See `SoftbodyEnv`.

    ## Differences from SoftGym

    SoftGym has no such task.

    ## Version History

    * v0: initial version
    """

    scenes: ClassVar[str] = "FallingBallEnv"
    camera: ClassVar[Camera] = Camera(position=(0.0, -2.5, 1.0), target=(0.0, 0.0, 1.0))
    action_size: ClassVar[int] = 1
    state_names: ClassVar[tuple[str, ...]] = ("ball x", "ball z")
    best_performance: ClassVar[float] = 1.0
    success_threshold: ClassVar[float] = 0.9
    steps_per_control: ClassVar[int] = 1

    def _build(self, world: World, rng: np.random.Generator) -> None:
        world.add_floor(LOWEST - RADIUS)
        self._ball = Ball(world)
        self._x = rng.uniform(-0.5, 0.5)
        self._z = self._start = rng.uniform(*STARTS)
        self._ball.move((self._x, 0.0, self._z))

    def _control(self, action: np.ndarray) -> None:
        self._x = float(np.clip(self._x + DRIFT * action[0], -SIDE, SIDE))
        self._z -= SINK
        self._ball.move((self._x, 0.0, self._z))

    def _measure(self) -> np.ndarray:
        return np.array([self._x, self._z])

    def performance(self) -> float:
        """Fraction of the way down that is done."""
        return self.monotone() / (HORIZON * SINK)

    def monotone(self) -> float:
        """How far the ball has sunk, m."""
        return self._start - self._z
