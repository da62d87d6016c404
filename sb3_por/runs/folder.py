"""A run's folder, in the RL Zoo's layout: where its files are and what its settings say."""

import shutil
import uuid
import zipfile
from collections.abc import Iterable
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np
import yaml

from sb3_por.common.errors import UserError, one_line
from sb3_por.common.files import atomic_write

#: Evaluations of a run, in SB3's format with further arrays
EVALUATIONS = "evaluations.npz"
#: Model with the best evaluation; the last one is ``last_model(env_id)``
BEST_MODEL = "best_model.zip"
#: Folder of the checkpoint that an interrupted run resumes from; a finished run has none
CHECKPOINTS = "checkpoint"
#: Lock of the process that writes to a run's folder, or of the suite that writes to its folder
LOCK = ".lock"
#: Episodes of a training environment, written by SB3's ``Monitor``
MONITORS = "*.monitor.csv"
#: Folder of TensorBoard's files, unless the user names another one
TENSORBOARD = "tb"
#: The replay buffer at the end of a run, if it is to be saved
REPLAY_BUFFER = "replay_buffer.pkl"
#: Output of a suite's run; in the suite's folder of the run, two levels above the run's folder
LOG = "log.txt"

# In the folder of settings, <run>/<env>/:
#: Arguments of the command line
ARGUMENTS = "args.yml"
#: Hyperparameters
HYPERPARAMETERS = "config.yml"
#: Arguments of the environment, in repositories of the hub
ENV_KWARGS = "env_kwargs.yml"
#: The command as it was typed
COMMAND = "command.txt"
#: ``VecNormalize`` statistics of the last model, and those of the best one
STATISTICS, BEST_STATISTICS = "vecnormalize.pkl", "best_vecnormalize.pkl"


def env_name(env_id: str) -> str:
    """An environment's id as the RL Zoo names files and folders by it: ``my_package:ns/Mine-v0`` becomes ``ns-Mine-v0``."""
    return env_id.rpartition(":")[2].replace("/", "-")


def settings_folder(run: Path, env_id: str) -> Path:
    """Folder of a run's settings and statistics."""
    return run / env_name(env_id)


def last_model(env_id: str) -> str:
    """Name of the model at the end of a run. The file marks a finished run."""
    return f"{env_name(env_id)}.zip"


def intermediate_model(n_steps: int) -> str:
    """Name of the model after a number of steps."""
    return f"rl_model_{n_steps}_steps.zip"


class ClassName(str):
    """The dotted path of a class in settings. Reading settings imports nothing; ``import_names`` does."""


class _Dumper(yaml.SafeDumper):
    """Writes plain YAML; tuples and classes with PyYAML's own tags, and other objects as their ``repr``."""


class _Loader(yaml.SafeLoader):
    """Reads the output of ``_Dumper`` and of the RL Zoo; classes become a ``ClassName``."""


def _represent_class(dumper: yaml.SafeDumper, value: type) -> yaml.Node:
    return dumper.represent_scalar(f"{_NAME}{value.__module__}.{value.__qualname__}", "")


def _construct_tuple(loader: yaml.SafeLoader, node: Any) -> tuple[Any, ...]:
    return tuple(loader.construct_sequence(node, deep=True))


def _construct_ordered_dict(loader: yaml.SafeLoader, node: Any) -> dict[str, Any]:
    """The RL Zoo writes one of pairs."""
    (pairs,) = loader.construct_sequence(node, deep=True)
    return dict(pairs)


def _construct_class(loader: yaml.SafeLoader, name: str, _: yaml.Node) -> ClassName:
    return ClassName(name)


_ORDERED_DICT = "tag:yaml.org,2002:python/object/apply:collections.OrderedDict"
_TUPLE, _NAME = "tag:yaml.org,2002:python/tuple", "tag:yaml.org,2002:python/name:"
_Dumper.add_multi_representer(object, lambda dumper, value: dumper.represent_str(repr(value)))
_Dumper.add_multi_representer(dict, lambda dumper, value: dumper.represent_dict(value))
_Dumper.add_representer(tuple, lambda dumper, value: dumper.represent_sequence(_TUPLE, value))
_Dumper.add_multi_representer(type, _represent_class)
_Dumper.add_representer(ClassName, lambda dumper, value: dumper.represent_scalar(f"{_NAME}{value}", ""))
_Loader.add_constructor(_TUPLE, _construct_tuple)
_Loader.add_constructor(_ORDERED_DICT, _construct_ordered_dict)
_Loader.add_multi_constructor(_NAME, _construct_class)


