"""Cups: open boxes that hold water and are moved without throwing it out."""

from dataclasses import dataclass

import numpy as np
import pybullet

from softbody_envs.sim.world import World

#: Thickness of walls and floor, m.
WALL = 0.03


@dataclass(frozen=True)
class CupSize:
    """
    Inner size of a cup. The cup's frame has its origin in the middle of the underside, z toward the opening.

    :param length: inner length along x, m
    :param width: inner width along y, m
    :param height: height of the cavity, m
    """

    length: float
    width: float
    height: float

    @property
    def outer_length(self) -> float:
        """Length along x, walls included, m."""
        return self.length + 2 * WALL

    @property
    def outer_height(self) -> float:
        """Height from the underside to the rim, m."""
        return self.height + WALL


class Cup:
    """
    A kinematic cup made of five boxes. It is drawn without its front, since TinyRenderer has no transparency; the collision
    shape is closed.

    :param world: world that the cup is created in
    :param size: inner size
    :param x: position along x, m
    :param color: RGBA in [0, 1]
    :param foot: depth to which the floor reaches below the underside, m
    """

    def __init__(self, world: World, size: CupSize, x: float, color: tuple[float, float, float, float], foot: float = 0.0):
        self._world = world
        self.size = size
        self.x, self.z, self.angle = x, 0.0, 0.0
        half_x, half_y, half_z = size.outer_length / 2, size.width / 2 + WALL, size.outer_height / 2
        boxes = {  # name: (half extents, centre)
            "floor": ((half_x, half_y, (WALL + foot) / 2), (0, 0, (WALL - foot) / 2)),
            "left": ((WALL / 2, half_y, half_z), (-(size.length + WALL) / 2, 0, half_z)),
            "right": ((WALL / 2, half_y, half_z), ((size.length + WALL) / 2, 0, half_z)),
            "back": ((half_x, WALL / 2, half_z), (0, (size.width + WALL) / 2, half_z)),
            "front": ((half_x, WALL / 2, half_z), (0, -(size.width + WALL) / 2, half_z)),
        }
        drawn = [box for name, box in boxes.items() if name != "front"]
        client = world.client
        collision = client.createCollisionShapeArray(
            shapeTypes=[pybullet.GEOM_BOX] * len(boxes),
            halfExtents=[half for half, _ in boxes.values()],
            collisionFramePositions=[centre for _, centre in boxes.values()],
        )
        visual = client.createVisualShapeArray(
            shapeTypes=[pybullet.GEOM_BOX] * len(drawn),
            halfExtents=[half for half, _ in drawn],
            visualFramePositions=[centre for _, centre in drawn],
            rgbaColors=[color] * len(drawn),
        )
        self._body = client.createMultiBody(0, collision, visual, basePosition=(x, 0, 0))
        client.changeDynamics(self._body, -1, lateralFriction=0.0, restitution=0.0)

    def move(self, x: float, z: float, angle: float) -> None:
        """
        Move to a pose during the next simulation step.

        The matching velocity is set, too: without it, the contact solver sees walls that jump, and throws the water.

        :param x: x of the middle of the underside, m
        :param z: z of the middle of the underside, m
        :param angle: tilt toward +x, rad
        """
        rate = 1 / self._world.time_step
        velocity = ((x - self.x) * rate, 0.0, (z - self.z) * rate)
        spin = (0.0, (angle - self.angle) * rate, 0.0)
        self.x, self.z, self.angle = x, z, angle
        orientation = (0.0, np.sin(angle / 2), 0.0, np.cos(angle / 2))
        self._world.client.resetBasePositionAndOrientation(self._body, (x, 0, z), orientation)
        self._world.client.resetBaseVelocity(self._body, velocity, spin)

    def local(self, points: np.ndarray) -> np.ndarray:
        """
        Transform points to the cup's frame.

        :param points: points in the world, m, ``(n, 3)``
        :return: the same points in the cup's frame, m, ``(n, 3)``
        """
        x, y, z = (points - (self.x, 0.0, self.z)).T
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        return np.stack([cos * x - sin * z, y, sin * x + cos * z], axis=1)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """
        Test which points lie in the cavity, at any tilt. Half of each wall counts as cavity, as in SoftGym: a particle that
        hits a wall penetrates it a little for a moment.

        :param points: points in the world, m, ``(n, 3)``
        :return: mask, bool ``(n,)``
        """
        x, y, z = np.abs(self.local(points) - (0.0, 0.0, WALL + self.size.height / 2)).T
        half = np.array([self.size.length, self.size.width, self.size.height]) / 2 + WALL / 2
        return (x <= half[0]) & (y <= half[1]) & (z <= half[2])


def corners(size: CupSize, x: np.ndarray | float, z: np.ndarray | float, angle: np.ndarray | float) -> np.ndarray:
    """
    Return the corners of a cup's outer rectangle in the x-z plane, for one pose or for arrays of poses.

    :return: corners, m, ``(..., 4, 2)``, in the order of the outline
    """
    half, top = size.outer_length / 2, size.outer_height
    along, up = np.array([(-half, 0.0), (half, 0.0), (half, top), (-half, top)]).T
    x, z, angle = (np.asarray(number)[..., None] for number in (x, z, angle))
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([x + cos * along + sin * up, z - sin * along + cos * up], axis=-1)


def overlap(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """
    Test whether convex polygons touch (separating-axis theorem).

    :param first: vertices, ``(..., n, 2)``
    :param second: vertices, ``(m, 2)``
    :return: bool ``(...)``
    """
    second = np.broadcast_to(second, (*first.shape[:-2], *second.shape))
    edges = np.concatenate([np.roll(outline, -1, axis=-2) - outline for outline in (first, second)], axis=-2)
    normals = (edges[..., ::-1] * (1.0, -1.0)).swapaxes(-1, -2)
    a, b = first @ normals, second @ normals
    return ((a.max(axis=-2) >= b.min(axis=-2)) & (b.max(axis=-2) >= a.min(axis=-2))).all(axis=-1)
