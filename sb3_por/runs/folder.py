"""A run's folder, in the RL Zoo's layout: where its files are and what its settings say."""

import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_por.common.errors import UserError, one_line
from sb3_por.common.files import atomic_write

EVALUATIONS = "evaluations.npz"
#: ``VecNormalize`` statistics of the best model, beside the last one's, which the zoo calls ``vecnormalize.pkl``.
BEST_STATISTICS = "best_vecnormalize.pkl"
#: Folder of what a killed run goes on from; a finished run has none.
CHECKPOINTS = "checkpoint"


class _PlainDumper(yaml.SafeDumper):
    """Writes YAML that every reader can read: what is no plain value becomes its ``repr``."""


_PlainDumper.add_multi_representer(object, lambda dumper, value: dumper.represent_str(repr(value)))
_PlainDumper.add_multi_representer(dict, lambda dumper, value: dumper.represent_dict(value))


def write_settings(path: Path, settings: dict[str, Any]) -> None:
    """Write ``args.yml`` or ``config.yml`` of a run as plain YAML."""
    with atomic_write(path) as temporary:
        temporary.write_text(yaml.dump(settings, Dumper=_PlainDumper))


def read_settings(path: Path) -> dict[str, Any]:
    """
    :param path: ``args.yml`` or ``config.yml`` of a run
    :return: what is in it; empty if there is none, or one of another writer, with Python objects in it
    """
    try:
        return dict(yaml.safe_load(path.read_text()) or {})
    except (yaml.YAMLError, OSError, TypeError, ValueError):
        return {}


def run_arguments(run: Path) -> dict[str, Any]:
    """The command-line arguments of a run; empty if they were not recorded."""
    files = sorted(run.glob("*/args.yml"))
    return read_settings(files[0]) if files else {}


def the_run(folder: Path) -> Path:
    """A run's folder, or the single run below a folder, as suites have them; the folder itself if there is none or many."""
    below = [] if any(folder.glob("*/args.yml")) else list(folder.glob("*/*/*/args.yml"))
    return below[0].parent.parent if len(below) == 1 else folder


def is_finished(run: Path, env_id: str) -> bool:
    """Whether a run has its last model and no checkpoint to go on from."""
    return (run / f"{env_id}.zip").exists() and not (run / CHECKPOINTS).exists()


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
