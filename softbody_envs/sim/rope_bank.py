"""
Crumpled ropes that episodes start from.

``python -m softbody_envs.sim.rope_bank`` generates them again (15 minutes) and overwrites the file in the package.
"""

from functools import cache
from importlib.resources import files

import numpy as np
from tqdm import trange

from softbody_envs.sim.pickers import REACH, Pickers
from softbody_envs.sim.rope import LENGTH, N_NODES, RADIUS, STEPS_PER_CONTROL, Rope, end_distance
from softbody_envs.sim.world import World
from softbody_envs.variations import N_VARIATIONS, variation_rng

PATH = files("softbody_envs.sim") / "rope_bank.npz"
#: Positions are stored as integer multiples of this, m.
RESOLUTION = 1e-5
#: As in SoftGym, a random node is pulled this many times, for 0.64 s at up to 0.5 m/s sideways and 1 m/s upward, and
#: dropped.
PULLS = 4
PULL_STEPS = 8
PULL_SPEED = 0.04
DROP_STEPS = 12
#: Largest motion of a node in one control step for a rope at rest, m. A rope that takes longer to rest is rejected.
REST = 2e-4
MAX_SETTLE_STEPS = 100
#: Largest distance between the ends, m: otherwise there would be little to straighten.
MAX_END_DISTANCE = 0.35
#: Largest distance of a node from the middle, m: the pickers reach all of the rope at any orientation.
MAX_EXTENT = 0.25
#: Radius around each end in which no other part of the rope may be higher, m: nothing lies on the ends.
CLEARANCE = 1.5 * RADIUS


@cache
def _bank() -> np.ndarray:
    with PATH.open("rb") as file:
        return np.load(file)["nodes"]


def crumpled(variation: int, rng: np.random.Generator) -> np.ndarray:
    """
    Return the nodes of a rope at rest on the floor, with its bounding box centred on the z axis.

    :param variation: 0..999
    :param rng: generator of the rotation about the z axis
    :return: positions, m, ``(N_NODES, 3)``
    """
    nodes = _bank()[variation] * RESOLUTION
    cos, sin = np.cos(yaw := rng.uniform(-np.pi, np.pi)), np.sin(yaw)
    return _centred(nodes @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]))


def _centred(nodes: np.ndarray) -> np.ndarray:
    """Centre the bounding box of a rope on the z axis."""
    middle = (nodes.min(axis=0) + nodes.max(axis=0)) / 2
    return nodes - middle * (1.0, 1.0, 0.0)


def crumple(world: World, rng: np.random.Generator) -> np.ndarray | None:
    """
    Clear a world, lay a straight rope in it and pull it at random nodes.

    :return: nodes of the rope at rest, centred, m, ``(N_NODES, 3)``, or ``None`` if it is rejected
    """
    world.clear()
    world.add_floor()
    along = np.linspace(-LENGTH / 2, LENGTH / 2, N_NODES)[:, None]
    rope = Rope(world, along * (1.0, 0.0, 0.0) + (0.0, 0.0, RADIUS))
    bounds = np.full(3, 2.0)
    for _ in range(PULLS):
        start = rope.nodes()[rng.integers(N_NODES)]
        pull = rng.uniform(-1.0, 1.0, 3) + (0.0, 0.0, 1.0)
        pickers = Pickers(world, rope, np.stack([start, bounds]), -bounds, bounds, radius=0.01, grasp_range=0.01)
        for _ in range(PULL_STEPS):
            pickers.control(np.array([*pull * PULL_SPEED / REACH, 1.0, 0.0, 0.0, 0.0, -1.0]))
        for _ in range(DROP_STEPS):
            pickers.control(np.array([0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0]))
        pickers.remove()
    nodes = _settle(world, rope)
    if nodes is None:
        return None
    nodes = _centred(nodes)
    extent = np.linalg.norm(nodes[:, :2], axis=1).max()
    good = end_distance(nodes) <= MAX_END_DISTANCE and extent <= MAX_EXTENT and _shows_its_ends(nodes)
    return nodes if good else None


def _settle(world: World, rope: Rope) -> np.ndarray | None:
    """Simulate until the rope is at rest. Return its nodes, or ``None`` if that takes too long."""
    before = rope.nodes()
    for _ in range(MAX_SETTLE_STEPS):
        for _ in range(world.steps_per_control):
            world.step()
        nodes = rope.nodes()
        if np.abs(nodes - before).max() <= REST:
            return nodes
        before = nodes
    return None


def _shows_its_ends(nodes: np.ndarray) -> bool:
    """Test whether both ends are visible from above."""
    for line in (nodes, nodes[::-1]):
        end = line[0]
        others = np.concatenate([line[2:], (line[2:] + line[1:-1]) / 2])
        near = np.linalg.norm((others - end)[:, :2], axis=1) < CLEARANCE
        if (others[near, 2] > end[2]).any():
            return False
    return True


def main() -> None:
    """Generate and store the ropes."""
    bank = np.empty((N_VARIATIONS, N_NODES, 3), dtype=np.int16)
    world = World(STEPS_PER_CONTROL)
    for variation in trange(N_VARIATIONS):
        rng = variation_rng("rope bank", variation)
        while (nodes := crumple(world, rng)) is None:
            pass
        bank[variation] = np.rint(nodes / RESOLUTION)
    np.savez_compressed(str(PATH), nodes=bank)


if __name__ == "__main__":
    main()
