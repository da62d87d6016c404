"""A Bullet world: client, settings and floor."""

from dataclasses import dataclass
from typing import ClassVar

import pybullet

from softbody_envs.sim.client import Client

#: Duration of a control step, s (SoftGym: 8 steps of 0.01 s).
CONTROL_PERIOD = 0.08
GRAVITY = -9.8
#: Bullet's default distance at which a contact ends, m.
CONTACT_BREAKING_THRESHOLD = 0.02


@dataclass(frozen=True)
class Floor:
    """
    A horizontal square, centred on the z axis. Its Bullet body is invisible; ``Renderer`` draws it.

    :param height: height of the surface, m
    :param half_size: half of the visible side length, m; collisions may reach farther
    """

    height: float
    half_size: float


class World:
    """
    A private Bullet client without a window.

    :param steps_per_control: simulation steps in one control step of 0.08 s
    :param deformable: whether the world can hold cloth; rigid worlds are faster
    """

    #: Bullet's contact threshold, one variable for all worlds of the process, as a world has set it last.
    _threshold_in_use: ClassVar[float | None] = None

    def __init__(self, steps_per_control: int, deformable: bool = False) -> None:
        self.steps_per_control = steps_per_control
        self.time_step = CONTROL_PERIOD / steps_per_control
        self.deformable = deformable
        #: Floor of the scene, if there is one.
        self.floor: Floor | None = None
        #: Distance at which a contact ends, m; a task may set it after ``clear``.
        self.contact_breaking_threshold = CONTACT_BREAKING_THRESHOLD
        self.client = Client()

    def clear(self) -> None:
        """Remove all bodies and apply all settings again: ``resetSimulation`` resets some settings and keeps others."""
        self.client.resetSimulation(pybullet.RESET_USE_DEFORMABLE_WORLD if self.deformable else 0)
        self.floor = None
        self.contact_breaking_threshold = CONTACT_BREAKING_THRESHOLD
        World._threshold_in_use = None
        self.client.setGravity(0.0, 0.0, GRAVITY)
        # File caching would serve an old mesh under a reused name (bullet#2277).
        self.client.setPhysicsEngineParameter(
            fixedTimeStep=self.time_step, numSubSteps=0, deterministicOverlappingPairs=1, enableFileCaching=0
        )

    def step(self) -> None:
        """Advance by ``time_step`` seconds."""
        if World._threshold_in_use != self.contact_breaking_threshold:
            self.client.setPhysicsEngineParameter(contactBreakingThreshold=self.contact_breaking_threshold)
            World._threshold_in_use = self.contact_breaking_threshold
        self.client.stepSimulation()

    def close(self) -> None:
        """Free the client. A second call does nothing."""
        self.client.close()

    def add_floor(self, height: float = 0.0) -> Floor:
        """
        Add an infinite half-space, which nothing can tunnel through. For rigid worlds only: cloth needs a box.

        :param height: height of the surface, m
        :return: the new ``floor``
        """
        plane = self.client.createCollisionShape(pybullet.GEOM_PLANE, planeNormal=(0, 0, 1))
        self._hide(self.client.createMultiBody(0, plane, basePosition=(0, 0, height)))
        self.floor = Floor(height, half_size=3.0)
        return self.floor

    def add_box_floor(self) -> Floor:
        """
        Add a thick slab with its top at z = 0, for deformable worlds: a cloth never settles on a plane.

        :return: the new ``floor``
        """
        self.floor = Floor(0.0, half_size=5.0)
        box = self.client.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=(self.floor.half_size, self.floor.half_size, 0.5)
        )
        # Maximal coordinates make steps with a cloth a sixth cheaper.
        body = self.client.createMultiBody(0, box, basePosition=(0, 0, -0.5), useMaximalCoordinates=True)
        self.client.changeDynamics(body, -1, lateralFriction=1.0)
        self._hide(body)
        return self.floor

    def _hide(self, body: int) -> None:
        """Make a body invisible: without a visual shape, Bullet draws the collision shape."""
        self.client.changeVisualShape(body, -1, rgbaColor=(0, 0, 0, 0))
