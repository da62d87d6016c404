"""Scripted experts for the tasks. They act on the state vector and set the ceiling of the scores."""

from pkgutil import resolve_name
from typing import Protocol

import numpy as np

from softbody_envs.experts.pace import FULL_SPEED, Pace
from softbody_envs.registration import ENV_IDS, task_class


class Expert(Protocol):
    """
    A scripted policy. One whose plan may fail has ``attempts``, the number of plans for a scene, and ``retry()``, which
    forgets the episode as ``reset()`` does and makes the next plan.
    """

    def reset(self) -> None:
        """Forget the episode."""

    def act(self, state: np.ndarray) -> np.ndarray:
        """
        Choose an action.

        :param state: state vector of the task
        :return: action in [-1, 1]
        """


def has_expert(env_id: str) -> bool:
    """Test whether the task behind an id, one of ours or a subclass of one, has an expert."""
    task = task_class(env_id)
    return task is not None and task.expert is not None


def make_expert(env_id: str, pace: Pace = FULL_SPEED) -> Expert:
    """
    Make the expert of a task.

    :param env_id: id of a task that has an expert, or of a subclass of such a task
    :param pace: what becomes of the expert's actions; it is asked once per action
    :raises ValueError: if there is no expert for this id
    """
    task = task_class(env_id)
    if task is None or task.expert is None:
        raise ValueError(f"no expert for {env_id!r}; there is one for {', '.join(EXPERT_IDS)}")
    expert = resolve_name(task.expert)
    return expert() if pace == FULL_SPEED else expert(pace)


#: Ids in ``ENV_IDS`` that have an expert.
EXPERT_IDS = tuple(filter(has_expert, ENV_IDS))
