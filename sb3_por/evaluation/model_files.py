"""Files of saved models: where they are, what is in them, and which algorithm may have saved them."""

import inspect
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import sb3_contrib
import stable_baselines3
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_por import ALGORITHMS, VisualSAC, VisualTQC
from sb3_por.common import plain
from sb3_por.common.errors import UserError, one_line
from sb3_por.runs.folder import ARGUMENTS, BEST_MODEL, read_settings, the_run

#: name -> class of every algorithm whose models can be loaded; a DDPG model is a TD3 model with other settings
LOADABLE: dict[str, type[BaseAlgorithm]] = {
    **{name.lower(): getattr(stable_baselines3, name) for name in ("A2C", "DQN", "PPO", "SAC", "TD3")},
    **{name.lower(): getattr(sb3_contrib, name) for name in ("CrossQ", "TQC", "TRPO")},
    **ALGORITHMS,
    **{cls.__name__.lower(): cls for cls in (VisualSAC, VisualTQC)},
}


def model_file(path: str | Path) -> Path:
    """
    :param path: a model's ``.zip``, or a run folder or one with a single run in it, which stands for its ``best_model.zip``
    :raises UserError: if there is no such file
    """
    path = Path(path)
    if path.is_dir():
        path = the_run(path) / BEST_MODEL
        others = sorted(path.parent.glob("*.zip"), key=lambda file: file.stat().st_mtime)
        if others and not path.is_file():
            raise UserError(f"there is no {BEST_MODEL} in {path.parent}: no evaluation; the newest model is {others[-1]}")
    if not path.is_file():
        raise UserError(
            f"there is no model {path}; give a run's folder such as logs/sac_por/PourWater-v0_1, a .zip that train.py or "
            "model.save() wrote, or random, nothing or expert where a command takes them"
        )
    return path


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
            archive.getinfo("policy.pth")
            if plain.ATTRIBUTE not in data:
                data["policy_class"], data["observation_space"]
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError) as error:
        raise UserError(f"{path} is corrupt or no .zip at all: {one_line(error)}; use another checkpoint") from error
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{path} was not saved by Stable-Baselines3; give a .zip that model.save() wrote") from error
    return data


def candidates(path: Path, data: dict[str, Any]) -> list[str]:
    """
    Algorithms that may have saved a model, the likeliest first: those with its policy class; among them the one that
    its run's settings name; then those that have most of their constructor's arguments in the file.
    """
    recorded = {read_settings(settings).get("algo") for settings in path.parent.glob(f"*/{ARGUMENTS}")}
    saved = data.get("policy_class")
    module = saved.get("__module__") if isinstance(saved, dict) else None

    def unlikeliness(name: str) -> tuple[bool, int, int]:
        constructors = [vars(cls)["__init__"] for cls in LOADABLE[name].__mro__ if "__init__" in vars(cls)]
        arguments = {argument for init in constructors for argument in inspect.signature(init).parameters}
        return name not in recorded, len(arguments - set(data)), -len(arguments)

    names = [
        name for name, cls in LOADABLE.items() if any(policy.__module__ == module for policy in cls.policy_aliases.values())
    ]
    return sorted(names, key=unlikeliness)
