"""What a model's environments are made of, as far as they tell, to evaluate the model in the same."""

from typing import Any

import gymnasium as gym
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import OrderEnforcing
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize

from sb3_por.common.plain import is_kept, with_marked_tuples

#: Wrappers that change neither what a policy sees nor how its actions act, and subclasses; whole episodes are scored
PASSED_OVER = (
    "HumanRendering",
    "Monitor",
    "RecordEpisodeStatistics",
    "RecordVideo",
    "RenderCollection",
    "TimeLimit",
)
#: Arguments of an environment that evaluation chooses itself
CHOSEN = ("render_mode", "render_size", "split")


def made_of(env: VecEnv | None) -> dict[str, Any] | None:
    """
    Describe environments that ``gymnasium.make`` has made, and the wrappers around them.

    :param env: Vectorized environments of this process; worker processes keep theirs
    :return: For JSON, tuples marked: ``env_id``, ``env_kwargs``, ``env_wrapper`` (``[{path: arguments}]``, innermost first),
        ``normalize`` (arguments of ``VecNormalize``) and ``unknown`` (names of what cannot be made again from its name and
        plain arguments); None where nothing is known
    """
    normalize = None
    while isinstance(env, VecEnvWrapper):
        if isinstance(env, VecNormalize):
            normalize = {"norm_obs": env.norm_obs, "norm_reward": env.norm_reward}
        env = env.venv
    inner = next(iter(getattr(env, "envs", [])), None)
    wrappers: list[gym.Wrapper] = []
    # What gymnasium.make has put inside of OrderEnforcing, it makes again
    while isinstance(inner, gym.Wrapper) and not isinstance(inner, OrderEnforcing):
        is_only_end = _is_time_limit(type(inner)) and not _has_limit(inner)
        if is_only_end or not any(cls.__name__ in PASSED_OVER for cls in type(inner).__mro__):
            wrappers.insert(0, inner)
        inner = inner.env
    if inner is None or inner.spec is None:
        return None
    known = [wrapper for wrapper in wrappers if _can_be_made(wrapper)]
    kwargs = {name: value for name, value in inner.spec.kwargs.items() if name not in CHOSEN}
    if known and inner.spec.kwargs.get("render_mode") == "rgb_array":
        kwargs["render_mode"] = "rgb_array"  # a wrapper may show it to the policy
    return {
        "env_id": inner.spec.id,
        "env_kwargs": {name: with_marked_tuples(value) for name, value in kwargs.items() if is_kept(value)},
        "env_wrapper": [{_path(type(one)): with_marked_tuples(_arguments(one))} for one in known],
        "normalize": normalize,
        "unknown": [type(wrapper).__name__ for wrapper in wrappers if wrapper not in known]
        + [name for name, value in kwargs.items() if not is_kept(value)],
    }


def _is_time_limit(cls: type) -> bool:
    """By its name: the RL Zoo puts a class of its own in the place of Gymnasium's."""
    return any(one.__name__ == "TimeLimit" for one in cls.__mro__)


def _has_limit(env: gym.Env) -> bool:
    """Whether episodes of this id end without a further limit."""
    spec = env.unwrapped.spec
    registered = None if spec is None else gym.registry.get(spec.id)
    return registered is None or registered.max_episode_steps is not None


def _can_be_made(wrapper: gym.Wrapper) -> bool:
    return (
        isinstance(wrapper, RecordConstructorArgs) and "<" not in type(wrapper).__qualname__ and is_kept(_arguments(wrapper))
    )


def _path(cls: type) -> str:
    """Dotted path as users type it: ``gymnasium.wrappers.ClipReward``."""
    if _is_time_limit(cls):
        return "gymnasium.wrappers.TimeLimit"
    is_public = getattr(gym.wrappers, cls.__name__, None) is cls
    return f"gymnasium.wrappers.{cls.__name__}" if is_public else f"{cls.__module__}.{cls.__qualname__}"


def _arguments(wrapper: Any) -> dict[str, Any]:
    return {name: value for name, value in wrapper._saved_kwargs.items() if name != "env"}
