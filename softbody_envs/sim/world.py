"""One Bullet world: the client, its settings, and its floor."""

from dataclasses import dataclass

import pybullet

from softbody_envs.sim.client import Client

#: One control step: what an action lasts, s (SoftGym: 8 steps of 0.01 s).
CONTROL_PERIOD = 0.08
GRAVITY = -9.8


@dataclass(frozen=True)
class Floor:
    """
    A horizontal square about the z axis. Bullet has it as a body that nothing draws: `Renderer` does.

    :param height: m
    :param half_size: how far it is seen to reach, m; as a plane it collides beyond that
    """

    height: float
    half_size: float


class World:
    """
    A private Bullet client without a window.

    :param steps_per_control: simulation steps in one control step of 0.08 s
    :param deformable: a world that can hold cloth; rigid worlds are faster and do all else
    """

    def __init__(self, steps_per_control: int, deformable: bool = False) -> None:
        self.steps_per_control = steps_per_control
        self.time_step = CONTROL_PERIOD / steps_per_control
        self.deformable = deformable
        #: What the scene stands on, if anything.
        self.floor: Floor | None = None
        self.client = Client()

    def clear(self) -> None:
        """Remove every body and set all settings again: ``resetSimulation`` forgets some of them and keeps others."""
        self.client.resetSimulation(pybullet.RESET_USE_DEFORMABLE_WORLD if self.deformable else 0)
        self.floor = None
        self.client.setGravity(0.0, 0.0, GRAVITY)
        # File caching would serve an old mesh under a reused name (bullet#2277).
        self.client.setPhysicsEngineParameter(
            fixedTimeStep=self.time_step, numSubSteps=0, deterministicOverlappingPairs=1, enableFileCaching=0
        )

    def step(self) -> None:
        """Advance by ``time_step`` seconds."""
        self.client.stepSimulation()

    def close(self) -> None:
        """Disconnect; closing twice does nothing."""
        self.client.close()

    def add_floor(self, height: float = 0.0) -> Floor:
        """
        An infinite half-space that nothing can tunnel through. Rigid worlds only: cloth needs a box.

        :param height: of the surface, m
        :return: ``floor``, as it is now
        """
        plane = self.client.createCollisionShape(pybullet.GEOM_PLANE, planeNormal=(0, 0, 1))
        self._hide(self.client.createMultiBody(0, plane, basePosition=(0, 0, height)))
        self.floor = Floor(height, half_size=3.0)
        return self.floor

    def add_box_floor(self) -> Floor:
        """
        A thick slab with its top at z = 0, for deformable worlds: on a plane a cloth never settles.

        :return: ``floor``, as it is now
        """
        self.floor = Floor(0.0, half_size=5.0)
        box = self.client.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=(self.floor.half_size, self.floor.half_size, 0.5)
        )
        # Maximal coordinates are a sixth cheaper under a cloth.
        body = self.client.createMultiBody(0, box, basePosition=(0, 0, -0.5), useMaximalCoordinates=True)
        self.client.changeDynamics(body, -1, lateralFriction=1.0)
        self._hide(body)
        return self.floor

    def _hide(self, body: int) -> None:
        """A body without a visual shape would be drawn as it collides."""
        self.client.changeVisualShape(body, -1, rgbaColor=(0, 0, 0, 0))
