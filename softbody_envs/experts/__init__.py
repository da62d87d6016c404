"""Scripted experts, one a task: they see the state vector only and give the ceiling of the scores."""

from importlib import import_module
from typing import Protocol

import numpy as np


class Expert(Protocol):
    """A scripted policy."""

    def reset(self) -> None:
        """Forget the episode."""

    def act(self, state: np.ndarray) -> np.ndarray:
        """
        :param state: the task's state vector
        :return: an action in [-1, 1]
        """


#: id -> module:class under ``softbody_envs.experts``
_TABLE = {
    "PourWater-v0": "pour_water:PourWaterExpert",
    "PourWaterAmount-v0": "pour_water:PourWaterAmountExpert",
    "StraightenRope-v0": "straighten_rope:StraightenRopeExpert",
    "FoldCloth-v0": "fold_cloth:FoldClothExpert",
    "DropFoldCloth-v0": "drop_fold_cloth:DropFoldClothExpert",
}

#: Environments that have an expert.
EXPERT_IDS = tuple(_TABLE)


def make_expert(env_id: str) -> Expert:
    """
    :param env_id: an id of ``softbody_envs.ENV_IDS`` that has an expert
    :raises ValueError: if it has none
    """
    if env_id not in _TABLE:
        raise ValueError(f"no expert for {env_id!r}; there is one for {', '.join(_TABLE)}")
    module, name = _TABLE[env_id].split(":")
    return getattr(import_module(f"softbody_envs.experts.{module}"), name)()
