"""Episodes played with a model for its diagnosis: transitions, frames, and the physical quantity in each frame."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv

from sb3_por.analysis.controls import PlayedFrames
from sb3_por.evaluation.episodes import Episode
from sb3_por.visual.replay_buffer import SequenceReplayBuffer

#: Frames that pass the encoder at once.
CHUNK = 256


class AsPlayed(SequenceReplayBuffer):
    """Transitions as a model's environments gave them, normalized there if anywhere: a model's own normalizer has no part."""

    @staticmethod
    def _normalize_obs(obs: Any, env: Any = None) -> Any:
        return obs

    @staticmethod
    def _normalize_reward(reward: np.ndarray, env: Any = None) -> np.ndarray:
        return reward


@dataclass(frozen=True)
class Played:
    """
    Episodes that were played.

    :param transitions: all transitions, as the algorithm samples them
    :param frames: place in time and physical quantity of each frame
    :param observations: the frames, each a batch of one
    """

    transitions: SequenceReplayBuffer
    frames: PlayedFrames
    observations: list[Any]


def play(model: Any, env: VecEnv, episodes: list[Episode], at_random: bool = False) -> Played:
    """
    Play episodes with a model's deterministic policy.

    :param model: an algorithm of this package
    :param env: a single environment, as :func:`sb3_por.evaluation.evaluate.make_evaluation_env` makes it
    :param episodes: the episodes
    :param at_random: sample the actions uniformly instead
    """
    env.env_method("play", episodes)
    observation: Any = env.reset()
    observations, quantities, steps = [observation], [_quantity(env.unwrapped.reset_infos[0])], [0]
    transitions: list[Any] = []
    n_done = 0
    while True:
        action = np.array([env.action_space.sample()]) if at_random else model.predict(observation, deterministic=True)[0]
        following, reward, done, infos = env.step(action)
        last = _batch(infos[0]["terminal_observation"]) if done[0] else following
        transitions.append((observation, last, model.policy.scale_action(action), reward, done, infos))
        observations.append(last)
        quantities.append(_quantity(infos[0]))
        steps.append(steps[-1] + 1)
        n_done += int(done[0])
        if n_done == len(episodes):
            break
        if done[0]:
            observations.append(following)
            quantities.append(_quantity(env.unwrapped.reset_infos[0]))
            steps.append(0)
        observation = following
    buffer = AsPlayed(
        len(transitions), model.observation_space, model.action_space, model.device, n_steps=model.n_steps, gamma=model.gamma
    )
    for transition in transitions:
        buffer.add(*transition)
    step = np.array(steps)
    return Played(buffer, PlayedFrames(np.cumsum(step == 0) - 1, step, np.array(quantities, float)), observations)


def encode(critic: Any, observations: list[Any], device: th.device) -> th.Tensor:
    """
    Encode frames with a critic's encoder.

    :param critic: a visual critic
    :param observations: frames, each a batch of one
    :param device: the critic's device
    :return: features without gradient, shape ``(frames, features_dim)``
    """
    chunks = [_concatenate(observations[i : i + CHUNK]) for i in range(0, len(observations), CHUNK)]
    with th.no_grad():
        return th.cat([critic.encode(obs_as_tensor(chunk, device)) for chunk in chunks])


def _quantity(info: dict[str, Any]) -> float:
    return info.get("monotone", np.nan)


def _batch(observation: Any) -> Any:
    """A batch of one observation."""
    return {key: value[None] for key, value in observation.items()} if isinstance(observation, dict) else observation[None]


def _concatenate(batches: list[Any]) -> Any:
    """One batch of several."""
    if isinstance(batches[0], dict):
        return {key: np.concatenate([batch[key] for batch in batches]) for key in batches[0]}
    return np.concatenate(batches)
