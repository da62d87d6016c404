"""Suites on a Ray cluster: the copy of a run's folder, and a real cluster of two nodes that loses a worker and a node."""

import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import psutil
import pytest
from stable_baselines3 import SAC

from sb3_por.__main__ import main
from sb3_por.evaluation.loading import load_model
from sb3_por.runs.checkpoints import latest_checkpoint, remove_checkpoints, restore_buffer, save_checkpoint
from sb3_por.suites.folder_sync import read_changes, write_changes
from sb3_por.suites.suite_file import Run

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
    """Address, environment variables, and the processes of a head and of another node, with one CPU each."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    # A token of its own: without one, anybody who reaches the port may run programs. Ray's sockets want a short path.
    folder = tempfile.mkdtemp(prefix="ray_", dir="/tmp")
    env = os.environ | {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32), "TMPDIR": folder}
    env["RAY_worker_niceness"] = "0"  # 15 by default, which on a busy machine takes long
    command = [
        sys.executable,
        "-m",
        "ray.scripts.scripts",
        "start",
        "--block",
        "--num-cpus=1",
        "--object-store-memory=80000000",
    ]
    head = [f"--port={port}", "--head", "--include-dashboard=false", "--disable-usage-stats", f"--temp-dir={folder}"]
    nodes = []
    try:
        for number, more in enumerate((head, [f"--address=127.0.0.1:{port}"])):
            log = tmp_path / f"node_{number}.txt"
            with open(log, "wb") as file:
                node = subprocess.Popen([*command, *more], env=env, stdout=file, stderr=file, start_new_session=True)
            nodes.append(node)
            wait_for(lambda log=log: "Ray runtime started" in log.read_text(), 90)
        yield f"127.0.0.1:{port}", env, nodes
    finally:
        left = [process for node in nodes for process in [*descendants(node), node]]
        for process in left:
            process.kill()
        for process in left:
            process.wait(10)
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def start(cluster):
    """Starts a program with the environment variables of the cluster; it does not outlive the test."""
    started = []

    def popen(command):
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        started.append(subprocess.Popen(command, cwd=ROOT, env=cluster[1], **pipes))
        return started[-1]

    yield popen
    for process in started:
        process.kill()
        process.communicate()


def descendants(process):
    try:
        return psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def wait_for(condition, seconds):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.1)


def training_below(node):
    """The Ray worker on a node that has a run, and the run's seed."""
    for process in descendants(node):
        try:
            command = process.cmdline()
            if "sb3_por.zoo" in command and "--seed" in command:
                return process.parent(), int(command[command.index("--seed") + 1])
        except psutil.NoSuchProcess:
            continue
    return None


@needs_ray
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_suite_outlives_a_worker_and_a_node_of_its_cluster(tmp_path, cluster, start):
    address, _, (head, other) = cluster
    path, root = tmp_path / "grid.yml", tmp_path / "runs" / "grid"
    command = [sys.executable, "-m", "sb3_por", "suite", path, "--root", root.parent, "--ray", address]

    path.write_text(GRID + "gpus: 1\n")
    refused = start(command)
    assert "no machine of the Ray cluster has 1 CPUs and 1 GPUs" in refused.communicate()[1] and refused.returncode == 2

    path.write_text(GRID)
    stopped = start([*command, "--root", tmp_path / "stopped"])
    wait_for(lambda: training_below(head), 240)
    stopped.terminate()
    assert "interrupted; the same command resumes it" in stopped.communicate()[1] and stopped.returncode == 130
    wait_for(lambda: training_below(head) is None and training_below(other) is None, 20)

    suite = start(command)
    lost = []
    for node, victim in ((head, "worker"), (other, "node")):
        wait_for(lambda node=node: training_below(node), 240)
        worker, seed = training_below(node)
        run = Run("sac", "Pendulum-v1", seed, root / "Pendulum-v1" / "sac" / f"seed_{seed}", ())
        wait_for(lambda run=run: latest_checkpoint(run.run_folder), 240)
        for process in [worker] if victim == "worker" else [*descendants(node), psutil.Process(node.pid)]:
            process.send_signal(signal.SIGKILL)
        lost.append(run)
    shown, errors = suite.communicate()
    assert suite.returncode == 0, errors

    assert lost[0] != lost[1]
    for run in lost:
        log = run.log.read_text()
        assert log.count("Log path:") == 2 and log.count("\nStep 50:") == 1, "taken up, not begun again"
    for seed in range(3):
        run = Run("sac", "Pendulum-v1", seed, root / "Pendulum-v1" / "sac" / f"seed_{seed}", ())
        assert run.state() == "finished"
        assert load_model(run.run_folder / "Pendulum-v1.zip")._n_updates == 250
    # Ray itself writes to stdout what it has lost.
    assert shown.splitlines()[-1] == str(root / "scores.csv")
    scores = pd.read_csv(root / "scores.csv")
    assert scores.groupby("seed")["step"].apply(list).tolist() == [[50, 100, 150, 200, 250, 300]] * 3
