"""PourWaterAmount: pour a wanted amount of water into a cup."""

from typing import ClassVar

import numpy as np
import pybullet

from softbody_envs.sim.cups import WALL
from softbody_envs.sim.water import VOLUME
from softbody_envs.sim.world import World
from softbody_envs.tasks.pour_water import PourWaterEnv

#: Fraction of a filled volume that the spheres occupy after they were poured.
PACKING = 0.55
#: Thickness of the mark on the back wall, m
THICKNESS = 0.006


class PourWaterAmountEnv(PourWaterEnv):
    """
    ## Description

    Pour water from a cup into the target, as in `PourWater-v0`, but only as much as the back wall of the target says: its
    red part is to the whole wall as the water to pour is to all water. Poured water cannot be taken back.

    ## Action Space

    `Box(-1, 1, (3,), float32)`, as in `PourWater-v0`:

    | Num | Action | Largest change in one step |
    |-----|--------|----------------------------|
    | 0 | move along x, toward the target | 0.08 m |
    | 1 | move up | 0.08 m |
    | 2 | tilt toward the target | 0.12 rad |

    ## Observation Space

    `obs_type="pixels"`: an RGB image. `obs_type="state"`: `Box(-10, 10, (15,), float32)`: the 13 elements of
    `PourWater-v0` and

    | Num | Observation | Unit |
    |-----|-------------|------|
    | 13 | height of the surface of the wanted water in the target | m |
    | 14 | goal: fraction of the water to pour | 1 |

    ## Rewards

    Each step: minus the difference between the fraction of the water in the target and the goal; from -1 to 0.

    | `info` key | Meaning |
    |------------|---------|
    | `performance` | the reward |
    | `normalized_performance` | 1 - performance / initial: 1 at the goal, 0 for no water and for twice the goal |
    | `is_success` | `normalized_performance` is at least 0.9 |
    | `monotone` | fraction of the water in the target |

    ## Starting State

    As in `PourWater-v0`. The goal is drawn from U(0.2, 1) for each variation and rounded down to whole particles. The
    back wall of the target is red from the floor up to that fraction of its height.

    ## Episode End

    Truncation after 100 steps (8 s). There is no termination.

    ## Arguments

    See `SoftbodyEnv`.

    ## Differences from SoftGym

    Those of `PourWater-v0`, and:

    * A perfect solution has `normalized_performance` 1. SoftGym normalizes as if the best performance were 1 instead of 0,
      so that its highest score is t / (1 + t) for the goal t.
    * Each variation has its own goal. SoftGym draws one for all variations.
    * The state contains the fractions of the water in target and cup.
    * SoftGym marks the surface of the wanted water by a bar on the left wall. A hundred spheres fill a cup less than
      SoftGym's water does: from one goal to another their surface moves by 5 cm, two pixels of a 64-pixel image. So the goal
      is told by how much of the back wall is red, which moves by 13 to 25 cm.

    ## Version History

    * v0: initial version
    """

    scenes: ClassVar[str] = "PourWaterAmountEnv"
    expert: ClassVar[str | None] = "softbody_envs.experts.pour_water:PourWaterAmountExpert"
    state_names: ClassVar[tuple[str, ...]] = (*PourWaterEnv.state_names, "wanted height", "target fraction")
    best_performance: ClassVar[float] = 0.0

    def _build(self, world: World, rng: np.random.Generator) -> None:
        super()._build(world, rng)
        n = len(self.water)
        self.n_wanted = int(rng.uniform(0.2, 1.0) * n)
        size = self.target.size
        #: Height to which the wanted number of loosely packed spheres fills the target, m
        self.wanted_height = WALL + self.n_wanted * VOLUME / (PACKING * size.length * size.width)
        half = self.n_wanted / n * size.height / 2
        mark = world.client.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=(size.length / 2, THICKNESS / 2, half), rgbaColor=(1.0, 0.0, 0.0, 1.0)
        )
        place = (self.target.x, (size.width - THICKNESS) / 2, WALL + half)
        world.client.createMultiBody(0, baseVisualShapeIndex=mark, basePosition=place)

    def _measure(self) -> np.ndarray:
        return np.append(super()._measure(), [self.wanted_height, self.n_wanted / len(self.water)])

    def performance(self) -> float:
        """Minus the difference between the fraction of the water in the target and the goal."""
        return -abs(self.n_wanted - self.n_in_target) / len(self.water)
