"""A suite file becomes runs: each once, taken up where it stopped, failures named."""

import io
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import psutil
import pytest
from disks import make_read_only, small_disk
from hypothesis import given, settings
from hypothesis import strategies as st
from made_runs import write_run
from rich.console import Console

from sb3_por.__main__ import main
from sb3_por.common.errors import UserError
from sb3_por.evaluation.loading import load_model
from sb3_por.suites.pools import LocalPool
from sb3_por.suites.run_suite import progress_table
from sb3_por.suites.suite_file import Run, Suite, find_suite, read_suite, suite_runs
from sb3_por.training.zoo import main as train

ROOT = Path(__file__).parents[2]


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


def test_a_variant_is_an_algorithm_with_settings_and_a_name(suite_file, tmp_path):
    suite = read_suite(
        suite_file(
            "algos: [sac_por, por_paper]\nenvs: [PourWater-v0]\nseeds: [0]\nhyperparams: {pairing: swap, k: 2}\n"
            "variants:\n  por_paper: {algo: sac_por, pairing: paper}\n"
            "overrides: {PourWater-v0: {pairing: swap}, sac_por: {gamma: 0.9}, por_paper: {k: 3}}\n"
        )
    )
    plain, variant = suite_runs(suite, tmp_path)
    assert plain.flags[-3:] == ("pairing:'swap'", "k:2", "gamma:0.9") and "--label" not in plain.command()
    assert variant.flags[-3:] == ("pairing:'paper'", "k:3", "gamma:0.9")
    assert variant.name == "PourWater-v0/por_paper/seed_0"
    command = " ".join(variant.command())
    assert "--algo sac_por" in command and "--label por_paper" in command


def test_a_run_in_a_namespace_is_found_where_the_zoo_writes_it(suite_file, tmp_path):
    gym.register("ours/Pend-v0", "gymnasium.envs.classic_control:PendulumEnv", max_episode_steps=20)
    try:
        run = suite_runs(read_suite(suite_file("algos: [sac]\nenvs: [ours/Pend-v0]\nseeds: [0]\n")), tmp_path)[0]
    finally:
        del gym.registry["ours/Pend-v0"]
    assert run.state() == "new" and run.run_folder.name == "ours-Pend-v0_1"
    write_run(run.folder, "sac", "ours-Pend-v0")
    assert run.state() == "interrupted"
    (run.run_folder / "ours-Pend-v0.zip").touch()
    assert run.state() == "finished"


def test_narrow_env_kwargs_add_to_wide_ones(suite_file, tmp_path):
    text = "algos: [sac_por, v]\nenvs: [PourWater-v0]\nseeds: [0]\n"
    text += "hyperparams: {env_kwargs: {image_size: 48, obs_type: dict}}\n"
    text += "variants: {v: {algo: sac_por, env_kwargs: {image_size: 32}}}\n"
    text += "overrides: {PourWater-v0: {env_kwargs: {max_episode_steps: 20}}}\n"
    kwargs = [eval(run.flags[-1].removeprefix("env_kwargs:")) for run in suite_runs(read_suite(suite_file(text)), tmp_path)]
    assert kwargs[0] == {"image_size": 48, "obs_type": "dict", "max_episode_steps": 20}
    assert kwargs[1] == kwargs[0] | {"image_size": 32}
    with pytest.raises(UserError, match=r"env_kwargs must be arguments of an environment by name, got \[1\]"):
        suite_runs(read_suite(suite_file(text.replace("{max_episode_steps: 20}", "[1]"))), tmp_path)


