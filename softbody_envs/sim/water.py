"""Water as rigid spheres without friction."""

from pathlib import Path

import numpy as np
import pybullet

from softbody_envs.sim.world import World

#: Particle radius, m.
RADIUS = 0.02
DIAMETER = 2 * RADIUS
#: Volume of a particle, m^3.
VOLUME = 4 / 3 * np.pi * RADIUS**3
DENSITY = 1000.0
#: SoftGym's fluid colour.
COLOR = (0.113, 0.425, 0.55, 1.0)
#: Particles are drawn as icosahedra whose outlines have the area of the sphere's; this takes a third of the time.
DRAWN_RADIUS = 1.14 * RADIUS
#: An icosahedron of radius 1. A file, since Bullet never frees a mesh that it is given as numbers: 6 kB for each scene.
MESH = Path(__file__).with_name("particle.obj")


class Water:
    """
    Particles of water.

    :param world: rigid world
    :param positions: centres of the particles, m, ``(n, 3)``, not overlapping
    """

    def __init__(self, world: World, positions: np.ndarray) -> None:
        self._world = world
        client = world.client
        self._bodies = client.createMultiBody(
            baseMass=DENSITY * VOLUME,
            baseCollisionShapeIndex=client.createCollisionShape(pybullet.GEOM_SPHERE, radius=RADIUS),
            baseVisualShapeIndex=client.createVisualShape(
                pybullet.GEOM_MESH,
                fileName=str(MESH),
                meshScale=(DRAWN_RADIUS,) * 3,
                rgbaColor=COLOR,
            ),
            basePosition=(0, 0, 0),
            batchPositions=positions.tolist(),
            useMaximalCoordinates=True,
        )
        for body in self._bodies:
            client.changeDynamics(
                body, -1, lateralFriction=0.0, restitution=0.0, linearDamping=0.02, contactProcessingThreshold=0.0
            )

    def __len__(self) -> int:
        return len(self._bodies)

    def positions(self) -> np.ndarray:
        """Centres of the particles, m, ``(n, 3)``."""
        get = self._world.client.getBasePositionAndOrientation
        return np.array([get(body)[0] for body in self._bodies])


def lattice(n: int, length: float, width: float, floor: float, rng: np.random.Generator) -> np.ndarray:
    """
    Stack particles in a box centred on the z axis, slightly apart and jittered, from the floor upward.

    :param n: number of particles
    :param length: inner size of the box along x, m
    :param width: inner size of the box along y, m
    :param floor: height of the box's floor, m
    :param rng: generator of the jitter
    :return: centres, m, ``(n, 3)``
    """
    pitch = DIAMETER * 1.005
    per_row, per_column = int(length // pitch), int(width // pitch)
    layer, cell = np.divmod(np.arange(n), per_row * per_column)
    row, column = np.divmod(cell, per_row)
    grid = np.stack([column - (per_row - 1) / 2, row - (per_column - 1) / 2, layer + 0.5], axis=1)
    jitter = rng.uniform(-1e-4, 1e-4, (n, 3))  # without jitter, columns of particles balance on each other
    return grid * pitch + jitter + (0.0, 0.0, floor)
