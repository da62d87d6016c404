"""Loading of any saved model for use: with its algorithm and its environment, without its replay buffer."""

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
from sb3_por.common.errors import UserError, UserNote, check_known, one_line
from sb3_por.evaluation.environment import observation_kwargs
from sb3_por.evaluation.episodes import Model, whole_episodes
from sb3_por.runs.environment import EnvWrapper, TrainingEnvironment, VecEnvWrapper, import_wrappers
from sb3_por.runs.folder import (
    ARGUMENTS,
    BEST_MODEL,
    BEST_STATISTICS,
    HYPERPARAMETERS,
    STATISTICS,
    import_names,
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


def resolve(
    model: Model | str | Path,
    env_id: str,
    env_kwargs: dict[str, Any] | None = None,
    vec_normalize: str | None = None,
    env_wrapper: EnvWrapper | None = None,
    vec_env_wrapper: VecEnvWrapper | None = None,
    algo: str | None = None,
) -> tuple[Any, dict[str, Any]]:
    """
    Load a model, and find out which environment it was trained in: from its run's folder, else from the model itself.

    :param model: A run folder, the path of a model, or a model
    :param env_id: Gymnasium id of the environment that the model is to be used in
    :param env_kwargs: Changes to the arguments of the environment's constructor
    :param vec_normalize: Replaces the file of ``VecNormalize`` statistics
    :param env_wrapper: Replaces the wrappers
    :param vec_env_wrapper: Replaces the wrappers of the vectorized environments
    :param algo: Name of the algorithm, see :func:`load_model`
    :return: The model, and the other arguments of :func:`sb3_por.evaluation.environment.make_evaluation_env`
    :raises UserError: If the model cannot be loaded, or a wrapper cannot be imported
    """
    given = {"vec_normalize": vec_normalize, "env_wrapper": env_wrapper, "vec_env_wrapper": vec_env_wrapper}
    given = {name: value for name, value in given.items() if value is not None}
    if isinstance(model, (str, Path)):
        find_environment(env_id, model)
        path, model = model, load_model(model, algo)
        environment = trained_in(path, env_id)
    else:
        quiet = bool(given) or env_kwargs is not None
        environment = _arguments(TrainingEnvironment.of_model(model), env_id, None, quiet)
    if environment["env_kwargs"] is None:
        environment["env_kwargs"] = observation_kwargs(env_id, model.observation_space)
    environment["env_kwargs"] = environment["env_kwargs"] | (env_kwargs or {})
    return model, environment | given


def trained_in(path: str | Path, env_id: str) -> dict[str, Any]:
    """
    :param path: A run folder, or the path of a model
    :param env_id: Gymnasium id
    :return: Arguments of :func:`sb3_por.evaluation.environment.make_evaluation_env`, besides model and id: from the run's
        folder, else from the model's ``.zip``; None for what neither tells of this environment
    :raises UserError: If a wrapper cannot be imported
    """
    file = model_file(path)
    folder = file.parent / env_id.rpartition(":")[2]
    settings = read_settings(folder / HYPERPARAMETERS)
    if settings:
        # The RL Zoo has the arguments of the command line in its other file alone
        given = read_settings(folder / ARGUMENTS).get("env_kwargs") or {}
        settings["env_kwargs"] = {**(settings.get("env_kwargs") or {}), **given}
        made_of: TrainingEnvironment | None = TrainingEnvironment.of_settings(folder.name, settings)
    else:
        made_of = TrainingEnvironment.of_data(read_data(file))
        if made_of is None:
            warnings.warn(f"{file} does not tell how its environment was wrapped: {env_id} is made without wrappers", UserNote)
    of_best = folder / BEST_STATISTICS
    statistics = of_best if file.name == BEST_MODEL and of_best.is_file() else folder / STATISTICS
    return _arguments(made_of, env_id, str(statistics) if statistics.is_file() else None)


def _arguments(
    made_of: TrainingEnvironment | None, env_id: str, statistics: str | None, quiet: bool = False
) -> dict[str, Any]:
    """Arguments of ``make_evaluation_env``, with a note on what they lack unless ``quiet``."""
    arguments: dict[str, Any] = {
        "env_kwargs": None,
        "vec_normalize": statistics,
        "env_wrapper": None,
        "vec_env_wrapper": None,
    }
    if made_of is None:
        return arguments
    missing = made_of.normalizes_observations and statistics is None
    if made_of.env_id == env_id.rpartition(":")[2]:
        arguments["env_kwargs"] = whole_episodes(import_names(made_of.env_kwargs or {}))
        arguments["env_wrapper"] = import_wrappers(made_of.env_wrapper)
        arguments["vec_env_wrapper"] = import_wrappers(made_of.vec_env_wrapper)
    elif made_of.env_wrapper or made_of.vec_env_wrapper:
        missing = True
    if missing and not quiet:
        warnings.warn(f"{env_id} is made without what the model was trained in: {made_of}", UserNote)
    return arguments


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
    :param model: Model file or run folder, see :func:`load_model`
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
