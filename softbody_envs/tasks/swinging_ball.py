"""SwingingBall: a diagnostic in which the order of two frames cannot be told."""

from typing import ClassVar

import numpy as np

from softbody_envs.env import SoftbodyEnv
from softbody_envs.rendering import Camera
from softbody_envs.sim.ball import Ball
from softbody_envs.sim.world import World

#: Control steps of one swing to and fro: an episode of 100 has a whole number of them.
PERIOD = 20
#: Where the pendulum hangs, m, its length, m, and its largest angle, rad.
PIVOT = (0.0, 0.0, 1.75)
LENGTH = 1.3
AMPLITUDE = 0.5
#: An episode starts with the ball at most this fraction of the way to the right.
HIGHEST_START = 0.8


class SwingingBallEnv(SoftbodyEnv):
    """
    ## Description

    A pendulum swings without friction. Played backward it looks the same: nothing tells which of two frames came first, so
    that a method that claims to know the order of frames here has been misled. Its angle is a sine of time.

    ## Action Space

    `Box(-1, 1, (1,), float32)`: without effect.

    ## Observation Space

    `obs_type="pixels"`: an RGB image. `obs_type="state"`: `Box(-10, 10, (2,), float32)`:

    | Num | Observation | Unit |
    |-----|-------------|------|
    | 0 | x of the ball, to the right | m |
    | 1 | height of the ball | m |

    ## Rewards

    Each step: how far to the right the ball is, from 0 (at its left end) to 1 (at its right end), whatever the action.

    `performance` is this reward; `normalized_performance` = (performance - initial performance) / (1 - initial performance);
    `is_success` from 0.9 on; `monotone` is x in m: in an episode it rises as often as it falls.

    ## Starting State

    A variation draws where the swing begins, to the left or to the right, but not at the right end.

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
        self._start = rng.uniform(np.pi - limit, 2 * np.pi + limit)  # all phases but those around the right end
        self._steps = 0
        self._place()

    def _control(self, action: np.ndarray) -> None:
        self._steps += 1
        self._place()

    def _place(self) -> None:
        """Put the ball where it is at this time."""
        self._swing = np.sin(self._start + 2 * np.pi * self._steps / PERIOD)
        angle = AMPLITUDE * self._swing
        self._position = np.array(PIVOT) + LENGTH * np.array([np.sin(angle), 0.0, -np.cos(angle)])
        self._ball.move(self._position)

    def _measure(self) -> np.ndarray:
        return self._position[[0, 2]]

    def performance(self) -> float:
        """How far to the right the ball is, from 0 to 1."""
        return (1 + self._swing) / 2

    def monotone(self) -> float:
        """x of the ball, m."""
        return self._position[0]
