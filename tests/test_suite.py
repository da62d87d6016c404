"""A suite file becomes runs: each once, taken up where it stopped, failures named."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_por.__main__ import main
from sb3_por.errors import UserError
from sb3_por.suite_file import Suite, read_suite, suite_runs

ROOT = Path(__file__).parent.parent


@pytest.fixture
def suite_file(tmp_path):
    def write(text):
        (tmp_path / "grid.yml").write_text(text)
        return tmp_path / "grid.yml"

    return write


def test_a_suite_is_every_combination_with_its_settings(suite_file, tmp_path):
    suite = read_suite(
        suite_file(
            "algos: [sac, td3]\nenvs: [PourWater-v0, Pendulum-v1]\nseeds: [3, 4]\nn_timesteps: 50\n"
            "hyperparams: {gamma: 0.9, policy: MlpPolicy}\noverrides:\n  td3: {gamma: 0.8}\n  td3/Pendulum-v1: {gamma: 0.7}\n"
        )
    )
    runs = suite_runs(suite, tmp_path / "runs")
    assert len(runs) == len({run.folder for run in runs}) == 8
    by_name = {run.name: run for run in runs}
    flags = " ".join(by_name["Pendulum-v1/td3/seed_4"].flags)
    assert "-n 50" in flags and flags.endswith("-params gamma:0.7 policy:'MlpPolicy'")
    assert "gamma:0.8" in by_name["PourWater-v0/td3/seed_3"].flags and "gamma:0.9" in by_name["PourWater-v0/sac/seed_3"].flags
    assert by_name["PourWater-v0/sac/seed_3"].folder == tmp_path / "runs" / "PourWater-v0" / "sac" / "seed_3"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "grid.yml is empty"),
        ("algos: [sac]\nenvs: [Pendulum-v1]\n", "has no seeds; add a line such as seeds: [0, 1, 2]"),
        ("algos: [sac]\nenvs: [Pendulum-v1]\nseed: [0]\n", "grid.yml:3: unknown key 'seed'; did you mean seeds?"),
        ("algos: [sacc]\nenvs: [Pendulum-v1]\nseeds: [0]\n", "grid.yml:1: unknown algorithm 'sacc'; did you mean sac?"),
        ("\nenvs: [Pendulum-v2]\nalgos: [sac]\nseeds: [0]\n", "grid.yml:2: unknown environment 'Pendulum-v2'; did you mean"),
        ("algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0, 1, 0]\n", "grid.yml:3: seeds has 0 twice"),
        ("algos: [sac]\nalgos: [td3]\n", "grid.yml:2: algos stands on line 1, too"),
        ("algos: sac\nenvs: [Pendulum-v1]\nseeds: [0]\n", "grid.yml:1: algos must be a list, such as [sac_por, sac]"),
        ("algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [one]\n", "grid.yml:3: seeds must be a list"),
        ("algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0]\nworkers: 0\n", "grid.yml:4: workers must be a positive integer"),
        ("algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0]\nhyperparams: 3\n", "grid.yml:4: hyperparams must be a mapping"),
        ("algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0]\noverrides: {td3: {}}\n", "grid.yml:4: unknown run 'td3'"),
        ("algos: [sac\n", "grid.yml:2: this is not YAML: expected ',' or ']'"),
        ("- sac\n", "grid.yml:1: a suite is a mapping, of at least these lines: algos: [sac_por, sac]; envs:"),
        ("algos:\n- sac\n- sacc\nenvs: [Pendulum-v1]\nseeds: [0]\n", "grid.yml:3: unknown algorithm 'sacc'"),
        ("algos: [sac]\nenvs:\n- Pendulum-v1\n- Pendulum-v1\nseeds: [0]\n", "grid.yml:4: envs has Pendulum-v1 twice"),
        ("algos: []\nenvs: [Pendulum-v1]\nseeds: [0]\n", "grid.yml:1: algos must be a list, such as [sac_por, sac]"),
        ("algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [-1]\n", "grid.yml:3: seeds must be a list, such as [0, 1, 2]"),
        ("algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0]\ngpus: many\n", "grid.yml:4: gpus must be a number such as 1"),
        (
            "algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0]\noverrides:\n  sac:\n    gamma: 1\n    gamma: 0.9\n",
            "grid.yml:7: gamma stands on line 6, too; keep one",
        ),
    ],
)
def test_bad_suite_files_name_the_line_and_the_fix(text, message, suite_file):
    with pytest.raises(UserError) as error:
        read_suite(suite_file(text))
    assert message in str(error.value) and "\n" not in str(error.value)


@given(st.text(alphabet="algosenvd: [],-{}&*!|\n\t'0.", max_size=40))
@settings(max_examples=200, deadline=None)
def test_whatever_a_suite_file_holds_the_error_is_one_line(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "any.yml"
    path.write_text(text)
    with pytest.raises(UserError) as error:
        read_suite(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


def test_the_suites_that_come_along_are_sound():
    for file in (ROOT / "suites").glob("*.yml"):
        assert isinstance(read_suite(file), Suite)


def test_dry_run_prints_commands_and_does_nothing(suite_file, tmp_path, capsys):
    path = suite_file("algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0, 1]\n")
    assert main(["suite", str(path), "--root", str(tmp_path / "runs"), "--dry-run"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and all(line.startswith("new ") and "--algo sac --env Pendulum-v1" in line for line in lines)
    assert not (tmp_path / "runs").exists()


SMALL_SUITE = """
algos: [sac, td3]
envs: [Pendulum-v1]
seeds: [0]
n_timesteps: 60
eval_freq: 60
eval_episodes: 1
workers: 2
hyperparams: {learning_starts: 50, buffer_size: 100, batch_size: 8}
overrides: {td3: {colour: blue}}
"""


def test_failures_are_named_and_what_is_finished_is_not_done_again(suite_file, tmp_path, capfd):
    path, root = suite_file(SMALL_SUITE), tmp_path / "runs"
    assert main(["suite", str(path), "--root", str(root)]) == 1
    shown = capfd.readouterr()
    assert "failed: Pendulum-v1/td3/seed_0" in shown.err and "unexpected keyword argument 'colour'" in shown.err
    assert shown.out.strip() == str(root / "grid" / "scores.csv")
    scores = pd.read_csv(root / "grid" / "scores.csv")
    assert scores[["algo", "seed", "step"]].values.tolist() == [["sac", 0, 60]]
    model = root / "grid" / "Pendulum-v1" / "sac" / "seed_0" / "sac" / "Pendulum-v1_1" / "Pendulum-v1.zip"
    written = model.stat().st_mtime_ns
    path.write_text(SMALL_SUITE.replace("colour: blue", "gamma: 0.9"))
    assert main(["suite", str(path), "--root", str(root)]) == 0
    assert model.stat().st_mtime_ns == written
    assert sorted(set(pd.read_csv(root / "grid" / "scores.csv")["algo"])) == ["sac", "td3"]


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_suite_of_six_runs_killed_twice_is_finished_by_the_third_start(suite_file, tmp_path):
    text = SMALL_SUITE.replace("overrides: {td3: {colour: blue}}\n", "save_freq: 50\n")
    text = text.replace("seeds: [0]", "seeds: [0, 1, 2]").replace("n_timesteps: 60", "n_timesteps: 400")
    command = [sys.executable, "-m", "sb3_por", "suite", suite_file(text), "--root", tmp_path / "runs"]
    for _ in range(2):
        process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, start_new_session=True)
        while not list((tmp_path / "runs").rglob("step_*")) and process.poll() is None:
            time.sleep(0.05)
        time.sleep(3)
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    scores = pd.read_csv(tmp_path / "runs" / "grid" / "scores.csv")
    assert scores.groupby(["algo", "seed"])["step"].apply(list).tolist() == [list(range(60, 400, 60)) + [400]] * 6
    assert len(list((tmp_path / "runs").rglob("Pendulum-v1_*"))) == 6
