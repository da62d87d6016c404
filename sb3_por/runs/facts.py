"""Facts about runs besides their scores: identity, state, progress, settings, machine, and the end of their logs."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_por.runs.folder import (
    ARGUMENTS,
    EVALUATIONS,
    HYPERPARAMETERS,
    LOG,
    MONITORS,
    is_finished,
    read_evaluations,
    read_settings,
    run_arguments,
    settings_folder,
)
from sb3_por.runs.lock import is_locked

#: The wrapper whose steps hold several control steps, as settings name it.
ACTION_REPEAT = "softbody_envs.wrappers.ActionRepeat"
#: Lines of a log that are kept.
LOG_LINES = 15
#: Arguments of train.py that belong to a run's settings; the others say where files are and how the search is done.
SETTINGS = ("algo", "eval_freq", "eval_episodes", "save_freq", "num_threads", "device", "vec_env", "env_kwargs", "conf_file")


@dataclass(frozen=True)
class RunFacts:
    """
    :param env: environment id
    :param algo: name of the algorithm, or the run's label
    :param seed: seed
    :param folder: Folder of its files
    :param state: ``"finished"``, ``"running"`` or ``"stopped"``
    :param steps: done so far
    :param planned: to be done; ``None`` if that is not recorded
    :param commit: Commit at its start; empty if not recorded
    :param machine: Machine at its start; empty if not recorded
    :param settings: hyperparameters and arguments
    :param log: last lines of what it printed; empty if that was not kept
    """

    env: str
    algo: str
    seed: int
    folder: Path
    state: str
    steps: int
    planned: int | None
    commit: str
    machine: str
    settings: dict[str, Any]
    log: list[str]

    @property
    def name(self) -> str:
        return f"{self.algo} on {self.env}, seed {self.seed}"


def take_inventory(folders: Iterable[str | Path]) -> list[RunFacts]:
    """
    :param folders: run folders, or folders that hold some at any depth
    :return: all runs in them, also those that were never evaluated, sorted
    """
    runs = set()
    for folder in map(Path, folders):
        runs |= {file.parent for file in folder.rglob(EVALUATIONS)} | {file.parents[1] for file in folder.rglob(ARGUMENTS)}
    return sorted(map(_facts, runs), key=lambda run: (run.env, run.algo, run.seed, run.folder))


def orphaned_logs(folders: Iterable[str | Path]) -> dict[Path, list[str]]:
    """
    :param folders: Run folders, or folders that hold some at any depth
    :return: log -> its last lines, of what failed before it had a run's folder
    """
    logs = sorted(log for folder in folders for log in Path(folder).rglob(LOG))
    return {log: _last_lines(log) for log in logs if not any(log.parent.rglob(ARGUMENTS))}


def _facts(run: Path) -> RunFacts:
    arguments = run_arguments(run)
    identity = run_identity(run)
    config = read_settings(settings_folder(run, identity["env"]) / HYPERPARAMETERS)
    # -1 is the zoo's "as many as the settings say".
    planned = next((n for n in (arguments.get("n_timesteps"), config.get("n_timesteps")) if n and n > 0), None)
    finished = is_finished(run, identity["env"])
    settings = {**config, **{name: arguments[name] for name in SETTINGS if arguments.get(name) not in (None, -1)}}
    # The RL Zoo has the arguments of the command line in its other file alone
    env_kwargs = {**(config.get("env_kwargs") or {}), **(arguments.get("env_kwargs") or {})}
    return RunFacts(
        **identity,
        folder=run,
        state="finished" if finished else "running" if is_locked(run) else "stopped",
        steps=progress(run)[0],
        planned=None if planned is None else int(planned),
        commit=arguments.get("commit", ""),
        machine=arguments.get("machine", ""),
        settings=settings | ({"env_kwargs": env_kwargs} if env_kwargs else {}),
        log=[] if finished else _last_lines(run.parents[1] / LOG),
    )


def _last_lines(log: Path) -> list[str]:
    return log.read_text(errors="replace").splitlines()[-LOG_LINES:] if log.is_file() else []


def progress(run: Path) -> tuple[int, float | None]:
    """
    :return: steps that the run has done, to the last episode's end, and its latest mean normalized performance
    """
    steps, repeat = 0, control_steps(run)
    for monitor in run.glob(MONITORS):
        rows = (line.split(",") for line in monitor.read_text().splitlines()[2:])
        steps += sum(math.ceil(int(row[1]) / repeat) for row in rows if len(row) > 2)
    score = None
    if (run / EVALUATIONS).is_file():
        arrays = read_evaluations(run)
        steps = max(steps, int(arrays["timesteps"][-1]))
        latest = float(np.mean(arrays.get("normalized_performance", np.full((1, 1), np.nan))[-1]))
        score = None if np.isnan(latest) else latest
    return steps, score


def control_steps(run: Path) -> int:
    """
    :param run: A run folder
    :return: Control steps of an agent's step, of which its monitors count the former, since they are inside ``ActionRepeat``
    """
    wrappers = read_settings(settings_folder(run, run_identity(run)["env"]) / HYPERPARAMETERS).get("env_wrapper")
    entries = wrappers if isinstance(wrappers, list) else [wrappers]
    held = [entry[ACTION_REPEAT] for entry in entries if isinstance(entry, dict) and ACTION_REPEAT in entry]
    return math.prod(int(arguments["repeat"]) for arguments in held)


def run_identity(run: Path) -> dict[str, Any]:
    """Values of ``RUN_KEYS`` for a run: from its settings, else from its path."""
    arguments = run_arguments(run)
    name, _, number = run.name.rpartition("_")
    return {
        "env": arguments.get("env", name or run.name),
        "algo": str(arguments.get("label") or arguments.get("algo", run.parent.name)),
        "seed": int(arguments.get("seed", number if number.isdigit() else 0)),
    }
