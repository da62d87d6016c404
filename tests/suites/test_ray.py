"""Suites on a Ray cluster: the copy of a run's folder, and a real cluster whose workers, nodes, head and driver are killed."""

import secrets
import signal
import subprocess
import sys
import time
from dataclasses import replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from ray_cluster import PATIENCE, RayCluster, wait_for
from stable_baselines3 import SAC

from sb3_por.__main__ import main
from sb3_por.evaluation.loading import load_model
from sb3_por.runs.checkpoints import latest_checkpoint, remove_checkpoints, restore_buffer, save_checkpoint
from sb3_por.suites.folder_sync import read_changes, write_changes
from sb3_por.suites.run import Run

ROOT = Path(__file__).parents[2]
needs_ray = pytest.mark.skipif(
    find_spec("ray") is None, reason="Ray is not installed: pip install -c constraints.txt '.[ray]'"
)


# -- the copy ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def runs(tmp_path):
    """A run with settings and nothing else, and where its copy is."""
    run = Run("sac", "Pendulum-v1", 0, tmp_path / "here", ())
    (run.run_folder / "Pendulum-v1").mkdir(parents=True)
    (run.run_folder / "Pendulum-v1" / "args.yml").write_text("env: Pendulum-v1")
    return run, replace(run, folder=tmp_path / "there")


def contents(run):
    files = (path for path in run.folder.rglob("*") if path.is_file())
    return {str(path.relative_to(run.folder)): path.read_bytes() for path in files if not path.name.startswith(".")}


def test_a_copy_follows_a_run_to_its_end(runs):
    run, copy = runs
    known = {}
    model = SAC("MlpPolicy", "Pendulum-v1", buffer_size=100, learning_starts=1000, seed=0)
    for _ in range(3):
        model.learn(20, reset_num_timesteps=False)
        save_checkpoint(model, run.run_folder, run.env)
        with open(run.log, "a") as log:
            log.write("one line more\n")
        write_changes(copy, read_changes(run, known))
        assert contents(copy) == contents(run) and copy.state() == "interrupted"
        loaded = SAC.load(latest_checkpoint(copy.run_folder) / "model.zip")
        restore_buffer(loaded, latest_checkpoint(copy.run_folder))
        assert np.array_equal(loaded.replay_buffer.observations, model.replay_buffer.observations)
    assert read_changes(run, known) == {}, "nothing is sent twice"
    model.save(run.run_folder / "Pendulum-v1.zip")
    remove_checkpoints(run.run_folder)
    write_changes(copy, read_changes(run, known))
    assert contents(copy) == contents(run) and copy.state() == "finished"


def test_a_checkpoint_that_is_replaced_while_it_is_read_is_read_again(runs, monkeypatch):
    run, copy = runs
    first, second = (run.run_folder / "checkpoint" / f"step_{n}" for n in (1, 2))
    first.mkdir(parents=True)
    (first / "model.zip").write_text("first")
    read_bytes = Path.read_bytes

    def read_and_replace(path):
        content = read_bytes(path)
        if path.parent == first:
            monkeypatch.undo()
            first.rename(second)
        return content

    monkeypatch.setattr(Path, "read_bytes", read_and_replace)
    write_changes(copy, read_changes(run, {}))
    assert contents(copy) == contents(run) and latest_checkpoint(copy.run_folder).name == "step_2"


@pytest.mark.parametrize("n_writes", [0, 3, 5, 8])
def test_a_copy_that_is_cut_short_can_be_taken_up(n_writes, runs, monkeypatch):
    run, copy = runs
    known = {}
    model = SAC("MlpPolicy", "Pendulum-v1", buffer_size=100, learning_starts=1000, seed=0).learn(10)
    save_checkpoint(model, run.run_folder, run.env)
    write_changes(copy, read_changes(run, known))
    save_checkpoint(model.learn(10, reset_num_timesteps=False), run.run_folder, run.env)
    write_bytes, written = Path.write_bytes, []

    def write_some(path, content):
        if len(written) == n_writes:
            raise SystemExit("killed here")
        written.append(path)
        return write_bytes(path, content)

    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(Path, "write_bytes", write_some)
        write_changes(copy, read_changes(run, known))
    checkpoint = latest_checkpoint(copy.run_folder)
    assert checkpoint.name == "step_10" and copy.state() == "interrupted"
    restore_buffer(SAC.load(checkpoint / "model.zip"), checkpoint)


