"""A rope: rigid segments in a chain, in a plain rigid world."""

from itertools import pairwise

import numpy as np
import pybullet

from softbody_envs.sim.world import World

#: Length of the straight rope, m, and the number of its segments.
LENGTH = 0.5
N_SEGMENTS = 20
N_NODES = N_SEGMENTS + 1
SPACING = LENGTH / N_SEGMENTS
RADIUS = 0.009
#: Mass of a segment, kg.
SEGMENT_MASS = 0.005
#: Simulation steps per control step. With fewer, fast pulls stretch the rope.
STEPS_PER_CONTROL = 56
#: SoftGym's rope colour, and the colours of the first and the last segment: with the rope's, ends in a heap look like bends,
#: and which of two equal ends a picker is bound for could not be seen.
COLOR = (0.0, 0.5, 1.0, 1.0)
END_COLORS = ((1.0, 0.8, 0.0, 1.0), (1.0, 0.0, 0.8, 1.0))
#: The simulation has failed if the length differs by more than this fraction, or a coordinate is larger than this, m.
MAX_STRETCH = 0.2
MAX_DISTANCE = 2.0

_HALF = np.array([0.0, 0.0, SPACING / 2])


class Rope:
    """
    Segments that collide as spheres, are drawn as capsules and are joined by point-to-point constraints.

    Nodes are the joints and the two free ends. The spheres are dense enough that parts of the rope do not pass through each
    other. Neighbouring spheres touch if the rope bends by 88 degrees at a joint.

    :param world: rigid world
    :param nodes: initial positions, m, ``(N_NODES, 3)``, neighbours ``SPACING`` apart
    """

    def __init__(self, world: World, nodes: np.ndarray) -> None:
        self._world = world
        client = world.client
        # Strong damping and stiff joints: a segment that spins fast would leave its joints within one step. The contact
        # threshold is below the gap of 7 mm between neighbours: Bullet's default of 2 cm would make each pair a contact.
        client.setPhysicsEngineParameter(numSolverIterations=10, erp=1.0)
        world.contact_breaking_threshold = 0.004
        shape = client.createCollisionShape(pybullet.GEOM_SPHERE, radius=RADIUS)
        middle, first, last = (
            client.createVisualShape(pybullet.GEOM_CAPSULE, radius=RADIUS, length=SPACING, rgbaColor=color)
            for color in (COLOR, *END_COLORS)
        )
        looks = [first, *[middle] * (N_SEGMENTS - 2), last]
        self._segments = [
            client.createMultiBody(
                SEGMENT_MASS,
                shape,
                look,
                basePosition=(start + end) / 2,
                baseOrientation=_orientation(end - start),
                useMaximalCoordinates=True,
            )
            for look, (start, end) in zip(looks, pairwise(nodes), strict=True)
        ]
        for segment in self._segments:
            client.changeDynamics(segment, -1, lateralFriction=1.0, restitution=0.0, linearDamping=0.99, angularDamping=0.99)
        for first, second in pairwise(self._segments):
            client.createConstraint(first, -1, second, -1, pybullet.JOINT_POINT2POINT, (0, 0, 0), _HALF, -_HALF)

    def nodes(self) -> np.ndarray:
        """Positions of the nodes, m, ``(N_NODES, 3)``. A joint is the midpoint of the two ends that meet there."""
        get = self._world.client.getBasePositionAndOrientation
        poses = [get(segment) for segment in self._segments]
        centres = np.array([position for position, _ in poses])
        x, y, z, w = np.array([orientation for _, orientation in poses]).T
        axes = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
        starts, ends = centres - axes * SPACING / 2, centres + axes * SPACING / 2
        return np.concatenate([starts[:1], (ends[:-1] + starts[1:]) / 2, ends[-1:]])

    def hold(self, node: int, body: int) -> int:
        """Constrain a node to a body at its present offset and return a handle for ``release``."""
        client = self._world.client
        segment, pivot = (node, -_HALF) if node < N_SEGMENTS else (N_SEGMENTS - 1, _HALF)
        position, orientation = client.getBasePositionAndOrientation(segment := self._segments[segment])
        point, _ = client.multiplyTransforms(position, orientation, pivot, (0, 0, 0, 1))
        centre, _ = client.getBasePositionAndOrientation(body)
        return client.createConstraint(
            segment, -1, body, -1, pybullet.JOINT_POINT2POINT, (0, 0, 0), pivot, np.subtract(point, centre)
        )

    def release(self, handle: int) -> None:
        """Remove a constraint."""
        self._world.client.removeConstraint(handle)

    def tether(self, first: int, second: int) -> float:
        """Largest distance to which two held nodes may be pulled apart, m: the length of the rope between them."""
        return abs(first - second) * SPACING


def length(nodes: np.ndarray) -> float:
    """
    Return the length of the line through the nodes, m.

    :param nodes: positions, m, ``(n, 3)``
    """
    return float(np.linalg.norm(np.diff(nodes, axis=0), axis=1).sum())


def end_distance(nodes: np.ndarray) -> float:
    """
    Return the distance between the first and the last node, m.

    :param nodes: positions, m, ``(n, 3)``
    """
    return float(np.linalg.norm(nodes[-1] - nodes[0]))


def failure(nodes: np.ndarray) -> str | None:
    """
    Describe how the simulation has failed, or return ``None``.

    :param nodes: positions, m, ``(n, 3)``
    """
    if not np.isfinite(nodes).all() or np.abs(nodes).max() > MAX_DISTANCE:
        return "the rope has left the scene"
    if abs(length(nodes) / LENGTH - 1) > MAX_STRETCH:
        return f"the rope is {length(nodes):.2f} m long instead of {LENGTH} m"
    return None


def _orientation(axis: np.ndarray) -> np.ndarray:
    """Shortest rotation from z to an axis, as a quaternion (x, y, z, w)."""
    x, y, z = axis / np.linalg.norm(axis)
    if z < -1 + 1e-9:
        return np.array([1.0, 0.0, 0.0, 0.0])
    quaternion = np.array([-y, x, 0.0, 1.0 + z])
    return quaternion / np.linalg.norm(quaternion)
