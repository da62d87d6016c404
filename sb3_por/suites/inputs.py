"""What the runs of a suite read: their settings, demonstrations and rankers."""

import ast
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_por.common.errors import UserError
from sb3_por.runs.environment import rankers
from sb3_por.suites.run import Run
from sb3_por.training.hyperparameters import changed, hyperparameter_file, read_hyperparameters


def run_settings(run: Run) -> dict[str, Any]:
    """
    :param run: A run
    :return: The settings that it starts with, as its file and the suite's changes make them; the latter alone where no file
        has any for its environment
    """
    demos = "--demos" in run.flags
    try:
        settings = read_hyperparameters(hyperparameter_file(run.algo, run.env, demos), run.env)
    except UserError:
        settings = {}
    pairs = run.flags[run.flags.index("-params") + 1 :] if "-params" in run.flags else ()
    return changed(settings, {name: _python(value) for name, _, value in (pair.partition(":") for pair in pairs)})


def check_inputs(runs: Sequence[Run]) -> None:
    """
    :param runs: The runs that are left to do
    :raises UserError: If demonstrations or a ranker that one of them names are missing
    """
    missing = {path: run.name for run in runs for path in _inputs(run) if not path.exists()}
    if missing:
        named = ", ".join(f"{path} (of {name})" for path, name in missing.items())
        raise UserError(
            f"the suite needs what is not there: {named}; python -m sb3_por record makes demonstrations, rank makes rankers, "
            "and a suite that comes along has the commands at its top"
        )


def _inputs(run: Run) -> list[Path]:
    """Files and folders that the run's flags and settings name."""
    settings = run_settings(run)
    demos = run.flags[run.flags.index("--demos") + 1] if "--demos" in run.flags else settings.get("demos")
    return [Path(name) for name in [*([demos] if isinstance(demos, str) else []), *rankers(settings.get("env_wrapper"))]]


def _python(text: str) -> Any:
    """A value of a flag; the text itself for what is no literal, such as inf: the run refuses it."""
    try:
        return ast.literal_eval(text)
    except ValueError:
        return text
