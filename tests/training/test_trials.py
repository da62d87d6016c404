"""A trial that -optimize has found is trained with: the best one, or any by its number."""

import optuna
import pytest
import yaml

from sb3_por.training.trials import trial_settings
from sb3_por.training.zoo import main

RUN = ["--algo", "sac_por", "--env", "Pendulum-v1", "-n", "10", "--eval-freq", "-1", "--seed", "1", "--verbose", "0"]
SMALL = ["-params", "policy:MlpPolicy", "learning_starts:5", "batch_size:8", "buffer_size:50"]


@pytest.fixture(scope="module")
def storage(tmp_path_factory):
    """A study with the values 1, 3 and 2, and one trial that is not complete."""
    path = str(tmp_path_factory.mktemp("studies") / "study.log")
    backend = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(path))
    study = optuna.create_study(study_name="s", storage=backend, direction="maximize")
    for value in (1.0, 3.0, 2.0):
        trial = study.ask()
        trial.suggest_float("por_coef", value, value)
        study.tell(trial, value)
    study.ask()
    optuna.create_study(study_name="empty", storage=backend)
    return path


@pytest.mark.parametrize(("flags", "expected"), [([], 3.0), (["--trial-id", "0"], 1.0), (["--trial-id", "2"], 2.0)])
def test_a_run_has_the_trials_settings(flags, expected, storage, tmp_path):
    assert main([*RUN, "--storage", storage, "--study-name", "s", *flags, "-f", str(tmp_path), *SMALL]) == 0
    run = tmp_path / "sac_por" / "Pendulum-v1_1"
    assert yaml.safe_load((run / "Pendulum-v1" / "config.yml").read_text())["por_coef"] == expected


def test_settings_on_the_command_line_win(storage, tmp_path):
    flags = ["--storage", storage, "--study-name", "s", "-f", str(tmp_path)]
    assert main([*RUN, *flags, *SMALL, "por_coef:7.0"]) == 0
    run = tmp_path / "sac_por" / "Pendulum-v1_1"
    assert yaml.safe_load((run / "Pendulum-v1" / "config.yml").read_text())["por_coef"] == 7.0


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--storage", "none.log", "--study-name", "s"], "there is no storage none.log"),
        (["--storage", "sqlite:///none.db", "--study-name", "s"], "there is no storage sqlite:///none.db"),
        (["--storage", "STORAGE", "--study-name", "t"], "there is no study 't' in"),
        (["--storage", "STORAGE", "--study-name", "empty"], "has no complete trial"),
        (["--storage", "STORAGE", "--study-name", "s", "--trial-id", "9"], "has no trial 9; it has 4, from 0"),
        (["--storage", "STORAGE", "--study-name", "s", "--trial-id", "-1"], "has no trial -1"),
        (["--trial-id", "0"], "--trial-id needs the --storage and the --study-name"),
    ],
)
def test_what_is_missing_is_one_line(flags, message, storage, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    flags = [storage if flag == "STORAGE" else flag for flag in flags]
    assert main([*RUN, *flags, "-f", "logs", *SMALL]) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("train.py: error: ")]
    assert len(errors) == 1 and message in errors[0]
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_a_trial_of_another_algorithm_is_said(storage):
    with pytest.raises(ValueError, match="not a trial of ppo"):
        trial_settings("ppo", storage, "s", 0)
