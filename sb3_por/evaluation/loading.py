"""Loading of any saved model for use: with its algorithm and its environment, without its replay buffer."""

import importlib
import os
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecFrameStack

from sb3_por.common import plain
from sb3_por.common.errors import UserError, UserNote, check_known, one_line, short
from sb3_por.evaluation import plain_files
from sb3_por.evaluation.environment import make_wrapped, observation_kwargs
from sb3_por.evaluation.episodes import Model, whole_episodes
from sb3_por.evaluation.model_files import LOADABLE, candidates, model_file, read_data
from sb3_por.evaluation.safe_loading import check_environment, failing_in_one_line, is_plain, load_safe
from sb3_por.runs.environment import EnvWrapper, TrainingEnvironment, VecEnvWrapper, import_wrappers, without_ranker
from sb3_por.runs.folder import (
    ARGUMENTS,
    BEST_MODEL,
    BEST_STATISTICS,
    HYPERPARAMETERS,
    STATISTICS,
    import_names,
    last_model,
    read_settings,
    run_arguments,
    settings_folder,
)
from sb3_por.runs.origin import note_foreign

#: Note on a model of which too little is known; takes the model and the environment
NO_WRAPPERS = "{} does not tell how its environment was wrapped: {} is made without wrappers"
#: Most stacked frames of a stranger's model
MAX_FRAMES = 64


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
    :return: the model, ready to predict; its replay buffer holds one transition. Pickled code in the file is run, with a note
        unless ``train.py`` wrote it here; :func:`load_safe` runs none
    :raises UserError: if the file is not a saved model, or not one of this algorithm
    """
    path = model_file(path)
    data = read_data(path)
    if algo is not None:
        check_known("algorithm", algo, LOADABLE)
    if is_plain(data):
        return load_safe(path, device=device, algo=algo)
    note_foreign(path)
    names = candidates(path, data) if algo is None else [algo]
    buffer: dict[str, Any] = {"buffer_size": 1} if "buffer_size" in data else {}
    problem: Exception | None = None
    for name in names:
        try:
            with quiet_n_steps():
                model = LOADABLE[name].load(path, device=device, **buffer)
            _check_policy(model)
            return model
        # SB3 loads strictly: the wrong class fails on the names of the networks' parameters. A damaged file can raise anything
        except Exception as error:
            problem = problem or error
    if problem is None:
        raise UserError(f"cannot tell which algorithm saved {path}; say --algo, one of {', '.join(LOADABLE)}")
    raise UserError(f"{path} is not a model of {' or '.join(names)}: {one_line(problem)[:200]}") from problem


def _check_policy(model: BaseAlgorithm) -> None:
    """
    :raises TypeError: If the policy is one of another algorithm: TQC loads a model of SAC
    """
    own = tuple(model.policy_aliases.values())
    if own and not isinstance(model.policy, own):
        raise TypeError(f"{type(model).__name__} has no {type(model.policy).__name__}")


def resolve(
    model: Model | str | Path,
    env_id: str,
    env_kwargs: dict[str, Any] | None = None,
    vec_normalize: str | None = None,
    env_wrapper: EnvWrapper | None = None,
    vec_env_wrapper: VecEnvWrapper | None = None,
    algo: str | None = None,
    safe: bool = False,
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
    :param safe: Run nothing that a stranger has written: neither in the model's file, nor named in its folder. Files without
        pickled code are always loaded so
    :return: The model, and the other arguments of :func:`sb3_por.evaluation.environment.make_evaluation_env`
    :raises UserError: If the model cannot be loaded, or a wrapper cannot be imported
    """
    given = {"vec_normalize": vec_normalize, "env_wrapper": env_wrapper, "vec_env_wrapper": vec_env_wrapper}
    given = {name: value for name, value in given.items() if value is not None}
    if isinstance(model, (str, Path)):
        path = model_file(model)
        safe = safe or is_plain(read_data(path))
        find_environment(env_id, path, safe)
        if safe:
            with failing_in_one_line(path):
                environment = trained_in(path, env_id, safe=True, quiet=bool(given))
                model = _load_safe(path, env_id, environment, algo)
        else:
            environment = trained_in(path, env_id, quiet=bool(given))
            model = load_model(path, algo)
    else:
        quiet, made_of = bool(given) or env_kwargs is not None, TrainingEnvironment.of_model(model)
        if made_of is None and isinstance(model, BaseAlgorithm) and not quiet:
            warnings.warn(NO_WRAPPERS.format("the model", env_id), UserNote)
        environment = _arguments(made_of, env_id, None, quiet)
    if environment["env_kwargs"] is None:
        environment["env_kwargs"] = observation_kwargs(env_id, model.observation_space)
    environment["env_kwargs"] = environment["env_kwargs"] | (env_kwargs or {})
    return model, environment | given