def test_each_run_has_the_demonstrations_of_its_environment(suite_file, tmp_path):
    text = "algos: [sac_por]\nenvs: [PourWater-v0, FoldCloth-v0]\nseeds: [0]\ndemos: of_experts\n"
    for run in suite_runs(read_suite(suite_file(text)), tmp_path):
        assert " ".join(run.flags).endswith(f"--demos {Path('of_experts') / run.env}")


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
        (
            "algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0]\nhyperparams: {learning_rate: 1e-3}\n",
            "grid.yml:4: YAML reads 1e-3 as text; write the number with a point, such as 0.001",
        ),
        (
            "algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0]\ngym_packages: [no_such_package]\n",
            "cannot import the package no_such_package",
        ),
        (
            "algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0]\ndemos: 3\n",
            "grid.yml:4: demos must be a folder such as demos, got 3",
        ),
        ("algos: [sac\n", "grid.yml:2: this is not YAML: expected ',' or ']'"),
        ("- sac\n", "grid.yml:1: a suite is a mapping, of at least these lines: algos: [sac_por, sac]; envs:"),
        ("algos:\n- sac\n- sacc\nenvs: [Pendulum-v1]\nseeds: [0]\n", "grid.yml:3: unknown algorithm 'sacc'"),
        ("algos: [sac]\nenvs:\n- Pendulum-v1\n- Pendulum-v1\nseeds: [0]\n", "grid.yml:4: envs has Pendulum-v1 twice"),
        ("algos: []\nenvs: [Pendulum-v1]\nseeds: [0]\n", "grid.yml:1: algos must be a list, such as [sac_por, sac]"),
        ("algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [-1]\n", "grid.yml:3: seeds must be a list, such as [0, 1, 2]"),
        ("algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0]\ngpus: many\n", "grid.yml:4: gpus must be a number such as 1"),
        (
            "algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0]\nvariants:\n  sac: {algo: sac_por}\n",
            "grid.yml:5: sac is an algorithm; give the variant another name",
        ),
        ("algos: [v]\nenvs: [Pendulum-v1]\nseeds: [0]\nvariants: {v: {k: 2}}\n", "grid.yml:4: v has no algo; write for"),
        ("algos: [v]\nenvs: [Pendulum-v1]\nseeds: [0]\nvariants: {v: {algo: sacc}}\n", "grid.yml:4: unknown algorithm 'sacc'"),
        (
            "algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0]\nvariants: {off: {algo: sac}}\n",
            "grid.yml:4: off is read as False; write the variant's name in quotes",
        ),
        ("algos: [v]\nenvs: [Pendulum-v1]\nseeds: [0]\nvariants: {v: 3}\n", "grid.yml:4: variants must be a mapping"),
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


