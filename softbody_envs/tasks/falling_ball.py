"""FallingBall: a diagnostic task in which the temporal order of any two frames is visible."""

from typing import ClassVar

import numpy as np

from softbody_envs.env import SoftbodyEnv
from softbody_envs.rendering import Camera
from softbody_envs.sim.ball import RADIUS, Ball
from softbody_envs.sim.world import World

#: Control steps of an episode, and distance that the ball sinks in each, m: more than a pixel of a 64-pixel image.
HORIZON = 50
SINK = 0.034
#: Range of the initial height of the ball's centre, m, and lowest height at the end of an episode, m.
STARTS = (1.83, 1.87)
LOWEST = STARTS[0] - HORIZON * SINK
#: Largest sideways move in one control step, m, and largest distance from the middle, m.
DRIFT = 0.01
SIDE = 0.6


class FallingBallEnv(SoftbodyEnv):
    """
    ## Description

    A ball sinks at a constant speed during the whole episode, as in oil. There is nothing to achieve. Of any two frames of
    an episode, the one with the lower ball is the later one: a method that learns the temporal order of frames must succeed
    here.

    ## Action Space

    `Box(-1, 1, (1,), float32)`:

    | Num | Action | Largest change in one step |
    |-----|--------|----------------------------|
    | 0 | move the ball sideways, without effect on its fall or the reward | 0.01 m |

    ## Observation Space

    `obs_type="pixels"`: an RGB image. `obs_type="state"`: `Box(-10, 10, (2,), float32)`:

    | Num | Observation | Unit |
    |-----|-------------|------|
    | 0 | x of the ball, to the right | m |
    | 1 | height of the ball | m |

    ## Rewards

    Each step: the fraction of its path that the ball has covered, regardless of the action.

    | `info` key | Meaning |
    |------------|---------|
    | `performance`, `normalized_performance` | the reward |
    | `is_success` | `normalized_performance` is at least 0.9 |
    | `monotone` | distance that the ball has sunk, m; it rises in every step |

    ## Starting State

    The ball is near the upper edge of the image. Variations differ in its height (1.83 to 1.87 m) and in x (-0.5 to 0.5 m).

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
        """Fraction of the path that the ball has covered."""
        return self.monotone() / (HORIZON * SINK)

    def monotone(self) -> float:
        """Distance that the ball has sunk, m."""
        return self._start - self._z
