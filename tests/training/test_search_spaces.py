"""Tuning through the zoo: what is tried are arguments of the algorithm, and several processes can share a study."""

import subprocess
import sys
from pathlib import Path

import optuna
import pytest
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from toy_envs import DotEnv

from sb3_por import ALGORITHMS
from sb3_por.training.search_spaces import POR_COEFS, SEARCH_SPACES, sampler

ROOT = Path(__file__).parents[2]
POLICY = dict(net_arch=[16], features_extractor_kwargs=dict(features_dim=50, n_filters=4, strides=(2, 2)))


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_trial_builds_an_algorithm(algo):
    assert set(SEARCH_SPACES) == set(ALGORITHMS)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(3):
        trial = study.ask()
        settings = sampler(algo)(trial, 3, 1, {})
        assert settings == trial.params
        model = ALGORITHMS[algo]("CnnPolicy", DotEnv(), policy_kwargs=POLICY, buffer_size=50, **settings)
        assert all(getattr(model, name) == value for name, value in settings.items() if name != "learning_rate")


def test_processes_share_a_study(tmp_path):
    storage = tmp_path / "tuning.log"
    flags = ["-n", "120", "-optimize", "--n-trials", "1", "--n-evaluations", "1", "--eval-episodes", "1", "--num-threads", "1"]
    flags += [
        "--sampler",
        "random",
        "--pruner",
        "none",
        "--study-name",
        "balls",
        "--storage",
        str(storage),
        "-f",
        str(tmp_path),
    ]
    small = ["-params", "learning_starts:100", "batch_size:8", "buffer_size:200", "-optimize", "--no-optim-plots"]
    command = [sys.executable, "train.py", "--algo", "sac_por", "--env", "FallingBall-v0", *flags, *small]
    for _ in range(2):
        done = subprocess.run([*command, "--env-kwargs", "image_size:40"], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    study = optuna.load_study(study_name="balls", storage=JournalStorage(JournalFileBackend(str(storage))))
    assert [trial.state.name for trial in study.trials] == ["COMPLETE", "COMPLETE"]
    assert all(trial.params["por_coef"] in POR_COEFS for trial in study.trials)
    assert study.trials[0].params != study.trials[1].params
