"""Settings of an algorithm for an environment: which file has them, its entry, and changes to it."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import yaml

from sb3_por.common.errors import UserError, one_line
from sb3_por.common.shipped import shipped

#: File of the settings of all algorithms that learn from demonstrations
DEMOS = "demos.yml"


def hyperparameter_file(algo: str, env_id: str, demos: bool = False) -> Path:
    """
    The settings of an algorithm for an environment: ours where we list it, else the zoo's, else our default.

    :param algo: Name of an algorithm
    :param env_id: Gymnasium id
    :param demos: Whether it learns from demonstrations: then those of ``demos.yml``, for every algorithm, where we list the
        environment there
    :return: The file
    :raises UserError: If none fits
    """
    folders = shipped("zoo_hyperparams"), _of_the_zoo()
    files = [*([folders[0] / DEMOS] if demos else []), *(folder / f"{algo}.yml" for folder in folders)]
    entries = {file: yaml.safe_load(file.read_text()) for file in files if file.is_file()}
    for key in (env_id, "default"):
        for file, settings in entries.items():
            if key in settings:
                return file
    raise UserError(f"there are no settings of {algo} for {env_id}; write some and pass -conf FILE.yml")


def read_hyperparameters(file: str | Path, env_id: str) -> dict[str, Any]:
    """
    :param file: Settings in the RL Zoo's format
    :param env_id: Gymnasium id
    :return: The entry of the environment, or ``default``
    :raises UserError: If the file cannot be read, or has neither
    """
    try:
        entries = yaml.safe_load(Path(file).read_text())
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise UserError(f"cannot read {file}: {one_line(error)}") from error
    for key in (env_id, "default"):
        if isinstance(entries, dict) and isinstance(entries.get(key), dict):
            return dict(entries[key])
    raise UserError(f"{file} has no entry {env_id} and no entry default")


def changed(settings: dict[str, Any], *changes: dict[str, Any]) -> dict[str, Any]:
    """
    :param settings: Settings
    :param changes: Changes to them, the later one wins
    :return: The settings with the changes; ``env_kwargs`` add to those that were there, all others replace them
    :raises UserError: If ``env_kwargs`` are no names and values
    """
    merged = dict(settings)
    for one in changes:
        env_kwargs = [part.get("env_kwargs") or {} for part in (merged, one)]
        for part in env_kwargs:
            if not isinstance(part, dict):
                raise UserError(f"env_kwargs must be arguments of an environment by name, got {part!r}")
        merged |= one
        if "env_kwargs" in merged:
            merged["env_kwargs"] = env_kwargs[0] | env_kwargs[1]
    return merged


def _of_the_zoo() -> Path:
    """The RL Zoo's settings, without an import, which takes seconds."""
    spec = find_spec("rl_zoo3")
    assert spec is not None and spec.submodule_search_locations is not None
    return Path(spec.submodule_search_locations[0]) / "hyperparams"