def _load_safe(path: Path, env_id: str, environment: dict[str, Any], algo: str | None) -> BaseAlgorithm:
    """Make the environment for a file that does not describe its spaces."""
    if plain.ATTRIBUTE in plain_files.read_json(path):
        return load_safe(path, algo=algo)
    wrappers = environment["env_wrapper"], environment["vec_env_wrapper"]
    env = make_wrapped(env_id, environment["env_kwargs"] or {}, *wrappers)
    try:
        n_frames = read_settings(settings_folder(path.parent, env_id) / HYPERPARAMETERS).get("frame_stack") or 1
        if not isinstance(n_frames, int) or not 1 <= n_frames <= MAX_FRAMES:
            raise UserError(f"frame_stack is refused: {short(n_frames)} is no number from 1 to {MAX_FRAMES}")
        return load_safe(path, VecFrameStack(env, n_frames) if n_frames > 1 else env, algo=algo)
    finally:
        env.close()


def trained_in(path: str | Path, env_id: str, safe: bool = False, quiet: bool = False) -> dict[str, Any]:
    """
    :param path: A run folder, or the path of a model
    :param env_id: Gymnasium id
    :param safe: Refuse what could run code of a stranger's choice
    :param quiet: Say nothing of what the environment lacks, since a caller adds it
    :return: Arguments of :func:`sb3_por.evaluation.environment.make_evaluation_env`, besides model and id: from the run's
        folder, else from the model's ``.zip``; None for what neither tells of this environment
    :raises UserError: If a wrapper cannot be imported, or something is refused
    """
    file = model_file(path)
    folder = settings_folder(file.parent, env_id)
    settings = read_settings(folder / HYPERPARAMETERS)
    if settings:
        # The RL Zoo has the arguments of the command line in its other file alone
        given = read_settings(folder / ARGUMENTS).get("env_kwargs") or {}
        settings["env_kwargs"] = {**(settings.get("env_kwargs") or {}), **given}
        made_of: TrainingEnvironment | None = TrainingEnvironment.of_settings(env_id.rpartition(":")[2], settings)
    else:
        made_of = TrainingEnvironment.of_data(plain_files.read_json(file) if safe else read_data(file))
        if made_of is None and not quiet:
            warnings.warn(NO_WRAPPERS.format(file, env_id), UserNote)
    of_best = folder / BEST_STATISTICS
    pickled = of_best if file.name == BEST_MODEL and of_best.is_file() else folder / STATISTICS
    statistics = pickled if pickled.is_file() else None
    if statistics is not None and file.name not in (BEST_MODEL, last_model(env_id)):
        warnings.warn(f"{file} plays with the statistics of observations of the run's end, {pickled}", UserNote)
    if safe and made_of is not None:
        check_environment(made_of)
    if safe or statistics is None:
        statistics = file if plain_files.has_statistics(file) else None
        if safe and statistics is None and pickled.is_file() and made_of is not None and made_of.normalizes_observations:
            raise UserError(f"{pickled} is a pickle, which safe loading does not read; export the run where it is trusted")
    return _arguments(made_of, env_id, None if statistics is None else str(statistics), quiet)


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
        arguments["env_kwargs"] = whole_episodes(made_of.env_id, import_names(made_of.env_kwargs or {}))
        arguments["env_wrapper"] = import_wrappers(without_ranker(made_of.env_wrapper))
        arguments["vec_env_wrapper"] = import_wrappers(made_of.vec_env_wrapper)
        missing = missing or bool(made_of.unknown)
    elif made_of.env_wrapper or made_of.vec_env_wrapper or made_of.unknown:
        missing = True
    if missing and not quiet:
        warnings.warn(f"{env_id} is made without what the model was trained in: {made_of}", UserNote)
    return arguments


def import_packages(names: Iterable[str]) -> None:
    """
    :param names: modules that register environments
    :raises UserError: if one cannot be imported
    """
    if "" not in sys.path and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # a console script does not look there, where users have their modules
    for name in names:
        try:
            importlib.import_module(name)
        except (ImportError, TypeError, ValueError) as error:  # no name of a module
            raise UserError(f"cannot import the package {name}: {one_line(error)}") from error


def find_environment(env_id: str, model: str | Path | None = None, safe: bool = False) -> str:
    """
    Import what registers an environment: the package in its name (``"package:Name-v0"``), and those that a run was given.

    :param env_id: a Gymnasium id, perhaps with a package
    :param model: Model file or run folder, see :func:`load_model`
    :param safe: Import only what the id names
    :return: the id without the package
    :raises UserError: if there is no such environment
    """
    package, _, name = env_id.rpartition(":")
    import_packages([package] if package else [])
    packages = [] if model is None else run_arguments(model_file(model).parent).get("gym_packages") or []
    if not safe:
        import_packages(packages)
    elif packages and name not in gym.registry:
        raise UserError(f"safe loading does not import the packages of the run, {short(packages)}; --env PACKAGE:{name} does")
    try:
        check_known("environment", name, gym.registry)
    except UserError as error:
        raise UserError(f"{error}; one of your own needs its module, --env MODULE:{name}") from None
    return name
