"""Checks of a run's settings before it is made."""

import inspect
import re
import sys
from typing import Any

from gymnasium import spaces
from gymnasium.spaces.utils import flatdim
from rl_zoo3 import ALGOS
from stable_baselines3.common.preprocessing import is_image_space

from sb3_por import ALGORITHMS
from sb3_por.common.checks import check_ranges, check_types
from sb3_por.common.errors import UserError, check_known
from sb3_por.visual.algorithm import RANGES

#: Settings that the RL Zoo reads itself, and an algorithm does not get
OF_THE_ZOO = (
    *("n_timesteps", "n_envs", "vec_env_class", "vec_env_kwargs", "normalize", "callback", "noise_type", "noise_std"),
    *("env_kwargs", "env_wrapper", "vec_env_wrapper", "frame_stack"),
)


def check_settings(algo: str, settings: dict[str, Any]) -> None:
    """
    Check the arguments of an algorithm, SB3's own ones, too: SB3 fails at the first update, or computes with what it got.

    :param algo: Name of the algorithm
    :param settings: Arguments of its constructor
    :raises UserError: If it has no such argument; the message has the nearest one
    :raises TypeError: If a value has the wrong type
    :raises ValueError: If a number is out of its range
    """
    for name in settings:
        check_known(f"setting of {algo}", name, inspect.signature(ALGOS[algo]).parameters)
    check_types(ALGOS[algo], settings)
    check_ranges(settings, RANGES)


def check_names(algo: str, settings: dict[str, Any]) -> None:
    """
    :param algo: Name of an algorithm
    :param settings: Changes to its settings
    :raises UserError: If there is no such algorithm, or neither it nor the RL Zoo has a setting of that name; the message has
        the nearest one
    """
    known = {**ALGOS, **ALGORITHMS}  # ours are among the zoo's only where its command runs
    check_known("algorithm", algo, known)
    for name in settings:
        check_known(f"setting of {algo}", name, [*inspect.signature(known[algo]).parameters, *OF_THE_ZOO])


def check_zoo_settings(settings: dict[str, Any]) -> None:
    """
    Check what the RL Zoo itself reads, and takes apart without a look.

    :param settings: Hyperparameters
    :raises UserError: If one cannot be used
    """
    for name in ("n_envs", "frame_stack", "n_timesteps"):
        value = settings.get(name, 1)
        if name == "n_timesteps" and isinstance(value, float) and value.is_integer():
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise UserError(f"{name} must be a whole number of at least 1, got {value!r}")
    unit = settings["train_freq"][-1:] if isinstance(settings.get("train_freq"), (tuple, list)) else ()
    if settings.get("n_envs", 1) > 1 and tuple(unit) == ("episode",):
        raise UserError("train_freq in episodes needs one environment: n_envs:1, or a train_freq in steps")
    if settings.get("noise_type") and "noise_std" not in settings:
        raise UserError("noise_type needs noise_std")
    if "seed" in settings:
        raise UserError("the seed is a flag: --seed")
    for name in ("learning_rate", "clip_range", "clip_range_vf", "delta_std"):
        value = settings.get(name)
        if isinstance(value, str) and not re.fullmatch(r"lin_[-+.e\d]*\d[-+.e\d]*", value):
            raise UserError(
                f"{name} must be a number, or lin_NUMBER for one that falls to 0, got {value!r}; YAML needs a point: 1.0e-3"
            )


def check_policy(policy: Any, space: spaces.Space, env_id: str) -> None:
    """
    :param policy: Policy that the settings name
    :raises UserError: If the policy cannot read the observations
    """
    if policy == "CnnPolicy" and isinstance(space, spaces.Box) and len(space.shape) == 3 and space.low.min() < 0:
        raise UserError(
            f"normalize:True would normalize the images of {env_id}, which CnnPolicy scales itself; pass -params "
            "\"normalize:{'norm_obs':False,'norm_reward':True}\" to normalize rewards alone"
        )
    needed = "MultiInputPolicy" if isinstance(space, spaces.Dict) else "CnnPolicy" if is_image_space(space) else "MlpPolicy"
    # MlpPolicy flattens images, which works, however badly.
    fits = policy == needed or (policy == "MlpPolicy" and needed == "CnnPolicy")
    if policy in ("MlpPolicy", "CnnPolicy", "MultiInputPolicy") and not fits:
        alone = " policy_kwargs:{}" if needed == "MlpPolicy" else ""  # the settings may have those of convolutions
        raise UserError(f"{policy} cannot read the observations of {env_id}, {space}; pass -params policy:{needed}{alone}")
    if policy != needed and policy == "MlpPolicy":
        print(
            f"note: MlpPolicy flattens the images of {env_id} into {flatdim(space)} numbers; you may want "
            "-params policy:CnnPolicy, or --env-kwargs obs_type:state where the environment has it",
            file=sys.stderr,
        )
