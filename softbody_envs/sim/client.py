"""A private Bullet server inside the process."""

from functools import partial
from typing import Any

import pybullet


class Client:
    """
    Functions of ``pybullet``, applied to a server of its own without a window.

    ``pybullet_utils.BulletClient`` passes empty options, and Bullet then prints ``argv[0]=`` for each client.
    """

    def __init__(self) -> None:
        self._server = pybullet.connect(pybullet.DIRECT)

    def __getattr__(self, name: str) -> Any:
        function = partial(getattr(pybullet, name), physicsClientId=self._server)
        setattr(self, name, function)  # the next access finds it at once
        return function

    def close(self) -> None:
        """Free the server and its memory; closing twice does nothing."""
        if self._server >= 0:
            pybullet.disconnect(self._server)
            self.__dict__.clear()  # Bullet gives the number to the next server: kept functions would reach that
            self._server = -1

    def __del__(self) -> None:
        self.close()