def test_a_suite_without_what_its_runs_read_starts_none(suite_file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    wrapper = "[{sb3_por.ranking.progress.RankedProgress: {ranker: pour.npz}}]"
    file = suite_file(
        "algos: [sac_drq, ranked]\nenvs: [PourWater-v0]\nseeds: [0, 1]\ndemos: of_experts\n"
        f"variants:\n  ranked: {{algo: sac_drq, env_wrapper: {wrapper}}}\n"
    )
    demos = Path("of_experts") / "PourWater-v0"
    for made, named in ((None, f"{demos} (of PourWater-v0/ranked/seed_1), pour.npz"), (demos, "not there: pour.npz (of")):
        if made is not None:
            made.mkdir(parents=True)
        assert main(["suite", str(file)]) == 2
        assert named in capsys.readouterr().err and not Path("runs").exists()
    assert main(["suite", str(file), "--dry-run"]) == 0
    text = "algos: [sac_drq]\nenvs: [PourWater-v0]\nseeds: [0]\nhyperparams: {demos: nowhere, max_grad_norm: .inf}\n"
    assert main(["suite", str(suite_file(text))]) == 2
    assert "not there: nowhere (of PourWater-v0/sac_drq/seed_0)" in capsys.readouterr().err


def test_the_suites_that_come_along_are_sound():
    for file in (ROOT / "suites").glob("*.yml"):
        assert isinstance(read_suite(file), Suite)


def test_a_suite_that_comes_along_is_found_by_name_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_suite("main") == ROOT / "suites" / "main.yml"
    assert find_suite("main.yml") == Path("main.yml")
    with pytest.raises(UserError, match="unknown suite 'smok'; did you mean smoke"):
        find_suite("smok")
    Path("main").write_text("a file of the user's")
    assert find_suite("main") == Path("main")


def test_dry_run_prints_commands_and_does_nothing(suite_file, tmp_path, capsys):
    path = suite_file("algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0, 1]\n")
    assert main(["suite", str(path), "--root", str(tmp_path / "runs"), "--dry-run"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and all(line.startswith("new ") and "--algo sac --env Pendulum-v1" in line for line in lines)
    assert not (tmp_path / "runs").exists()


# -- the suite itself, on a program that behaves as train.py does but starts at once ------------------------------------

FAKE_TRAINING = """
import os, shutil, signal, sys, time
run, env, algo = sys.argv[1:]
os.makedirs(f"{run}/{env}", exist_ok=True)
with open(f"{run}/{env}/args.yml", "w") as file:
    file.write("env: " + env)
if algo == "td3":
    print(*range(20), sep="\\n")
    sys.exit(3)
if algo == "ppo":
    os.kill(os.getpid(), signal.SIGKILL)
checkpoint = f"{run}/checkpoint"
os.makedirs(checkpoint, exist_ok=True)
begin = max([0, *(int(name[5:]) for name in os.listdir(checkpoint))])
with open(f"{run}/0.monitor.csv", "a" if begin else "w") as monitor:
    for step in range(begin + 1, 11):
        time.sleep(0.2)
        print(step, os.getpid(), flush=True)
        monitor.write("#\\nr,l,t\\n" * (step == 1) + f"0,1,{step}\\n")
        monitor.flush()
        os.mkdir(f"{checkpoint}/step_{step}")
open(f"{run}/{env}.zip", "w").close()
shutil.rmtree(checkpoint)
"""
FAKE_SUITE = "algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0, 1, 2]\nn_timesteps: 10\nworkers: 2\n"


@pytest.fixture
def fake_training(tmp_path, monkeypatch):
    script = tmp_path / "fake_training.py"
    script.write_text(FAKE_TRAINING)

    def command(run):
        return [sys.executable, "-SE", str(script), str(run.run_folder), run.env, run.algo]

    monkeypatch.setattr(Run, "command", command)


@pytest.fixture
def start_suite(suite_file, tmp_path, fake_training):
    """Starts a suite in a process of its own."""

    def start(text):
        process = multiprocessing.get_context("fork").Process(
            target=lambda: sys.exit(main(["suite", str(suite_file(text)), "--root", str(tmp_path / "runs")]))
        )
        process.start()
        return process

    return start


def wait_for(condition, seconds=30):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


def kill_suite(pid, workers_first, within):
    """SIGKILL to a suite, with its workers or alone; its workers do not outlive it (they would work on for longer)."""
    suite = psutil.Process(pid)
    workers = suite.children(recursive=True)
    for process in [*workers, suite] if workers_first else [suite]:
        process.kill()
    wait_for(lambda: all(map(has_ended, workers)), within)


def has_ended(process):
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def checkpoints_of(root):
    return sorted(path for path in root.rglob("step_*") if path.parent.name == "checkpoint")


def test_a_killed_suite_takes_its_workers_along_and_goes_on(start_suite, tmp_path):
    rng = random.Random(0)
    for workers_first in (False, True):
        process = start_suite(FAKE_SUITE)
        before = checkpoints_of(tmp_path)
        wait_for(lambda before=before: checkpoints_of(tmp_path) != before)
        time.sleep(rng.uniform(0, 0.3))
        kill_suite(process.pid, workers_first, 1)
        process.join()
        assert process.exitcode == -signal.SIGKILL
    process = start_suite(FAKE_SUITE)
    process.join()
    assert process.exitcode == 0
    processes = []
    for seed in range(3):
        log = tmp_path / "runs" / "grid" / "Pendulum-v1" / "sac" / f"seed_{seed}" / "log.txt"
        steps = [line.split() for line in log.read_text().splitlines()]
        assert sorted({int(step) for step, _ in steps}) == list(range(1, 11))
        processes.append(len({pid for _, pid in steps}))
        # Nothing that had a checkpoint was done again: at most the step that each kill cut.
        assert len(steps) <= 10 + processes[-1] - 1
    assert max(processes) > 1


def test_an_asked_for_stop_leaves_runs_that_go_on(start_suite, tmp_path, capfd):
    process = start_suite(FAKE_SUITE)
    wait_for(lambda: checkpoints_of(tmp_path))
    workers = psutil.Process(process.pid).children()
    os.kill(process.pid, signal.SIGTERM)
    process.join()
    assert process.exitcode == 130 and "interrupted; the same command resumes it" in capfd.readouterr().err
    wait_for(lambda: all(map(has_ended, workers)), 10)
    process = start_suite(FAKE_SUITE)
    process.join()
    assert process.exitcode == 0
    shown = capfd.readouterr().err
    assert "running      Pendulum-v1/sac/seed_0" in shown and "3 of 3 runs finished" in shown


def test_a_disk_that_becomes_read_only_ends_a_suite_in_one_line_and_loses_nothing(start_suite, tmp_path, capfd):
    with small_disk(tmp_path / "runs") as disk:
        process = start_suite(FAKE_SUITE)
        wait_for(lambda: checkpoints_of(disk))
        make_read_only(disk)
        process.join()
        shown = capfd.readouterr().err
        assert process.exitcode == 2 and "Traceback" not in shown
        assert f"cannot write {disk}/grid/scores.csv: Read-only file system" in shown.splitlines()[-1]
        subprocess.run(["umount", "--lazy", disk], check=True)  # what made it read-only
        before = checkpoints_of(disk)
        assert before
        process = start_suite(FAKE_SUITE)
        process.join()
        assert process.exitcode == 0
        for checkpoint in before:
            log = (checkpoint.parents[3] / "log.txt").read_text().splitlines()
            steps = [int(line.split()[0]) for line in log if line.split()[0].isdigit()]
            assert sorted(set(steps)) == list(range(1, 11)) and len(steps) <= 11, "taken up, not begun again"


def test_failed_runs_are_listed_with_the_end_of_their_logs(suite_file, tmp_path, fake_training, capfd):
    path = suite_file(FAKE_SUITE.replace("[sac]", "[sac, td3, ppo]").replace("[0, 1, 2]", "[0]"))
    assert main(["suite", str(path), "--root", str(tmp_path)]) == 1
    shown = capfd.readouterr().err.splitlines()
    begin = next(i for i, line in enumerate(shown) if line.startswith("failed: Pendulum-v1/td3/seed_0, "))
    assert shown[begin + 1 : begin + 9] == [*(f"  {n}" for n in range(13, 20)), "  [exit code 3]"]
    assert shown[begin + 9].startswith("failed: Pendulum-v1/ppo/seed_0") and shown[begin + 10] == "  [killed by SIGKILL]"
    assert "finished     Pendulum-v1/sac/seed_0" in shown
    assert main(["suite", str(path), "--root", str(tmp_path), "--dry-run"]) == 0
    assert [line.split()[0] for line in capfd.readouterr().out.splitlines()] == ["finished", "interrupted", "interrupted"]


def test_two_processes_do_not_work_on_one_suite(start_suite, suite_file, tmp_path, capfd):
    process = start_suite(FAKE_SUITE)
    wait_for(lambda: checkpoints_of(tmp_path))
    assert main(["suite", str(tmp_path / "grid.yml"), "--root", str(tmp_path / "runs")]) == 2
    assert "another process is at work on the suite in" in capfd.readouterr().err
    process.join()
    assert process.exitcode == 0


def test_the_table_shows_steps_speed_score_and_time_left(suite_file, tmp_path, fake_training):
    suite = read_suite(suite_file(FAKE_SUITE.replace("n_timesteps: 10", "n_timesteps: 1000")))
    pool = LocalPool(suite_runs(suite, tmp_path), workers=2, threads=1)
    run = pool.runs[0]
    run.run_folder.mkdir(parents=True)
    (run.run_folder / "0.monitor.csv").write_text("#\nr,l,t\n" + "0,100,1\n" * 4)
    np.savez(run.run_folder / "evaluations.npz", timesteps=[200], results=[[1, 3]], normalized_performance=[[0.25, 0.75]])
    pool.states[run], pool.started[run] = "running", (time.monotonic() - 10, 200)
    console = Console(file=io.StringIO(), width=120)
    console.print(progress_table(pool))
    lines = console.file.getvalue().splitlines()
    row = [cell.strip() for cell in next(line for line in lines if "seed_0" in line).split("│")[1:-1]]
    # 200 steps in 10 s; 600 are left of this run and 2600 of the suite.
    assert row == ["Pendulum-v1/sac/seed_0", "running", "400/1000", "20", "0.500", "30 s"]
    assert "0 of 3 runs finished, 20 steps/s, 2 min left" in lines[-1]


# -- with the real train.py ----------------------------------------------------------------------------------------------

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


def test_failures_are_named_and_what_is_finished_is_not_done_again(suite_file, tmp_path, capfd, monkeypatch):
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    path, root = suite_file(SMALL_SUITE), tmp_path / "runs"
    assert main(["suite", str(path), "--root", str(root)]) == 1
    shown = capfd.readouterr()
    assert "failed: Pendulum-v1/td3/seed_0" in shown.err and "unknown setting of td3 'colour'" in shown.err
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
@pytest.mark.timeout(900)
def test_a_suite_of_six_runs_killed_twice_ends_like_an_uninterrupted_one(suite_file, tmp_path):
    text = SMALL_SUITE.replace("overrides: {td3: {colour: blue}}\n", "save_freq: 50\n")
    path = suite_file(text.replace("seeds: [0]", "seeds: [0, 1, 2]").replace("n_timesteps: 60", "n_timesteps: 300"))
    root = tmp_path / "runs" / "grid"
    command = [sys.executable, "-m", "sb3_por", "suite", path, "--root", root.parent]
    rng = random.Random(0)
    for workers_first in (False, True):
        process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE)
        before = checkpoints_of(root)
        # A checkpoint on the way, so that there is a run to take up
        name = f"step_{rng.randrange(50, 250, 50)}"
        wait_for(lambda before=before, name=name: name in {path.name for path in set(checkpoints_of(root)) - set(before)}, 120)
        time.sleep(rng.uniform(0, 0.3))
        kill_suite(process.pid, workers_first, 10)
        process.communicate()
        assert process.returncode == -signal.SIGKILL
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    whole = tmp_path / "whole"
    assert train([*suite_runs(read_suite(path), whole)[0].command()[3:]]) == 0
    logs = [path.read_text() for path in root.rglob("log.txt")]
    assert sum(log.count("Log path:") for log in logs) > 6, "no run was taken up"
    for run, uninterrupted in zip(
        suite_runs(read_suite(path), root), [suite_runs(read_suite(path), whole)[0]] * 6, strict=True
    ):
        assert files_of(run.run_folder) == files_of(uninterrupted.run_folder)
        with (
            np.load(run.run_folder / "evaluations.npz") as first,
            np.load(uninterrupted.run_folder / "evaluations.npz") as second,
        ):
            assert first["timesteps"].tolist() == second["timesteps"].tolist() == [60, 120, 180, 240, 300]
        model = load_model(run.run_folder / "Pendulum-v1.zip")
        assert model.num_timesteps == 300 and model._n_updates == 250
    assert len(pd.read_csv(root / "scores.csv")) == 6 * 5


def files_of(run_folder):
    """Without TensorBoard's, whose number is that of the processes."""
    files = {str(path.relative_to(run_folder)) for path in run_folder.rglob("*") if path.is_file()}
    return {name for name in files if not name.startswith("tb/")}


def test_a_name_that_means_two_suites_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "main.yml").write_text("algos: [sac]\n")
    with pytest.raises(UserError, match=r"there is main\.yml here, and a suite main that comes along: type main\.yml or "):
        find_suite("main")
