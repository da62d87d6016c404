"""Evaluation on held-out variations with fixed seeds: the same episodes for every method, seed and checkpoint."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize

from sb3_por.common.errors import UserError, one_line
from sb3_por.evaluation.episodes import (
    EVAL_SEED,
    Evaluation,
    FixedEpisodes,
    Model,
    evaluation_episodes,
    evaluation_kwargs,
    run_episodes,
)
from softbody_envs.registration import ENV_IDS

#: Puts wrappers around an environment.
EnvWrapper = Callable[[gym.Env], gym.Env]


def make_evaluation_env(
    model: Model,
    env_id: str,
    env_kwargs: dict[str, Any] | None = None,
    vec_normalize: str | None = None,
    env_wrapper: EnvWrapper | None = None,
) -> VecEnv:
    """
    An environment that gives a model the observations it was trained on.

    :param model: its ``observation_space`` says observation type, image size and number of stacked frames
    :param env_id: a Gymnasium id
    :param env_kwargs: for the environment's constructor; they win over what is read from the model
    :param vec_normalize: file of ``VecNormalize`` statistics that the model was trained with
    :param env_wrapper: what the model was trained inside; put around the environment, outside of ``Monitor`` as the zoo does
    :raises UserError: if the environment cannot be made, or its spaces are not the model's
    """
    kwargs = _observation_kwargs(env_id, model.observation_space) | evaluation_kwargs(env_id) | (env_kwargs or {})

    def make() -> gym.Env:
        env: gym.Env = Monitor(gym.make(env_id, **kwargs))
        return FixedEpisodes(env if env_wrapper is None else env_wrapper(env))

    try:
        env: VecEnv = DummyVecEnv([make])
    except (TypeError, ValueError, gym.error.Error) as error:
        raise UserError(f"cannot make {env_id}: {one_line(error)}") from error
    try:
        if vec_normalize is not None:
            env = VecNormalize.load(vec_normalize, env)
            env.training = env.norm_reward = False
        n_stack = _size(model.observation_space) // max(_size(env.observation_space), 1)
        if n_stack > 1:
            env = VecFrameStack(env, n_stack)
        env = BaseAlgorithm._wrap_env(env, verbose=0, monitor_wrapper=False)  # channels first, as SB3 does in training
        check_for_correct_spaces(env, model.observation_space, model.action_space)
    except (ValueError, AssertionError) as error:
        env.close()
        raise UserError(f"the model was not trained on {env_id}: {one_line(error)}") from error
    return env


def evaluate(
    model: Model,
    env_id: str,
    n_episodes: int = 20,
    seed: int = EVAL_SEED,
    env_kwargs: dict[str, Any] | None = None,
    vec_normalize: str | None = None,
    env_wrapper: EnvWrapper | None = None,
) -> Evaluation:
    """
    Evaluate a model's deterministic policy on held-out variations 800, 801, ...

    :param model: an SB3 model; observation type and image size are read from its ``observation_space``
    :param env_id: a Gymnasium id
    :param n_episodes: number of episodes
    :param seed: seed of the first episode; the k-th is reset with ``seed + k``
    :param env_kwargs: for the environment's constructor
    :param vec_normalize: file of ``VecNormalize`` statistics that the model was trained with
    :param env_wrapper: what the model was trained inside
    :raises UserError: if the environment does not fit the model
    """
    if n_episodes < 1:
        raise UserError(f"an evaluation needs at least 1 episode, got {n_episodes}")
    env = make_evaluation_env(model, env_id, env_kwargs, vec_normalize, env_wrapper)
    try:
        return run_episodes(model, env, evaluation_episodes(env_id, n_episodes, seed))
    finally:
        env.close()


def _observation_kwargs(env_id: str, space: spaces.Space) -> dict[str, Any]:
    """What makes one of our environments give observations of a model's space."""
    if env_id not in ENV_IDS:
        return {}
    image = space.spaces.get("image") if isinstance(space, spaces.Dict) else space
    if image is None or not is_image_space(image, check_channels=False) or image.shape is None:
        return {"obs_type": "state"}
    # Channels first or last, the middle axis of a square image is its size.
    return {"obs_type": "dict" if isinstance(space, spaces.Dict) else "pixels", "image_size": image.shape[1]}


def _size(space: spaces.Space) -> int:
    """Number of elements of an observation, 0 where that is no one number."""
    return int(np.prod(space.shape)) if isinstance(space, spaces.Box) else 0
