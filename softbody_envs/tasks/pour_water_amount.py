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


class PourWaterAmountEnv(PourWaterEnv):
    state_names: ClassVar[tuple[str, ...]] = (*PourWaterEnv.state_names, "line height", "target fraction")
    best_performance: ClassVar[float] = 0.0

    def _build(self, world: World, rng: np.random.Generator) -> None:
        super()._build(world, rng)
        n = len(self.water)
        self.n_wanted = int(rng.uniform(0.2, 1.0) * n)
        size = self.target.size
        self.line = WALL + self.n_wanted * VOLUME / (PACKING * size.length * size.width)
        bar = world.client.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=(size.length / 2, 0.003, 0.006), rgbaColor=(1.0, 0.0, 0.0, 1.0)
        )
        world.client.createMultiBody(
            0, baseVisualShapeIndex=bar, basePosition=(self.target.x, size.width / 2 - 0.003, self.line)
        )

    def _measure(self) -> np.ndarray:
        return np.append(super()._measure(), [self.line, self.n_wanted / len(self.water)])

    def performance(self) -> float:
        """Minus the distance from the wanted number of particles, as a fraction of all."""
        return -abs(self.n_wanted - self.n_in_target) / len(self.water)
