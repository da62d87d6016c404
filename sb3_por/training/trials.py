"""Settings that ``train.py -optimize`` has found, to train with."""

from pathlib import Path
from typing import Any

import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER

from sb3_por.common.errors import UserError, one_line


def trial_settings(algo: str, storage: str, study_name: str, number: int | None = None) -> dict[str, Any]:
    """
    Read the hyperparameters of a trial.

    :param algo: Name of the algorithm, which must be the study's
    :param storage: File that ends in ``.log``, or URL of a database, as ``--storage`` takes it
    :param study_name: Name of the study
    :param number: Number of the trial, from 0; None for the best one
    :return: Arguments of the algorithm
    :raises UserError: If there is no such storage, study or trial, or it is a trial of another algorithm
    """
    file = storage.removeprefix("sqlite:///")
    if "://" not in file and not Path(file).is_file():  # Optuna would create it
        raise UserError(f"there is no storage {storage}; give the --storage that train.py -optimize was given")
    try:
        study = optuna.load_study(study_name=study_name, storage=_open(storage))
        n_trials = len(study.trials)
    except KeyError as error:
        raise UserError(f"there is no study {study_name!r} in {storage}; give the --study-name of the search") from error
    except Exception as error:  # of any database's driver
        raise UserError(f"cannot read the study {study_name!r} in {storage}: {one_line(error)}") from error
    if number is not None and not 0 <= number < n_trials:
        raise UserError(f"the study {study_name!r} has no trial {number}; it has {n_trials}, from 0")
    try:
        trial = study.best_trial if number is None else study.trials[number]
    except ValueError as error:
        raise UserError(f"the study {study_name!r} has no complete trial; let -optimize finish one") from error
    print(f"Settings of trial {trial.number} of the study {study_name!r}: {trial.params}")
    try:
        return HYPERPARAMS_CONVERTER[algo](dict(trial.params))
    except KeyError as error:
        raise UserError(f"trial {trial.number} of {study_name!r} has no {error}: it is not a trial of {algo}") from error


def _open(storage: str) -> Any:
    """As the zoo does."""
    if not storage.endswith(".log"):
        return storage
    return JournalStorage(JournalFileBackend(storage))
