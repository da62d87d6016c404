"""Load any saved model for use: find its algorithm, name what is wrong with the file, allocate no replay buffer."""

import importlib
import inspect
import json
import pickle
import warnings
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import sb3_contrib
import stable_baselines3
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_por import ALGORITHMS
from sb3_por.common.errors import UserError, check_known, one_line
from sb3_por.evaluation.episodes import whole_episodes
from sb3_por.evaluation.evaluate import EnvWrapper
from sb3_por.runs.folder import (
    ARGUMENTS,
    BEST_MODEL,
    BEST_STATISTICS,
    HYPERPARAMETERS,
    STATISTICS,
    read_settings,
    run_arguments,
    the_run,
)

#: name -> class of every algorithm whose models can be loaded; a DDPG model is a TD3 model with other settings
LOADABLE: dict[str, type[BaseAlgorithm]] = {
    **{name.lower(): getattr(stable_baselines3, name) for name in ("A2C", "DQN", "PPO", "SAC", "TD3")},
    **{name.lower(): getattr(sb3_contrib, name) for name in ("CrossQ", "TQC", "TRPO")},
    **ALGORITHMS,
}


@contextmanager
def quiet_n_steps() -> Iterator[None]:
    """SB3 takes the buffer of n-step returns that it chose itself, in a loaded model, for one of the user's, and warns."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="`n_steps=.*NStepReplayBuffer")
        yield


def load_model(path: str | Path, algo: str | None = None, device: str = "auto") -> BaseAlgorithm:
    """
    :param path: a model's ``.zip``, or a run folder, which stands for its ``best_model.zip``
    :param algo: name of its algorithm; found from the file if ``None``
    :param device: PyTorch device
    :return: the model, ready to predict; its replay buffer holds one transition
    :raises UserError: if the file is not a saved model, or not one of this algorithm
    """
    path = model_file(path)
    data = read_data(path)
    if algo is not None:
        check_known("algorithm", algo, LOADABLE)
        candidates = [algo]
    else:
        candidates = _candidates(path, data)
    buffer: dict[str, Any] = {"buffer_size": 1} if "buffer_size" in data else {}
    problem: Exception | None = None
    for name in candidates:
        try:
            with quiet_n_steps():
                return LOADABLE[name].load(path, device=device, **buffer)
        # SB3 loads strictly: the wrong class fails on the names of the networks' parameters.
        except (AssertionError, AttributeError, KeyError, RuntimeError, TypeError, ValueError, pickle.PickleError) as error:
            problem = problem or error
    if problem is None:
        raise UserError(f"cannot tell which algorithm saved {path}; say --algo, one of {', '.join(LOADABLE)}")
    raise UserError(f"{path} is not a model of {' or '.join(candidates)}: {one_line(problem)[:200]}") from problem


def model_file(path: str | Path) -> Path:
    """
    :param path: a model's ``.zip``, or a run folder or one with a single run in it, which stands for its ``best_model.zip``
    :raises UserError: if there is no such file
    """
    path = Path(path)
    if path.is_dir():
        path = the_run(path) / BEST_MODEL
    if not path.is_file():
        raise UserError(f"there is no model {path}; give a .zip that train.py or model.save() wrote")
    return path


def settings_of(path: str | Path, env_id: str) -> Path:
    """
    :param path: as :func:`load_model` takes it
    :param env_id: the environment
    :return: where the settings of the model's run are, if it has any
    """
    return model_file(path).parent / env_id / HYPERPARAMETERS


def trained_in(path: str | Path, env_id: str) -> dict[str, Any]:
    """
    The environment that a run's model was trained in, as far as its folder says.

    :param path: as :func:`load_model` takes it
    :param env_id: the environment
    :return: the arguments ``env_kwargs``, ``vec_normalize`` and ``env_wrapper`` of :func:`sb3_por.evaluation.evaluate` and its
        likes
    :raises UserError: if a wrapper in its settings cannot be imported
    """
    file = model_file(path)
    folder = file.parent / env_id
    settings = read_settings(settings_of(path, env_id))
    env_kwargs = settings.get("env_kwargs")
    of_best = folder / BEST_STATISTICS
    statistics = of_best if file.name == BEST_MODEL and of_best.is_file() else folder / STATISTICS
    return {
        "env_kwargs": whole_episodes(env_kwargs) if isinstance(env_kwargs, dict) else {},
        "vec_normalize": str(statistics) if statistics.is_file() else None,
        "env_wrapper": _env_wrapper(settings),
    }


def _env_wrapper(settings: dict[str, Any]) -> EnvWrapper | None:
    """The wrappers that a run's settings name."""
    if not settings.get("env_wrapper"):
        return None
    from rl_zoo3.utils import get_wrapper_class  # takes seconds to import

    try:
        return get_wrapper_class(settings)
    except (AssertionError, AttributeError, ImportError, ValueError) as error:
        raise UserError(f"cannot import the env_wrapper {settings['env_wrapper']}: {one_line(error)}") from error


def import_packages(names: Iterable[str]) -> None:
    """
    :param names: modules that register environments
    :raises UserError: if one cannot be imported
    """
    for name in names:
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise UserError(f"cannot import the package {name}: {one_line(error)}") from error


def find_environment(env_id: str, model: str | Path | None = None) -> str:
    """
    Import what registers an environment: the package in its name (``"package:Name-v0"``), and those that a run was given.

    :param env_id: a Gymnasium id, perhaps with a package
    :param model: as :func:`load_model` takes it
    :return: the id without the package
    :raises UserError: if there is no such environment
    """
    package, _, name = env_id.rpartition(":")
    import_packages([package] if package else [])
    if model is not None:
        import_packages(run_arguments(model_file(model).parent).get("gym_packages") or [])
    check_known("environment", name, gym.registry)
    return name


def read_data(path: Path) -> dict[str, Any]:
    """
    :param path: a model's ``.zip``
    :return: the attributes of the saved model; values that are not JSON as SB3 wrote them
    :raises UserError: if the file is corrupt or was not saved by SB3
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if damaged := archive.testzip():
                raise UserError(f"{path} is corrupt: {damaged} in it cannot be read; use another checkpoint")
            data = json.loads(archive.read("data"))
            data["policy_class"], data["observation_space"], archive.getinfo("policy.pth")
    except (zipfile.BadZipFile, OSError, EOFError) as error:
        raise UserError(f"{path} is corrupt or no .zip at all: {one_line(error)}; use another checkpoint") from error
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{path} was not saved by Stable-Baselines3; give a .zip that model.save() wrote") from error
    return data


def _candidates(path: Path, data: dict[str, Any]) -> list[str]:
    """
    Algorithms that may have saved a model, the likeliest first: those with its policy class; among them the one that
    its run's settings name; then those that have most of their constructor's arguments in the file.
    """
    recorded = {read_settings(settings).get("algo") for settings in path.parent.glob(f"*/{ARGUMENTS}")}
    module = data["policy_class"].get("__module__") if isinstance(data["policy_class"], dict) else None

    def unlikeliness(name: str) -> tuple[bool, int, int]:
        constructors = [vars(cls)["__init__"] for cls in LOADABLE[name].__mro__ if "__init__" in vars(cls)]
        arguments = {argument for init in constructors for argument in inspect.signature(init).parameters}
        return name not in recorded, len(arguments - set(data)), -len(arguments)

    names = [
        name for name, cls in LOADABLE.items() if any(policy.__module__ == module for policy in cls.policy_aliases.values())
    ]
    return sorted(names, key=unlikeliness)
