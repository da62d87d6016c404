"""Recorded episodes played as an environment, and a replay buffer filled from it."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack

from sb3_por.common.errors import UserError, one_line
from sb3_por.common.frames import n_stacked
from sb3_por.demonstrations.dataset import Demonstrations, RecordedEpisode


class Playback(gym.Env[Any, Any]):
    """
    Plays recorded episodes one after the other, whatever the actions, and then starts again. ``info["action"]`` is the
    recorded action.

    :param demonstrations: The recorded episodes
    """

    def __init__(self, demonstrations: Demonstrations) -> None:
        self.observation_space, self.action_space = demonstrations.observation_space, demonstrations.action_space
        self._demonstrations = demonstrations
        self._episodes: Iterator[RecordedEpisode] = iter(())

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the next episode."""
        episode = next(self._episodes, None)
        if episode is None:
            self._episodes = self._demonstrations.episodes()
            episode = next(self._episodes)
        self._episode, self._step = episode, 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Give the next recorded step."""
        episode, t = self._episode, self._step
        self._step += 1
        ends = self._step == len(episode.rewards)
        info = {"action": episode.actions[t]}
        return (
            self._observation(),
            float(episode.rewards[t]),
            ends and episode.terminated,
            ends and not episode.terminated,
            info,
        )

    def _observation(self) -> Any:
        observations = self._episode.observations
        if isinstance(observations, dict):
            return {key: part[self._step] for key, part in observations.items()}
        return observations[self._step]


def n_transitions(demonstrations: Demonstrations) -> int:
    """
    :param demonstrations: Recorded episodes
    :return: Number of their steps
    """
    return sum(len(episode.rewards) for episode in demonstrations.episodes())


def fill(buffer: ReplayBuffer, demonstrations: Demonstrations) -> None:
    """
    Add all recorded steps to a replay buffer, with actions scaled to [-1, 1] as the agent's own. Frames are stacked and images
    get their channels first where the buffer has them so.

    :param buffer: An empty buffer for one environment and as many transitions
    :param demonstrations: Recorded episodes
    :raises UserError: If observations or actions are not those of the buffer
    """
    env = _stacked(demonstrations, buffer.observation_space, buffer.action_space)
    low, high = buffer.action_space.low, buffer.action_space.high  # type: ignore[attr-defined]  # a Box, as everywhere in SAC
    observation: Any = env.reset()
    for _ in range(buffer.buffer_size):
        following, rewards, dones, infos = env.step(np.zeros((1, *low.shape)))
        end = infos[0].get("terminal_observation")
        next_observation: Any = following if end is None else _batch_of_one(end)
        action = 2.0 * (np.clip(infos[0]["action"], low, high)[None] - low) / (high - low) - 1.0
        buffer.add(observation, next_observation, action, rewards, dones, infos)
        observation = following


def _stacked(demonstrations: Demonstrations, observation_space: spaces.Space, action_space: spaces.Space) -> VecEnv:
    """An environment that plays the episodes with these observations."""
    env: VecEnv = DummyVecEnv([lambda: Playback(demonstrations)])
    n_frames = n_stacked(observation_space, env.observation_space)
    try:
        env = BaseAlgorithm._wrap_env(VecFrameStack(env, n_frames) if n_frames > 1 else env, monitor_wrapper=False)
        check_for_correct_spaces(env, observation_space, action_space)
    except (ValueError, AssertionError) as error:
        raise UserError(
            f"the demonstrations in {demonstrations.path} are not from the training environment: {one_line(error)}; record "
            "them with the --algo, -params and --env-kwargs of the training"
        ) from error
    return env


def _batch_of_one(observation: Any) -> Any:
    if isinstance(observation, dict):
        return {key: np.asarray(part)[None] for key, part in observation.items()}
    return np.asarray(observation)[None]
