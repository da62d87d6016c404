"""Water as rigid spheres without friction."""

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
GOLDEN = (1 + 5**0.5) / 2
VERTICES = np.array(
    [np.roll((0.0, a, b), axis) for axis in range(3) for a in (-1.0, 1.0) for b in (-GOLDEN, GOLDEN)]
) / np.hypot(1.0, GOLDEN)
#: Vertex indices of each triangle, counterclockwise seen from outside.
FACES = (
    *((0, 8, 4), (0, 4, 2), (0, 2, 5), (0, 5, 10), (0, 10, 8)),
    *((3, 1, 7), (3, 7, 11), (3, 11, 9), (3, 9, 6), (3, 6, 1)),
    *((1, 8, 10), (1, 10, 7), (7, 10, 5), (7, 5, 11), (11, 5, 2)),
    *((11, 2, 9), (9, 2, 4), (9, 4, 6), (6, 4, 8), (6, 8, 1)),
)


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
                vertices=(VERTICES * DRAWN_RADIUS).tolist(),
                indices=[vertex for face in FACES for vertex in face],
                normals=VERTICES.tolist(),
                uvs=[(0.0, 0.0)] * len(VERTICES),
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
