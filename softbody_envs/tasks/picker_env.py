"""Base class of the tasks with two pickers."""

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np
from gymnasium.utils import EzPickle

from softbody_envs.env import SoftbodyEnv
from softbody_envs.sim.pickers import Pickers

#: Indices of the actions that make a picker hold.
PICKS = [3, 7]


class PickerEnv(SoftbodyEnv):
    """
    Base class of the tasks with two pickers, which a task creates in ``_build``.

    :param keep_hold: whether pickers grasp whatever they reach and never let go, regardless of the action
    """

    action_size: ClassVar[int] = 8
    pickers: Pickers

    def __init__(self, *args: Any, keep_hold: bool = False, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        EzPickle.__init__(self, *args, keep_hold=keep_hold, **kwargs)
        self.keep_hold = keep_hold

    def _control(self, action: np.ndarray) -> None:
        if self.keep_hold:
            action = action.copy()
            action[PICKS] = 1.0
        self.pickers.control(action)
        self._locate()

    @abstractmethod
    def _locate(self) -> None:
        """Read the positions of the rope or the cloth once per control step."""