# -- the cluster ---------------------------------------------------------------------------------------------------------


def test_without_ray_one_line_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "sb3_por.suites.ray_pool", raising=False)
    (tmp_path / "grid.yml").write_text("algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0]\n")
    assert main(["suite", str(tmp_path / "grid.yml"), "--root", str(tmp_path / "runs"), "--ray"]) == 2
    error = capsys.readouterr().err
    assert "--ray needs Ray: pip install" in error and error.count("\n") == 1


GRID = """
algos: [sac]
envs: [Pendulum-v1]
seeds: [0, 1, 2]
n_timesteps: 300
eval_freq: 50
eval_episodes: 1
save_freq: 50
hyperparams: {learning_starts: 50, buffer_size: 500, batch_size: 8}
"""


@pytest.fixture
def cluster(tmp_path):
    """A cluster without nodes."""
    (tmp_path / "nodes").mkdir()
    cluster = RayCluster(tmp_path / "nodes")
    yield cluster
    cluster.close()


@pytest.fixture
def start(cluster, tmp_path):
    """Starts the suite of a grid on the cluster; it does not outlive the test."""
    started = []

    def popen(grid, *flags, **variables):
        (tmp_path / "grid.yml").write_text(grid)
        words = [sys.executable, "-m", "sb3_por", "suite", tmp_path / "grid.yml", "--root", tmp_path / "runs"]
        env = {name: value for name, value in (cluster.env | variables).items() if value}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        started.append(subprocess.Popen([*words, "--ray", cluster.address, *flags], cwd=ROOT, env=env, **pipes))
        return started[-1]

    yield popen
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def suite_run(tmp_path):
    return lambda seed: Run(
        "sac", "Pendulum-v1", seed, tmp_path / "runs" / "grid" / "Pendulum-v1" / "sac" / f"seed_{seed}", ()
    )


def assert_whole(runs, n_timesteps=300, eval_freq=50):
    """Every run is finished, with all of its updates and each of its evaluations once."""
    for run in runs:
        assert run.state() == "finished", run.log.read_text()
        assert load_model(run.run_folder / "Pendulum-v1.zip")._n_updates == n_timesteps - 50
        assert not [path for path in run.folder.rglob("*") if path.name == "checkpoint"]
    scores = pd.read_csv(runs[0].folder.parents[2] / "scores.csv")
    steps = list(range(eval_freq, n_timesteps + 1, eval_freq))
    assert scores.groupby("seed")["step"].apply(list).tolist() == [steps] * len(runs)


def beginnings(run):
    """How often a run was begun or resumed, and how often it has done its first evaluation."""
    log = run.log.read_text()
    return log.count("Log path:"), log.count("\nStep 50:")


@needs_ray
@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_suite_outlives_a_worker_and_a_node_and_uses_one_that_joins(cluster, start, suite_run, tmp_path):
    for name in ("head", "second", "third"):
        cluster.start(name)
    refused = start(GRID + "gpus: 1\n")
    assert "no machine of the Ray cluster has 1 CPUs and 1 GPUs" in refused.communicate()[1] and refused.returncode == 2

    suite = start(GRID.replace("[0, 1, 2]", "[0, 1, 2, 3]"))
    lost = []
    for name, victim in (("head", "worker"), ("third", "node")):
        wait_for(lambda name=name: cluster.trainings(name))
        ((seed, process),) = cluster.trainings(name).items()
        run = suite_run(seed)
        wait_for(lambda run=run: latest_checkpoint(run.run_folder))
        if victim == "worker":
            process.parent().kill()
        else:
            cluster.kill(name)
        lost.append(run)
    cluster.start("fourth")
    wait_for(lambda: cluster.trainings("fourth"))
    shown, errors = suite.communicate()
    assert suite.returncode == 0, errors

    assert lost[0] != lost[1]
    assert [beginnings(run) for run in lost] == [(2, 1)] * 2, "taken up, not begun again"
    assert_whole([suite_run(seed) for seed in range(4)])
    # Ray itself writes to stdout what it has lost.
    assert shown.splitlines()[-1] == str(tmp_path / "runs" / "grid" / "scores.csv")


