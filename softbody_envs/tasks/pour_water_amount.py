"""PourWaterAmount: fill another cup to a line."""

from typing import ClassVar

import numpy as np
import pybullet

from softbody_envs.sim.cups import WALL
from softbody_envs.sim.water import VOLUME
from softbody_envs.sim.world import World
from softbody_envs.tasks.pour_water import PourWaterEnv

#: Share of a filled volume that the spheres themselves take up: poured, frictionless, near walls.
PACKING = 0.55
#: Of the line, m: at least a pixel of a 64-pixel image.
BAR_WIDTH = 0.028


class PourWaterAmountEnv(PourWaterEnv):
    """
    ## Description

    As PourWater, but only up to the red line on the target's back wall. What has been poured cannot be taken back.

    ## Action Space

    That of PourWater: `Box(-1, 1, (3,), float32)`.

    | Num | Action | Largest change in one step |
    |-----|--------|----------------------------|
    | 0 | move along x, toward the target | 0.08 m |
    | 1 | move up | 0.08 m |
    | 2 | tilt toward the target | 0.12 rad |

    ## Observation Space

    `obs_type="pixels"`: an RGB image. `obs_type="state"`: `Box(-10, 10, (15,), float32)`, the 13 elements of PourWater and

    | Num | Observation | Unit |
    |-----|-------------|------|
    | 13 | height of the line | m |
    | 14 | wanted fraction of the water | 1 |

    ## Rewards

    Each step: minus the distance between the wanted number of particles and the number in the target, divided by the
    number of all particles; from -1 to 0.

    `performance` is this reward; `normalized_performance` = (performance - initial) / (0 - initial), so that the wanted
    amount scores 1, an untouched scene 0, and twice the wanted amount 0; `is_success` from 0.9 on; `monotone` is the
    fraction of the water in the target.

    ## Starting State

    That of PourWater. Each variation draws the wanted fraction from U(0.2, 1), rounded down to whole particles; the line
    is where so many spheres, loosely packed, fill the target.

    ## Episode End

    Truncation after 100 steps (8 s). There is no termination.

    ## Arguments

    See `SoftbodyEnv`.

    ## Differences from SoftGym

    Those of PourWater, and:

    * SoftGym normalizes as if the best performance were 1, though it is 0: its score ends at t / (1 + t) for the fraction
      t. Here it ends at 1.
    * SoftGym draws one fraction for all its variations. Here each has its own.
    * The state keeps the fractions of water in target and cup.
    * The line is on the back wall, where the camera sees it from the start; SoftGym's is on the left.

    ## Version History

    * v0: initial version
    """

    scenes: ClassVar[str] = "PourWaterAmountEnv"
    expert: ClassVar[str | None] = "softbody_envs.experts.pour_water:PourWaterAmountExpert"
    state_names: ClassVar[tuple[str, ...]] = (*PourWaterEnv.state_names, "line height", "target fraction")
    best_performance: ClassVar[float] = 0.0

    def _build(self, world: World, rng: np.random.Generator) -> None:
        super()._build(world, rng)
        n = len(self.water)
        self.n_wanted = int(rng.uniform(0.2, 1.0) * n)
        size = self.target.size
        self.line = WALL + self.n_wanted * VOLUME / (PACKING * size.length * size.width)
        bar = world.client.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=(size.length / 2, 0.003, BAR_WIDTH / 2), rgbaColor=(1.0, 0.0, 0.0, 1.0)
        )
        world.client.createMultiBody(
            0, baseVisualShapeIndex=bar, basePosition=(self.target.x, size.width / 2 - 0.003, self.line)
        )

    def _measure(self) -> np.ndarray:
        return np.append(super()._measure(), [self.line, self.n_wanted / len(self.water)])

    def performance(self) -> float:
        """Minus the distance from the wanted number of particles, as a fraction of all."""
        return -abs(self.n_wanted - self.n_in_target) / len(self.water)
