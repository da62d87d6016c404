"""Registered environment ids, and the task class behind an id."""

from importlib import import_module
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, find_highest_version, get_env_id, load_env_creator, parse_env_id

from softbody_envs.env import SoftbodyEnv

#: id -> (module:class under ``softbody_envs.tasks``, horizon in control steps of 0.08 s)
_TABLE = {
    "PourWater-v0": ("pour_water:PourWaterEnv", 100),
    "PourWaterAmount-v0": ("pour_water_amount:PourWaterAmountEnv", 100),
    "StraightenRope-v0": ("straighten_rope:StraightenRopeEnv", 75),
    "FoldCloth-v0": ("fold_cloth:FoldClothEnv", 100),
    "DropFoldCloth-v0": ("drop_fold_cloth:DropFoldClothEnv", 100),
    "FallingBall-v0": ("falling_ball:FallingBallEnv", 50),
    "SwingingBall-v0": ("swinging_ball:SwingingBallEnv", 100),
}

#: Ids that ``import softbody_envs`` registers.
ENV_IDS = tuple(_TABLE)


def register_envs() -> None:
    """Register every task with Gymnasium. A second call changes nothing."""
    for env_id, (entry_point, horizon) in _TABLE.items():
        if env_id not in gym.registry:
            gym.register(env_id, entry_point=f"softbody_envs.tasks.{entry_point}", max_episode_steps=horizon)


def task_class(env_id: str) -> type[SoftbodyEnv] | None:
    """
    Return the task class behind an id: one of ours, or a user's variant of one (own id, own defaults or subclass).

    :param env_id: registered id, as ``gymnasium.make`` takes it: the module that registers it may stand in front
        (``"module:Id-v0"``), the version may be left out
    :return: class of the unwrapped environment, or ``None`` if the id is unknown or not a task of this package
    """
    try:
        made = _made_class(_find_spec(env_id))
    except (gym.error.Error, ImportError, AttributeError):  # gymnasium.make explains what is wrong with the id
        return None
    return made if issubclass(made, SoftbodyEnv) else None


def _find_spec(env_id: str) -> EnvSpec:
    module, _, env_id = env_id.rpartition(":")
    if module:
        import_module(module)
    namespace, name, version = parse_env_id(env_id)
    if version is None:
        version = find_highest_version(namespace, name)
    return gym.spec(get_env_id(namespace, name, version))


#: id -> its specification and the class of the environment that it makes
_made_classes: dict[str, tuple[EnvSpec, type]] = {}


def _made_class(spec: EnvSpec) -> type:
    """Class of the environment that a specification makes, found once."""
    known, made = _made_classes.get(spec.id, (None, object))
    if known is not spec:  # an id can be registered again
        made = _find_class(spec)
        _made_classes[spec.id] = spec, made
    return made


def _find_class(spec: EnvSpec) -> type:
    """Class of the environment that an entry point makes. Functions and wrappers are called to find out."""
    creator: Any = load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point
    if isinstance(creator, type) and not issubclass(creator, gym.Wrapper):
        return creator
    try:
        env = creator(**spec.kwargs)
    except Exception as error:  # of a user's code, which may need arguments that the specification does not have
        gym.logger.warn(
            f"{spec.id} is not taken for a task of softbody_envs: its entry point cannot be called without arguments "
            f"({type(error).__name__}: {error}). If it makes one, register it with kwargs= or as a class."
        )
        return object
    env.close()
    return type(env.unwrapped)
