"""A Bullet physics server of one's own, in the process and without a window."""

from functools import partial
from typing import Any

import pybullet


class Client:
    """
    Calls the functions of ``pybullet`` on a private server: ``client.stepSimulation()``.

    ``pybullet_utils.BulletClient`` does the same but passes empty options, for which Bullet prints ``argv[0]=``.
    """

    def __init__(self) -> None:
        self._server = pybullet.connect(pybullet.DIRECT)

    def __getattr__(self, name: str) -> Any:
        function = partial(getattr(pybullet, name), physicsClientId=self._server)
        setattr(self, name, function)  # cached: the next access does not come here
        return function

    def close(self) -> None:
        """Free the server and its memory. A second call does nothing."""
        if self._server >= 0:
            pybullet.disconnect(self._server)
            self.__dict__.clear()  # Bullet reuses server ids: cached functions would reach the next server
            self._server = -1

    def __del__(self) -> None:
        self.close()
