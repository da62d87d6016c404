"""A ball that is put where it belongs: the diagnostic tasks have their motion in closed form."""

from collections.abc import Sequence

import numpy as np
import pybullet

from softbody_envs.sim.world import World

RADIUS = 0.12
COLOR = (0.85, 0.20, 0.15, 1.0)


class Ball:
    """
    :param world: what the ball is drawn in; it touches nothing
    """

    def __init__(self, world: World) -> None:
        self._client = world.client
        look = world.client.createVisualShape(pybullet.GEOM_SPHERE, radius=RADIUS, rgbaColor=COLOR)
        self._body = world.client.createMultiBody(0, -1, look, useMaximalCoordinates=True)

    def move(self, position: Sequence[float] | np.ndarray) -> None:
        """
        :param position: of the centre, m
        """
        self._client.resetBasePositionAndOrientation(self._body, position, (0.0, 0.0, 0.0, 1.0))
