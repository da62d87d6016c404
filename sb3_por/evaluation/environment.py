"""Environments that give a model the observations it was trained on."""

from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize

from sb3_por.common.errors import UserError, one_line
from sb3_por.common.frames import n_stacked
from sb3_por.evaluation.episodes import FixedEpisodes, Model, scene_kwargs
from sb3_por.evaluation.plain_files import STATISTICS, normalize, read_json
from sb3_por.runs.environment import EnvWrapper, VecEnvWrapper
from softbody_envs.registration import task_class


def make_evaluation_env(
    model: Model,
    env_id: str,
    env_kwargs: dict[str, Any] | None = None,
    vec_normalize: str | None = None,
    env_wrapper: EnvWrapper | None = None,
    vec_env_wrapper: VecEnvWrapper | None = None,
) -> VecEnv:
    """
    :param model: Its ``observation_space`` tells the number of stacked frames
    :param env_id: Gymnasium id
    :param env_kwargs: Arguments of the environment's constructor; None to read them from the model's observation space
    :param vec_normalize: File of the ``VecNormalize`` statistics that the model was trained with: a pickle of SB3, or the
        model's ``.zip`` if that holds them in plain form
    :param env_wrapper: Wrappers that the model was trained inside; around ``Monitor``, as in the RL Zoo
    :param vec_env_wrapper: Wrappers of the vectorized environments that the model was trained inside
    :return: A vectorized environment that plays held-out episodes
    :raises UserError: If the environment cannot be made, or its spaces are not the model's
    """
    own = observation_kwargs(env_id, model.observation_space) if env_kwargs is None else env_kwargs
    env = make_wrapped(env_id, own, env_wrapper, vec_env_wrapper)
    try:
        env = _stack_and_normalize(env, model.observation_space, vec_normalize)
        check_for_correct_spaces(env, model.observation_space, model.action_space)
    except (ValueError, AssertionError) as error:
        env.close()
        raise UserError(f"the model was not trained on {env_id}: {one_line(error)}") from error
    return env


def make_wrapped(
    env_id: str,
    env_kwargs: dict[str, Any],
    env_wrapper: EnvWrapper | None = None,
    vec_env_wrapper: VecEnvWrapper | None = None,
) -> VecEnv:
    """
    :param env_id: Gymnasium id
    :param env_kwargs: Arguments of the environment's constructor
    :param env_wrapper: Wrappers; around ``Monitor``, as in the RL Zoo
    :param vec_env_wrapper: Wrappers of the vectorized environments
    :return: One vectorized environment that plays held-out episodes; frames are not stacked, images not transposed
    :raises UserError: If the environment cannot be made
    """
    kwargs = scene_kwargs(env_id, "eval") | env_kwargs

    def make() -> gym.Env:
        env: gym.Env = Monitor(gym.make(env_id, **kwargs))
        return FixedEpisodes(env if env_wrapper is None else env_wrapper(env))

    try:
        env: VecEnv = DummyVecEnv([make])
        return env if vec_env_wrapper is None else vec_env_wrapper(env)
    except (TypeError, ValueError, gym.error.Error) as error:
        raise UserError(f"cannot make {env_id}: {one_line(error)}") from error


def observation_kwargs(env_id: str, space: spaces.Space) -> dict[str, Any]:
    """
    :param env_id: Gymnasium id
    :param space: Observation space of a model, of which nothing else is known
    :return: Arguments that make one of our tasks give such observations; empty for other environments
    """
    if task_class(env_id) is None:
        return {}
    image = space.spaces.get("image") if isinstance(space, spaces.Dict) else space
    if image is None or image.shape is None or len(image.shape) != 3:
        return {"obs_type": "state"}
    # Channels first or last, the middle axis of a square image is its size.
    return {"obs_type": "dict" if isinstance(space, spaces.Dict) else "pixels", "image_size": image.shape[1]}


def _stack_and_normalize(env: VecEnv, space: spaces.Space, statistics: str | None) -> VecEnv:
    """Stack frames, put channels first, and normalize around that, as ``train.py`` does."""
    stacked = _stack(env, space)
    if statistics is None:
        return stacked
    try:
        return _normalize(stacked, statistics)
    except AssertionError:  # Statistics of another shape: the RL Zoo normalizes before it stacks and transposes
        return _stack(_normalize(env, statistics), space)


def _stack(env: VecEnv, space: spaces.Space) -> VecEnv:
    n_frames = n_stacked(space, env.observation_space)
    if n_frames > 1:
        env = VecFrameStack(env, n_frames)
    return BaseAlgorithm._wrap_env(env, verbose=0, monitor_wrapper=False)  # channels first, as SB3 does in training


def _normalize(env: VecEnv, statistics: str) -> VecEnv:
    if statistics.endswith(".zip"):
        return normalize(env, read_json(Path(statistics), STATISTICS))
    try:
        env = VecNormalize.load(statistics, env)
    except AssertionError:  # statistics of another shape
        raise
    except Exception as error:  # whatever a damaged pickle raises
        raise UserError(f"cannot read the statistics of observations {statistics}: {one_line(error)}") from error
    env.training = env.norm_reward = False
    return env
