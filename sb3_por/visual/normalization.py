"""Observation wrappers belong inside ``VecNormalize``: the replay buffer stores what ``VecNormalize`` receives."""

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize


def transpose_inside(env: VecEnv) -> VecEnv:
    """
    Transpose the images of vectorized environments inside their ``VecNormalize``. SB3 transposes outside of it, and then
    stores the untransposed images that ``VecNormalize`` keeps.

    :param env: Vectorized environments, perhaps with a ``VecNormalize``, which is changed in place
    :return: The same, with channels first
    :raises ValueError: If other observation wrappers are around ``VecNormalize``, or if it normalizes images
    """
    if not isinstance(env, VecNormalize):
        if _is_around_normalization(env):
            raise ValueError(
                f"{type(env).__name__} is around VecNormalize, so that the replay buffer would store other observations than "
                "the policy sees: put VecNormalize around the other wrappers."
            )
        return env
    space = env.venv.observation_space
    images = [key for key, part in _parts(space).items() if is_image_space(part)]
    normalized = (env.norm_obs_keys or [""]) if env.norm_obs else []
    if any(_has_channels_last(_parts(space)[key]) for key in normalized):
        raise ValueError(
            "VecNormalize would normalize images with channels last, and what it returns is not known to be an image: use "
            "norm_obs=False, norm_obs_keys without the images, or VecTransposeImage inside of it."
        )
    inner = BaseAlgorithm._wrap_env(env.venv)
    if inner is not env.venv:
        env.venv = inner
        parts = _parts(inner.observation_space)
        env.observation_space = (
            spaces.Dict({key: parts[key] if key in images else part for key, part in _parts(env.observation_space).items()})
            if isinstance(space, spaces.Dict)
            else inner.observation_space
        )
    return env


def _has_channels_last(space: spaces.Space) -> bool:
    """By its shape: ``VecNormalize`` replaces the spaces of images that it normalizes."""
    shape = space.shape or ()
    return len(shape) == 3 and shape[0] != min(shape)


def _parts(space: spaces.Space) -> dict[str, spaces.Space]:
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {"": space}


def _is_around_normalization(env: VecEnv) -> bool:
    """Whether a wrapper that changes observations is around a ``VecNormalize``."""
    while isinstance(env, VecEnvWrapper):
        if isinstance(env.venv, VecNormalize) and env.observation_space != env.venv.observation_space:
            return True
        env = env.venv
    return False
