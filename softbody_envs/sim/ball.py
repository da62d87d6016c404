"""A ball without physics, for the diagnostic tasks, whose motion has a closed form."""

from collections.abc import Sequence

import numpy as np
import pybullet

from softbody_envs.sim.world import World

RADIUS = 0.12
COLOR = (0.85, 0.20, 0.15, 1.0)


class Ball:
    """
    A sphere that is placed at will and collides with nothing.

    :param world: world that the ball is drawn in
    """

    def __init__(self, world: World) -> None:
        self._client = world.client
        look = world.client.createVisualShape(pybullet.GEOM_SPHERE, radius=RADIUS, rgbaColor=COLOR)
        self._body = world.client.createMultiBody(0, -1, look, useMaximalCoordinates=True)

    def move(self, position: Sequence[float] | np.ndarray) -> None:
        """
        Place the ball.

        :param position: position of the centre, m
        """
        self._client.resetBasePositionAndOrientation(self._body, position, (0.0, 0.0, 0.0, 1.0))