@needs_ray
@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_suite_that_ends_takes_its_runs_along_and_is_resumed(cluster, start, suite_run):
    """SIGTERM, and SIGKILL, to the program that was started by hand."""
    cluster.start("head", cpus=2)
    for number, code in ((signal.SIGTERM, 130), (signal.SIGKILL, -9)):
        suite = start(GRID)
        wait_for(lambda: len(cluster.trainings()) == 2)
        wait_for(lambda: any(latest_checkpoint(suite_run(seed).run_folder) for seed in range(3)))
        suite.send_signal(number)
        errors = suite.communicate()[1]
        assert suite.returncode == code, errors
        assert number == signal.SIGKILL or "interrupted; the same command resumes it" in errors
        wait_for(lambda: not cluster.trainings(), 60)
    suite = start(GRID)
    errors = suite.communicate()[1]
    assert suite.returncode == 0, errors
    runs = [suite_run(seed) for seed in range(3)]
    assert_whole(runs)
    assert max(map(beginnings, runs))[0] > 1 and {first for _, first in map(beginnings, runs)} == {1}


@needs_ray
@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_suite_waits_for_a_head_that_is_lost(cluster, start, suite_run):
    """For longer than the minute after which Ray ends processes that miss it."""
    for name in ("head", "second"):
        cluster.start(name)
    suite = start(GRID)
    wait_for(lambda: any(latest_checkpoint(suite_run(seed).run_folder) for seed in range(3)))
    cluster.kill("head")
    cluster.kill("second")
    time.sleep(70)
    assert suite.poll() is None, suite.communicate()[1]
    cluster.start("head", cpus=2)
    errors = suite.communicate()[1]
    assert suite.returncode == 0, errors
    (note,) = [line for line in errors.splitlines() if line.startswith("note: ")]
    assert "the Ray cluster is lost" in note and "continue when it is started again at the same address" in note
    runs = [suite_run(seed) for seed in range(3)]
    assert_whole(runs)
    assert {first for _, first in map(beginnings, runs)} == {1}


@needs_ray
@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_token_is_required_and_versions_that_differ_are_named(cluster, start, suite_run, tmp_path):
    cluster.start("head")
    for variables in ({"RAY_AUTH_MODE": "", "RAY_AUTH_TOKEN": ""}, {"RAY_AUTH_TOKEN": secrets.token_hex(32)}):
        refused = start(GRID, **variables)
        errors = refused.communicate()[1]
        assert refused.returncode == 2 and f"error: no Ray cluster at {cluster.address}: " in errors.splitlines()[-1], errors
        assert "RAY_AUTH_MODE must be the same there and here" in errors
    stranger = cluster.start_unchecked("stranger", RAY_AUTH_TOKEN=secrets.token_hex(32))
    assert stranger.wait(PATIENCE) != 0 and "Ray runtime started" not in cluster.log("stranger")

    # As another interpreter would present itself
    (tmp_path / "python").mkdir()
    (tmp_path / "python" / "sitecustomize.py").write_text(
        "import ray._private.utils as utils\nutils.compute_version_info = lambda: (utils.ray.__version__, '3.10.1')\n"
    )
    refused = start(GRID, PYTHONPATH=f"{tmp_path / 'python'}:{ROOT}")
    errors = refused.communicate()[1]
    assert refused.returncode == 2 and "install the same versions as on the Ray cluster" in errors, errors
    assert "Python: 3.10.1" in errors

    # A machine with another version of a package, as its metadata say
    package = tmp_path / "packages" / "gymnasium-0.0.1.dist-info"
    package.mkdir(parents=True)
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: gymnasium\nVersion: 0.0.1\n")
    cluster.kill("head")
    cluster.start("head", PYTHONPATH=f"{package.parent}:{ROOT}")
    suite = start(GRID.replace("[0, 1, 2]", "[0]"))
    errors = suite.communicate()[1]
    assert suite.returncode == 0, errors
    assert f"has gymnasium 0.0.1 instead of {version('gymnasium')}: its numbers may differ" in errors
    assert errors.count("its numbers may differ") == 1
