"""What the tasks with two pickers share."""

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np
from gymnasium.utils import EzPickle

from softbody_envs.env import SoftbodyEnv
from softbody_envs.sim.pickers import Pickers

#: Elements of an action that say whether a picker holds.
PICKS = [3, 7]


class PickerEnv(SoftbodyEnv):
    """
    Base class of the tasks with two pickers, which a task makes in its ``_build``.

    :param keep_hold: the pickers take what they come near to and never let go, whatever the action says
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
        """Find out where rope or cloth is; between control steps nothing moves."""
