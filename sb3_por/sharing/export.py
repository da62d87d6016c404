"""Export of a run as an agent for others: its best model without pickled code, its settings and its scores."""

import json
import os
import re
import shlex
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import stable_baselines3
import torch as th
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from sb3_por import __version__
from sb3_por.common.errors import UserError
from sb3_por.common.files import check_writable
from sb3_por.common.plain import plain
from sb3_por.evaluation.environment import make_evaluation_env
from sb3_por.evaluation.episodes import EVAL_SEED
from sb3_por.evaluation.evaluate import evaluate
from sb3_por.evaluation.loading import find_environment, model_file, resolve
from sb3_por.evaluation.plain_files import describe_statistics, save_plain
from sb3_por.runs.environment import TrainingEnvironment, rankers, with_rankers_by_name
from sb3_por.runs.facts import run_identity
from sb3_por.runs.folder import COMMAND, HYPERPARAMETERS, last_model, read_settings, run_arguments, settings_folder, the_run
from sb3_por.runs.provenance import current_machine
from sb3_por.sharing.agents import Agent, agent_name, describe_evaluation


def export_run(run: str | Path, folder: str | Path, n_episodes: int = 50, last: bool = False) -> Agent:
    """
    Write a run's model as ``<folder>/<algo>-<env>.zip``, without optimizers, Q networks and pickled code, and what is known
    of it as ``<folder>/<algo>-<env>.json``. The scores are those of the exported file.

    :param run: Folder of a run
    :param folder: Folder of agents; made if there is none
    :param n_episodes: Held-out episodes that score it
    :param last: Export the last model instead of the best
    :return: The agent
    :raises UserError: If there is no such model, or it cannot be loaded from names, numbers and tensors alone
    """
    run, folder = open_run(run), Path(folder)
    check_writable(folder)
    identity = run_identity(run)
    env_id = find_environment(identity["env"], run / last_model(identity["env"].rpartition(":")[2]) if last else run)
    model, statistics = load_run(run, env_id, last)
    name = agent_name(identity["algo"], env_id)
    with TemporaryDirectory(dir=folder, prefix=".") as temporary:
        exported = Path(temporary) / f"{name}.zip"
        save_plain(model, exported, statistics)
        evaluation = evaluate(exported, env_id, n_episodes)
        facts = {
            "env": env_id,
            "algo": identity["algo"],
            "class": type(model).__name__,
            "steps": model.num_timesteps,
            **run_facts(run, env_id),
            "evaluation": describe_evaluation(evaluation, EVAL_SEED),
        }
        exported.with_suffix(".json").write_text(json.dumps(facts, indent=1) + "\n")
        for suffix in (".zip", ".json"):
            os.replace(exported.with_suffix(suffix), folder / f"{name}{suffix}")
    return Agent(folder / f"{name}.zip", facts)


def open_run(path: str | Path) -> Path:
    """
    :param path: A run's folder, or a folder with a single run in it
    :raises UserError: If it is none
    """
    run = the_run(Path(path))
    if not run_arguments(run):
        raise UserError(f"{path} is no folder of a run; give one that train.py wrote, such as logs/sac_por/PourWater-v0_1")
    return run


def load_run(run: Path, env_id: str, last: bool = False) -> tuple[Any, dict[str, Any] | None]:
    """
    :param run: A run's folder
    :param env_id: Its environment
    :param last: Take the last model instead of the best
    :return: The model, which knows its environment, and a description of the statistics that it plays with, if any
    :raises UserError: If there is no such model
    """
    model, environment = resolve(model_file(run / last_model(env_id)) if last else run, env_id)
    TrainingEnvironment.of_settings(env_id, published_settings(run, env_id)).store_in(model)
    env = make_evaluation_env(model, env_id, **environment)
    try:
        statistics = unwrap_vec_normalize(env)
        return model, None if statistics is None else describe_statistics(statistics)
    finally:
        env.close()


def published_settings(run: Path, env_id: str) -> dict[str, Any]:
    """
    :param run: A run's folder
    :param env_id: Its environment
    :return: Its hyperparameters, with demonstrations and rankers by their names alone, without folders of this machine
    """
    settings = read_settings(settings_folder(run, env_id) / HYPERPARAMETERS)
    if settings.get("demos"):
        settings["demos"] = Path(settings["demos"]).name
    if rankers(settings.get("env_wrapper")):
        settings["env_wrapper"] = with_rankers_by_name(settings["env_wrapper"])
    return settings


def run_facts(run: Path, env_id: str) -> dict[str, Any]:
    """
    :param run: A run's folder
    :param env_id: Its environment
    :return: JSON values: seed, command, settings, commit and versions, without paths of this machine
    """
    arguments = run_arguments(run)
    command = settings_folder(run, env_id) / COMMAND
    return {
        "seed": arguments.get("seed"),
        "command": without_paths(command.read_text()) if command.is_file() else None,
        "settings": plain(published_settings(run, env_id)),
        "commit": arguments.get("commit"),
        "machine": current_machine(),
        "versions": {
            "sb3_por": __version__,
            "stable_baselines3": stable_baselines3.__version__,
            "torch": th.__version__,
        },
    }


def without_paths(command: str) -> str:
    """
    :param command: A training as it was typed, with the interpreter's path
    :return: The same as ``python train.py``, without the folder of logs and with the names of other files alone
    """
    try:
        words = shlex.split(command)
    except ValueError:  # a quotation mark in a word that was written without quotes
        words = command.split()
    starts = [i for i, word in enumerate(words) if re.search(r"(^|/)(train\.py|sb3-por-train|zoo\.py)$|^sb3_por\.zoo$", word)]
    words = words[starts[0] + 1 :] if starts else words[1:]
    kept: list[str] = []
    for word, before in zip(words, ["", *words[:-1]], strict=True):
        if word in ("-f", "--log-folder") or before in ("-f", "--log-folder"):
            continue
        kept.append(re.sub(r"(^|[=:])[/~]\S*/", r"\1", word))
    return shlex.join(["python", "train.py", *kept])
