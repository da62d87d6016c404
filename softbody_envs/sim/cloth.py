"""A cloth: a grid of masses and springs in Bullet's deformable world."""

import tempfile
from pathlib import Path

import numpy as np
import pybullet

from softbody_envs.sim.world import World

#: Nodes along each side. Odd: each corner then has a diagonal spring, and a fold runs along the middle nodes.
N_SIDE = 9
#: kg (SoftGym: 0.5). Only the ratio of the springs to it matters.
MASS = 0.5
#: Of the springs between neighbours, N/m. With ``STEPS_PER_CONTROL`` steps a hanging cloth trembles from 1.5 times this on.
STIFFNESS = 110.0
#: Of the springs, N s/m; in all directions, so that a swinging cloth comes to rest within a second, as air would do it.
DAMPING = 0.05
BENDING_STIFFNESS = 0.05
FRICTION = 1.0
#: Distance that the cloth keeps from what it touches, m.
MARGIN = 0.006
#: Simulation steps in a control step that these springs need.
STEPS_PER_CONTROL = 14
#: Two held nodes are pulled no further apart than this many times their distance in the flat cloth.
TETHER = 1.1
#: The cloth has exploded if an edge is this many times as long as at rest, or a node this far away, m.
MAX_STRETCH = 4.0
MAX_DISTANCE = 3.0

_INDEX = np.arange(N_SIDE**2).reshape(N_SIDE, N_SIDE)


class Cloth:
    """
    A square mesh whose diagonals alternate. It does not collide with itself, so its layers lie in each other: Bullet
    shuffles self-collisions by a random number that belongs to the process and that no seed reaches. It is invisible;
    ``softbody_envs.painting`` draws it.

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
        client.setPhysicsEngineParameter(useSplitImpulse=0)  # a third cheaper
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
        """Positions of the nodes now, m, ``(N_SIDE ** 2, 3)``."""
        _, nodes = self._client.getMeshData(self._body, -1, flags=pybullet.MESH_DATA_SIMULATION_MESH)
        return np.array(nodes)

    def grid(self) -> np.ndarray:
        """Positions of the nodes now, m, ``(N_SIDE, N_SIDE, 3)``, in the order they were given in."""
        return self.nodes().reshape(N_SIDE, N_SIDE, 3)

    def hold(self, node: int, body: int) -> int:
        """Tie a node to a body, at the offset they have now; return a handle for ``release``."""
        anchor = self._client.createSoftBodyAnchor(self._body, node, body, -1)
        self._anchors.add(anchor)
        return anchor

    def release(self, handle: int) -> None:
        """Untie what ``hold`` tied."""
        # Bullet never forgets an anchor: removing one twice would free whatever holds its node by then.
        self._anchors.remove(handle)
        self._client.removeConstraint(handle)

    def tether(self, first: int, second: int) -> float:
        """How far apart two held nodes may be pulled, m."""
        return TETHER * float(np.linalg.norm(self._flat[first] - self._flat[second]))

    def calm(self) -> None:
        """Advance by one simulation step and take away all velocities: Bullet does so where a cloth sleeps."""
        self._client.changeDynamics(self._body, -1, activationState=pybullet.ACTIVATION_STATE_SLEEP)
        self._world.step()
        self._stay_awake()

    def stretch(self) -> np.ndarray:
        """Length of each edge now over its length at rest, ``(n_edges,)``."""
        return self._edge_lengths(self.nodes()) / self._lengths

    def fault(self) -> str | None:
        """What shows that the cloth has exploded, or ``None``: Bullet raises nothing and may give no NaN."""
        nodes = self.nodes()
        farthest = np.abs(nodes).max()
        if not farthest <= MAX_DISTANCE:
            return f"cloth exploded: a node is {farthest:.3g} m away"
        longest = (self._edge_lengths(nodes) / self._lengths).max()
        return f"cloth exploded: an edge is {longest:.3g} times its length" if longest > MAX_STRETCH else None

    def _edge_lengths(self, nodes: np.ndarray) -> np.ndarray:
        return np.linalg.norm(nodes[self._edges[:, 0]] - nodes[self._edges[:, 1]], axis=1)

    def _stay_awake(self) -> None:
        """A sleeping cloth ignores anchors and contacts."""
        self._client.changeDynamics(self._body, -1, activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING)


def flat_grid(length: float, width: float, yaw: float = 0.0) -> np.ndarray:
    """
    A flat cloth on the floor, its middle over the origin.

    :param length: along the first axis of the grid, m
    :param width: along the second, m
    :param yaw: from x to the first axis, rad
    :return: m, ``(N_SIDE, N_SIDE, 3)``
    """
    along, across = np.meshgrid(*(size * np.linspace(-0.5, 0.5, N_SIDE) for size in (length, width)), indexing="ij")
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.stack([cos * along - sin * across, sin * along + cos * across, np.full_like(along, MARGIN)], axis=-1)


def _triangles() -> np.ndarray:
    """Node numbers, ``(n, 3)``; seen from the normal's side, counterclockwise."""
    corner = _INDEX[:-1, :-1], _INDEX[1:, :-1], _INDEX[1:, 1:], _INDEX[:-1, 1:]
    a, b, c, d = (numbers.ravel() for numbers in corner)
    even = (np.add.outer(np.arange(N_SIDE - 1), np.arange(N_SIDE - 1)) % 2 == 0).ravel()
    first = np.where(even, (a, b, c), (a, b, d))
    second = np.where(even, (a, c, d), (b, c, d))
    return np.concatenate([first, second], axis=1).T


def _edges() -> np.ndarray:
    """Pairs of node numbers that a triangle joins, each pair once, ``(n, 2)``."""
    triangles = _triangles()
    pairs = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _obj(nodes: np.ndarray) -> str:
    """A Wavefront file of the cloth."""
    vertices = "".join(f"v {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in nodes)
    return vertices + "".join(f"f {a} {b} {c}\n" for a, b, c in _triangles() + 1)
