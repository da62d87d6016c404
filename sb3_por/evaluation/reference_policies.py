"""Reference policies: random, do-nothing and the scripted expert."""

from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_por.common.errors import UserError, check_known, one_line
from softbody_envs.experts import EXPERT_IDS, has_expert, make_expert
from softbody_envs.registration import task_class


class RandomModel:
    """
    Policy with uniformly random actions.

    :param env_id: a Gymnasium id
    :param seed: seed of the actions
    """

    def __init__(self, env_id: str, seed: int = 0) -> None:
        self.observation_space, self.action_space = _spaces(env_id)
        self.action_space.seed(seed)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Any]:
        """Sample one action for each observation."""
        return np.stack([self.action_space.sample() for _ in observation]), state


class IdleModel:
    """
    Policy that does nothing: the middle of every action's range, or what is next to 0 in a range without an end.

    :param env_id: a Gymnasium id with a ``Box`` action space
    """

    def __init__(self, env_id: str) -> None:
        self.observation_space, self.action_space = _spaces(env_id)
        if not isinstance(self.action_space, gym.spaces.Box):
            raise UserError(f"{env_id} has no action that does nothing: its action space is {self.action_space}, not a Box")

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Any]:
        """Return the same action for each observation."""
        low, high = self.action_space.low, self.action_space.high
        middle = np.where(self.action_space.bounded_below & self.action_space.bounded_above, (low + high) / 2, 0.0)
        return np.stack([np.clip(middle, low, high) for _ in observation]), state


class ExpertModel:
    """
    Policy of a task's scripted expert.

    :param env_id: id of a task with an expert
    """

    def __init__(self, env_id: str) -> None:
        if not has_expert(env_id):
            check_known("environment with an expert", env_id, EXPERT_IDS)
        self.observation_space, self.action_space = _spaces(env_id)
        self._make_expert = lambda: make_expert(env_id)
        self._experts: list[Any] = []

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Any]:
        """Return the expert's action for each state vector."""
        if len(self._experts) != len(observation):
            self._experts = [self._make_expert() for _ in observation]
        starts = np.zeros(len(observation), dtype=bool) if episode_start is None else episode_start
        for expert, start in zip(self._experts, starts, strict=True):
            if start:
                expert.reset()
        return np.stack([expert.act(vector) for expert, vector in zip(self._experts, observation, strict=True)]), state


#: Names that ``--model`` accepts instead of a file.
REFERENCES = {"random": RandomModel, "nothing": IdleModel, "expert": ExpertModel}


def _spaces(env_id: str) -> tuple[gym.Space, Any]:
    try:
        kwargs: dict[str, Any] = {} if task_class(env_id) is None else {"obs_type": "state"}
        env = gym.make(env_id, **kwargs)
    except gym.error.Error as error:
        raise UserError(f"cannot make {env_id}: {one_line(error)}") from error
    seen = BaseAlgorithm._wrap_env(DummyVecEnv([lambda: env]), verbose=0, monitor_wrapper=False)  # images as models see them
    seen.close()
    return seen.observation_space, seen.action_space
