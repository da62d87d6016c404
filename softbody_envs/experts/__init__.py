"""Scripted experts for the tasks. They act on the state vector and set the ceiling of the scores."""

from pkgutil import resolve_name
from typing import Protocol

import numpy as np

from softbody_envs.registration import ENV_IDS, task_class


class Expert(Protocol):
    """A scripted policy."""

    def reset(self) -> None:
        """Forget the episode."""

    def act(self, state: np.ndarray) -> np.ndarray:
        """
        :param state: the task's state vector
        :return: an action in [-1, 1]
        """


def has_expert(env_id: str) -> bool:
    """Whether the task behind an id, one of ours or a subclass of it, names an expert."""
    task = task_class(env_id)
    return task is not None and task.expert is not None


def make_expert(env_id: str) -> Expert:
    """
    :param env_id: id of a task that has an expert: one of ours, or one registered for the same class or a subclass of it
    :raises ValueError: if it has none
    """
    task = task_class(env_id)
    if task is None or task.expert is None:
        raise ValueError(f"no expert for {env_id!r}; there is one for {', '.join(EXPERT_IDS)}")
    return resolve_name(task.expert)()


#: Those of ``ENV_IDS`` that have an expert.
EXPERT_IDS = tuple(filter(has_expert, ENV_IDS))
