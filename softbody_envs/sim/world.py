"""One Bullet world: the client, its settings, and the rigid boxes that scenes are built of."""

from collections.abc import Sequence

import pybullet
from pybullet_utils.bullet_client import BulletClient

from softbody_envs.sim.quiet import quiet

#: One control step: what an action lasts, s (SoftGym: 8 steps of 0.01 s).
CONTROL_PERIOD = 0.08
GRAVITY = -9.8


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
        with quiet():
            self.client = BulletClient(pybullet.DIRECT)

    def clear(self) -> None:
        """Remove every body and set all settings again: ``resetSimulation`` forgets some of them and keeps others."""
        self.client.resetSimulation(pybullet.RESET_USE_DEFORMABLE_WORLD if self.deformable else 0)
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
        if self.client._client >= 0 and self.client.isConnected():
            self.client.disconnect()

    def add_floor(self, height: float = 0.0, half_size: float = 3.0, color: Sequence[float] = (0.85, 0.85, 0.85, 1.0)) -> int:
        """
        An infinite half-space that nothing can tunnel through, drawn as a slab. Rigid worlds only: cloth needs a box.

        :param height: of the surface, m
        :return: the body's id
        """
        slab = self.client.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=(half_size, half_size, 0.01), rgbaColor=color, visualFramePosition=(0, 0, -0.01)
        )
        plane = self.client.createCollisionShape(pybullet.GEOM_PLANE, planeNormal=(0, 0, 1))
        return self.client.createMultiBody(0, plane, slab, basePosition=(0, 0, height))

    def add_box_floor(self, half_size: float = 5.0, color: Sequence[float] = (0.85, 0.85, 0.85, 1.0)) -> int:
        """
        A thick slab with its top at z = 0, for deformable worlds: on a plane a cloth never settles.

        :return: the body's id
        """
        half_extents = (half_size, half_size, 0.5)
        body = self.client.createMultiBody(
            0,
            self.client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half_extents),
            self.client.createVisualShape(pybullet.GEOM_BOX, halfExtents=half_extents, rgbaColor=color),
            basePosition=(0, 0, -0.5),
            useMaximalCoordinates=True,  # a sixth cheaper under a cloth
        )
        self.client.changeDynamics(body, -1, lateralFriction=1.0)
        return body