def dump_settings(settings: dict[str, Any]) -> str:
    """
    :param settings: Arguments or hyperparameters of a run
    :return: YAML
    """
    return yaml.dump(settings, Dumper=_Dumper)


def parse_settings(text: str) -> dict[str, Any]:
    """
    :param text: YAML that ``dump_settings`` or the RL Zoo wrote
    :return: Names and values; a class is a ``ClassName``
    :raises ValueError: If it is not YAML of names and values, or needs other Python objects
    """
    try:
        return dict(yaml.load(text, _Loader) or {})
    except (yaml.YAMLError, TypeError) as error:
        raise ValueError(one_line(error)) from error


def import_names(value: Any) -> Any:
    """
    Import the classes that settings name. It runs the code of their modules: call it for settings that are to be used.

    :param value: Settings, or a part of them
    :return: The same with classes in the place of each ``ClassName``
    :raises UserError: If one cannot be imported
    """
    if isinstance(value, ClassName):
        try:
            return resolve_name(value)
        except (AttributeError, ImportError, ValueError) as error:
            raise UserError(f"cannot import {value}: {one_line(error)}") from error
    if isinstance(value, dict):
        return {import_names(key): import_names(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(import_names(part) for part in value)
    return value


def write_settings(path: Path, settings: dict[str, Any]) -> None:
    """Write arguments or hyperparameters of a run."""
    with atomic_write(path) as temporary:
        temporary.write_text(dump_settings(settings))


def read_settings(path: Path) -> dict[str, Any]:
    """
    :param path: Arguments or hyperparameters of a run
    :return: Their names and values; empty if there is no such file, or one that holds other Python objects
    """
    try:
        return parse_settings(path.read_text())
    except (OSError, ValueError):
        return {}


def run_arguments(run: Path) -> dict[str, Any]:
    """The command-line arguments of a run; empty if they were not recorded."""
    files = sorted(run.glob(f"*/{ARGUMENTS}"))
    return read_settings(files[0]) if files else {}


def the_run(folder: Path) -> Path:
    """A run's folder, or the single run below a folder, as suites have them; the folder itself if there is none or many."""
    below = [] if any(folder.glob(f"*/{ARGUMENTS}")) else list(folder.glob(f"*/*/*/{ARGUMENTS}"))
    return below[0].parent.parent if len(below) == 1 else folder


def is_finished(run: Path, env_id: str) -> bool:
    """Whether a run has its last model and no checkpoint."""
    return (run / last_model(env_id)).exists() and not (run / CHECKPOINTS).exists()


def latest_checkpoint(run: Path) -> Path | None:
    """The newest complete checkpoint of a run, if it has one."""
    found = (run / CHECKPOINTS).glob("step_*")
    return max(found, key=lambda folder: int(folder.name.removeprefix("step_")), default=None)


def discard(checkpoint: Path) -> None:
    """Remove a checkpoint atomically."""
    hidden = checkpoint.with_name(f".{uuid.uuid4().hex}")
    checkpoint.rename(hidden)
    shutil.rmtree(hidden)


def read_evaluations(run: Path) -> dict[str, np.ndarray]:
    """
    :param run: a run folder
    :return: the arrays in its ``evaluations.npz``, ``timesteps`` and ``results`` among them
    :raises UserError: if it cannot be read
    """
    try:
        with np.load(run / EVALUATIONS) as file:
            arrays = {name: file[name] for name in file.files}
        arrays["timesteps"], arrays["results"]
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise UserError(f"cannot read {run / EVALUATIONS}: {one_line(error)}") from error
    return arrays


def find_runs(paths: Iterable[str | Path]) -> list[Path]:
    """
    :param paths: run folders, or folders that hold some at any depth
    :return: every folder with an ``evaluations.npz``, sorted
    :raises UserError: if a path does not exist or holds no run
    """
    runs: set[Path] = set()
    for path in map(Path, paths):
        if not path.is_dir():
            raise UserError(f"there is no folder {path}")
        found = {file.parent for file in path.rglob(EVALUATIONS)}
        if not found:
            raise UserError(f"no run under {path}: none of its folders has an {EVALUATIONS}")
        runs |= found
    return sorted(runs)
