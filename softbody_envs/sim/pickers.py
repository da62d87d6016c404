"""Pickers: spheres that move freely, grasp the nearest node of a rope or a cloth, and release it."""

from typing import Protocol

import numpy as np
import pybullet

from softbody_envs.sim.world import GRAVITY, World

#: Largest move of a picker along each axis in one control step, m, and the number of sub-steps (SoftGym: 8 of 0.01 m).
REACH = 0.08
SUBSTEPS = 8
#: Mass of a picker, kg. It limits the force on a held object to ``MASS * (LAG + move) / t**2`` in a sub-step of t seconds:
#: enough to lift a rope, too little to stretch it.
MASS = 0.007
#: Largest distance by which a picker may lag behind its target, m. It does not make up for more.
LAG = 0.018
#: Colours of the pickers, and darker ones while they hold something.
COLORS = ((0.85, 0.20, 0.15, 1.0), (0.15, 0.60, 0.20, 1.0))
HOLDING_COLORS = ((0.40, 0.05, 0.03, 1.0), (0.02, 0.25, 0.05, 1.0))


class Graspable(Protocol):
    """An object that pickers can hold."""

    def nodes(self) -> np.ndarray:
        """Positions of the nodes, m, ``(n, 3)``."""

    def hold(self, node: int, body: int) -> int:
        """Attach a node to a body at its present offset and return a handle for ``release``."""

    def release(self, handle: int) -> None:
        """Detach what ``hold`` attached."""

    def tether(self, first: int, second: int) -> float:
        """Largest distance to which two held nodes may be pulled apart, m."""


class Pickers:
    """
    Two pickers as in SoftGym: an action is ``(dx, dy, dz, pick)`` for each, and ``pick > 0`` grasps or holds.

    A picker grasps the nearest free node in range and keeps its offset to it. Pickers push nothing. Their force is limited:
    a picker lags behind if the held object cannot follow, and two pickers that hold the same object cannot move farther
    apart than its ``tether``.

    :param world: world that the pickers are created in
    :param target: object that they can hold
    :param positions: initial positions of the centres, m, ``(2, 3)``
    :param low: lowest corner of the box that the centres stay in, m
    :param high: highest corner of the box, m
    :param radius: radius of the spheres, m
    :param grasp_range: largest distance from the centre to a node that can be grasped, m
    :param mass: mass of a picker, kg; a heavy picker moves as commanded, whatever it holds
    :param reach: largest move of a picker along each axis in one control step, m
    """

    def __init__(
        self,
        world: World,
        target: Graspable,
        positions: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        radius: float,
        grasp_range: float,
        mass: float = MASS,
        reach: float = REACH,
    ) -> None:
        self._world = world
        self._target = target
        #: Centres, m, ``(2, 3)``.
        self.positions = np.array(positions, dtype=np.float64)
        # Targets of the last sub-step.
        self._sent = self.positions.copy()
        self._low, self._high = np.asarray(low), np.asarray(high)
        self._grasp_range = grasp_range
        self._reach = reach
        self._interval = max(1, world.steps_per_control // SUBSTEPS)
        # Compensates gravity: a picker ends each sub-step at the height of its target.
        self._lift = np.array([0.0, 0.0, -GRAVITY * world.time_step * (self._interval + 1) / 2])
        self._bodies = [self._create(mass, position, color, radius) for position, color in zip(positions, COLORS, strict=True)]
        #: Node that each picker holds, or ``None``.
        self.held: list[int | None] = [None] * len(self._bodies)
        self._handles: list[int] = [-1] * len(self._bodies)
        self._offsets = np.zeros_like(self.positions)

    def _create(self, mass: float, position: np.ndarray, color: tuple[float, ...], radius: float) -> int:
        client = self._world.client
        look = client.createVisualShape(pybullet.GEOM_SPHERE, radius=radius, rgbaColor=color)
        body = client.createMultiBody(mass, -1, look, position, useMaximalCoordinates=True)
        client.changeDynamics(body, -1, linearDamping=0.0)
        return body

    def control(self, action: np.ndarray) -> None:
        """
        Advance the world by one control step while the pickers execute an action.

        :param action: ``(dx, dy, dz, pick)`` of each picker in turn, in [-1, 1], ``(8,)``
        """
        commands = action.reshape(len(self._bodies), 4)
        picks = commands[:, 3] > 0.0
        substeps = self._world.steps_per_control // self._interval
        move = commands[:, :3] * (self._reach / substeps)
        for picker, pick in enumerate(picks):
            if not pick:
                self._release(picker)
        for _ in range(substeps):
            self._grasp(picks)
            self._send(move)
            for _ in range(self._interval):
                self._world.step()
            self._locate()

    def _release(self, picker: int) -> None:
        """Release the node that a picker holds, if any."""
        if self.held[picker] is not None:
            self._target.release(self._handles[picker])
            self.held[picker] = None
            self._paint(picker, COLORS)

    def _grasp(self, picks: np.ndarray) -> None:
        """Let each empty picker that is commanded to grasp take the nearest free node in range."""
        empty = [picker for picker, pick in enumerate(picks) if pick and self.held[picker] is None]
        if not empty:
            return
        nodes = self._target.nodes()
        for picker in empty:
            offsets = nodes - self.positions[picker]
            distances = np.sqrt((offsets**2).sum(axis=1))
            distances[[node for node in self.held if node is not None]] = np.inf
            node = int(distances.argmin())
            if distances[node] <= self._grasp_range:
                self.held[picker] = node
                self._handles[picker] = self._target.hold(node, self._bodies[picker])
                self._offsets[picker] = offsets[node]
                self._paint(picker, HOLDING_COLORS)

    def _send(self, move: np.ndarray) -> None:
        """Set the velocities that move unhindered pickers by ``move`` in one sub-step."""
        there = np.clip(self._sent + move, self._low, self._high)
        first, second = self.held
        if first is not None and second is not None:
            there = self._restrained(there, self._target.tether(first, second))
        way = there - self.positions
        distance = np.sqrt((way**2).sum(axis=1, keepdims=True))
        longest = LAG + np.sqrt((move**2).sum(axis=1, keepdims=True))
        way *= longest / np.maximum(distance, longest)
        self._sent = self.positions + way
        for body, velocity in zip(self._bodies, way / (self._world.time_step * self._interval) + self._lift, strict=True):
            self._world.client.resetBaseVelocity(body, velocity, (0.0, 0.0, 0.0))

    def _restrained(self, there: np.ndarray, tether: float) -> np.ndarray:
        """Move both targets toward each other, by the same distance, until the held nodes are within their tether."""
        first, second = there + self._offsets
        distance = np.sqrt(((second - first) ** 2).sum())
        if distance <= tether:
            return there
        give = (second - first) * (1 - tether / distance) / 2
        return np.clip(there + np.stack([give, -give]), self._low, self._high)

    def remove(self) -> None:
        """Release everything and remove the pickers from the world."""
        for picker, body in enumerate(self._bodies):
            self._release(picker)
            self._world.client.removeBody(body)

    def _locate(self) -> None:
        get = self._world.client.getBasePositionAndOrientation
        self.positions = np.array([get(body)[0] for body in self._bodies])

    def _paint(self, picker: int, colors: tuple[tuple[float, ...], ...]) -> None:
        self._world.client.changeVisualShape(self._bodies[picker], -1, rgbaColor=colors[picker])
