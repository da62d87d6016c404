"""SwingingBall: a diagnostic task in which the temporal order of two frames is not visible."""

from typing import ClassVar

import numpy as np

from softbody_envs.env import SoftbodyEnv
from softbody_envs.rendering import Camera
from softbody_envs.sim.ball import Ball
from softbody_envs.sim.world import World

#: Control steps of one period. An episode of 100 steps has a whole number of periods.
PERIOD = 20
#: Pivot of the pendulum, m, its length, m, and its amplitude, rad.
PIVOT = (0.0, 0.0, 1.75)
LENGTH = 1.3
AMPLITUDE = 0.5
#: Largest initial displacement to the right, as a fraction of the amplitude.
HIGHEST_START = 0.8


class SwingingBallEnv(SoftbodyEnv):
    """
    ## Description

    A pendulum swings without friction: its angle is a sine of time. Played backward, an episode looks the same, so nothing
    shows which of two frames came first. A method that finds a temporal order here has been misled.

    ## Action Space

    `Box(-1, 1, (1,), float32)`:

    | Num | Action | Largest change in one step |
    |-----|--------|----------------------------|
    | 0 | none: the action has no effect | 0 |

    ## Observation Space

    `obs_type="pixels"`: an RGB image. `obs_type="state"`: `Box(-10, 10, (2,), float32)`:

    | Num | Observation | Unit |
    |-----|-------------|------|
    | 0 | x of the ball, to the right | m |
    | 1 | height of the ball | m |

    ## Rewards

    Each step: the position of the ball from 0 (left end) to 1 (right end), regardless of the action.

    | `info` key | Meaning |
    |------------|---------|
    | `performance` | the reward |
    | `normalized_performance` | (performance - initial) / (1 - initial) |
    | `is_success` | `normalized_performance` is at least 0.9 |
    | `monotone` | x of the ball, m; in an episode it rises as often as it falls |

    ## Starting State

    Variations differ in the initial phase of the swing: any but those near the right end.

    ## Episode End

    Truncation after 100 steps (8 s, five periods).

    ## Arguments

    See `SoftbodyEnv`.

    ## Differences from SoftGym

    SoftGym has no such task.

    ## Version History

    * v0: initial version
    """

    scenes: ClassVar[str] = "SwingingBallEnv"
    camera: ClassVar[Camera] = Camera(position=(0.0, -2.5, 1.0), target=(0.0, 0.0, 1.0))
    action_size: ClassVar[int] = 1
    state_names: ClassVar[tuple[str, ...]] = ("ball x", "ball z")
    best_performance: ClassVar[float] = 1.0
    success_threshold: ClassVar[float] = 0.9
    steps_per_control: ClassVar[int] = 1

    def _build(self, world: World, rng: np.random.Generator) -> None:
        world.add_floor()
        self._ball = Ball(world)
        limit = np.arcsin(HIGHEST_START)
        self._start = rng.uniform(np.pi - limit, 2 * np.pi + limit)  # all phases except those near the right end
        self._steps = 0
        self._place()

    def _control(self, action: np.ndarray) -> None:
        self._steps += 1
        self._place()

    def _place(self) -> None:
        """Move the ball to its position at the present time."""
        self._swing = np.sin(self._start + 2 * np.pi * self._steps / PERIOD)
        angle = AMPLITUDE * self._swing
        self._position = np.array(PIVOT) + LENGTH * np.array([np.sin(angle), 0.0, -np.cos(angle)])
        self._ball.move(self._position)

    def _measure(self) -> np.ndarray:
        return self._position[[0, 2]]

    def performance(self) -> float:
        """Position of the ball from 0 (left end) to 1 (right end)."""
        return (1 + self._swing) / 2

    def monotone(self) -> float:
        """x of the ball, m."""
        return self._position[0]
