"""A cloth: a grid of masses and springs in Bullet's deformable world."""

import tempfile
from pathlib import Path

import numpy as np
import pybullet

from softbody_envs.sim.world import World

#: Nodes along each side. Odd: each corner then has a diagonal spring, and a fold runs along the middle nodes.
N_SIDE = 9
#: Mass of the cloth, kg (SoftGym: 0.5). Only the ratio of stiffness to mass matters.
MASS = 0.5
#: Stiffness of the springs between neighbours, N/m. At 1.5 times this value, ``STEPS_PER_CONTROL`` is too small: a hanging
#: cloth trembles.
STIFFNESS = 110.0
#: Damping of the springs, N s/m. It acts in all directions, so that a swinging cloth comes to rest within a second, as in
#: air.
DAMPING = 0.05
BENDING_STIFFNESS = 0.05
FRICTION = 1.0
#: Contact margin of the cloth, m.
MARGIN = 0.006
#: Simulation steps per control step; the stiffness needs that many to be stable.
STEPS_PER_CONTROL = 14
#: Largest distance of two held nodes, as a multiple of their distance in the flat cloth.
TETHER = 1.1
#: The cloth has exploded if an edge is longer than this multiple of its rest length, or a coordinate larger than this, m.
MAX_STRETCH = 4.0
MAX_DISTANCE = 3.0

_INDEX = np.arange(N_SIDE**2).reshape(N_SIDE, N_SIDE)


class Cloth:
    """
    A square mesh with alternating diagonals. It is invisible to Bullet's renderers; ``softbody_envs.painting`` draws it.

    It does not collide with itself, so layers interpenetrate: Bullet shuffles self-collisions with a random generator of
    the process that cannot be seeded.

    :param world: a deformable world
    :param grid: the cloth at rest, flat in any plane, m, ``(N_SIDE, N_SIDE, 3)``
    """

    def __init__(self, world: World, grid: np.ndarray) -> None:
        self._client = client = world.client
        self._world = world
        self._flat = grid.reshape(-1, 3)
        self._edges = _edges()
        self._lengths = self._edge_lengths(self._flat)
        self._anchors: set[int] = set()
        client.setPhysicsEngineParameter(useSplitImpulse=0)  # steps are a third cheaper
        with tempfile.TemporaryDirectory() as folder:
            mesh = Path(folder, "cloth.obj")
            mesh.write_text(_obj(self._flat))
            self._body = client.loadSoftBody(
                str(mesh),
                mass=MASS,
                collisionMargin=MARGIN,
                useMassSpring=1,
                useBendingSprings=1,
                springElasticStiffness=STIFFNESS,
                springDampingStiffness=DAMPING,
                springDampingAllDirections=1,
                springBendingStiffness=BENDING_STIFFNESS,
                frictionCoeff=FRICTION,
                useSelfCollision=0,
            )
        client.changeVisualShape(self._body, -1, rgbaColor=(0, 0, 0, 0))
        self._stay_awake()

    def nodes(self) -> np.ndarray:
        """Positions of the nodes, m, ``(N_SIDE ** 2, 3)``."""
        _, nodes = self._client.getMeshData(self._body, -1, flags=pybullet.MESH_DATA_SIMULATION_MESH)
        return np.array(nodes)

    def grid(self) -> np.ndarray:
        """Positions of the nodes, m, ``(N_SIDE, N_SIDE, 3)``, in the order of the constructor's grid."""
        return self.nodes().reshape(N_SIDE, N_SIDE, 3)

    def hold(self, node: int, body: int) -> int:
        """Anchor a node to a body at its present offset and return a handle for ``release``."""
        anchor = self._client.createSoftBodyAnchor(self._body, node, body, -1)
        self._anchors.add(anchor)
        return anchor

    def release(self, handle: int) -> None:
        """Remove an anchor."""
        # Bullet keeps the ids of removed anchors: removing one twice would free a later anchor of the same node.
        self._anchors.remove(handle)
        self._client.removeConstraint(handle)

    def tether(self, first: int, second: int) -> float:
        """Largest distance to which two held nodes may be pulled apart, m."""
        return TETHER * float(np.linalg.norm(self._flat[first] - self._flat[second]))

    def calm(self) -> None:
        """Advance by one simulation step and set all velocities to zero, as Bullet does for a sleeping cloth."""
        self._client.changeDynamics(self._body, -1, activationState=pybullet.ACTIVATION_STATE_SLEEP)
        self._world.step()
        self._stay_awake()

    def stretch(self) -> np.ndarray:
        """Length of each edge divided by its rest length, ``(n_edges,)``."""
        return self._edge_lengths(self.nodes()) / self._lengths

    def fault(self) -> str | None:
        """Describe how the cloth has exploded, or return ``None``. Bullet reports nothing, and positions may be finite."""
        nodes = self.nodes()
        farthest = np.abs(nodes).max()
        if not farthest <= MAX_DISTANCE:
            return f"cloth exploded: a node is {farthest:.3g} m away"
        longest = (self._edge_lengths(nodes) / self._lengths).max()
        return f"cloth exploded: an edge is {longest:.3g} times its length" if longest > MAX_STRETCH else None

    def _edge_lengths(self, nodes: np.ndarray) -> np.ndarray:
        return np.linalg.norm(nodes[self._edges[:, 0]] - nodes[self._edges[:, 1]], axis=1)

    def _stay_awake(self) -> None:
        """Keep the cloth from falling asleep: a sleeping cloth ignores anchors and contacts."""
        self._client.changeDynamics(self._body, -1, activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING)


def flat_grid(length: float, width: float, yaw: float = 0.0) -> np.ndarray:
    """
    Return the nodes of a flat cloth on the floor, centred at the origin.

    :param length: side along the first axis of the grid, m
    :param width: side along the second axis, m
    :param yaw: angle from x to the first axis, rad
    :return: positions, m, ``(N_SIDE, N_SIDE, 3)``
    """
    along, across = np.meshgrid(*(size * np.linspace(-0.5, 0.5, N_SIDE) for size in (length, width)), indexing="ij")
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.stack([cos * along - sin * across, sin * along + cos * across, np.full_like(along, MARGIN)], axis=-1)


def _triangles() -> np.ndarray:
    """Node indices of the triangles, ``(n, 3)``, counterclockwise seen from the side of the normal."""
    corner = _INDEX[:-1, :-1], _INDEX[1:, :-1], _INDEX[1:, 1:], _INDEX[:-1, 1:]
    a, b, c, d = (numbers.ravel() for numbers in corner)
    even = (np.add.outer(np.arange(N_SIDE - 1), np.arange(N_SIDE - 1)) % 2 == 0).ravel()
    first = np.where(even, (a, b, c), (a, b, d))
    second = np.where(even, (a, c, d), (b, c, d))
    return np.concatenate([first, second], axis=1).T


def _edges() -> np.ndarray:
    """Node indices of the edges, each edge once, ``(n, 2)``."""
    triangles = _triangles()
    pairs = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _obj(nodes: np.ndarray) -> str:
    """Content of a Wavefront file of the cloth."""
    vertices = "".join(f"v {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in nodes)
    return vertices + "".join(f"f {a} {b} {c}\n" for a, b, c in _triangles() + 1)
