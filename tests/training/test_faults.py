"""Faults injected for real into training: full disks, lost workers, signals, clocks, locks and NaN."""

import errno
import fcntl
import itertools
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import psutil
import pytest
import torch as th
from disks import fill, make_read_only, small_disk
from stable_baselines3.common.callbacks import BaseCallback

from sb3_por.analysis.por_logs import read_order
from sb3_por.common.errors import UserError
from sb3_por.evaluation.episodes import has_diverged
from sb3_por.evaluation.loading import load_model
from sb3_por.runs.checkpoints import latest_checkpoint
from sb3_por.runs.facts import take_inventory
from sb3_por.runs.folder import read_evaluations
from sb3_por.training.experiment import Experiment
from sb3_por.training.workers import WorkerProcesses
from sb3_por.training.zoo import main

ROOT = Path(__file__).parents[2]
PENDULUM = ["--env", "Pendulum-v1", "--seed", "1", "--num-threads", "1", "--eval-episodes", "1"]
SMALL = ["-params", "learning_starts:50", "buffer_size:500", "batch_size:16", "policy_kwargs:{'net_arch':[16]}"]
SAC = ["--algo", "sac", *PENDULUM]
POR = ["--algo", "sac_por", *PENDULUM]
POR_SMALL = [*SMALL, "policy:MlpPolicy", "n_timesteps:300"]


class At(BaseCallback):
    """Calls a function once, at a step."""

    def __init__(self, step, function):
        super().__init__()
        self.step, self.function = step, function

    def _on_step(self):
        if self.num_timesteps == self.step:
            self.function(self)
        return True


@pytest.fixture
def at(monkeypatch):
    """Makes a run call functions at certain steps."""

    def register(**functions):
        create = Experiment.create_callbacks

        def create_all(self):
            create(self)
            self.callbacks += [At(int(name.removeprefix("step_")), function) for name, function in functions.items()]

        monkeypatch.setattr(Experiment, "create_callbacks", create_all)

    return register


def last_line(capsys):
    return capsys.readouterr().err.splitlines()[-1]


# -- disks ---------------------------------------------------------------------------------------------------------------


def test_a_run_on_a_disk_that_is_full_for_a_while_continues_and_lacks_what_it_said(tmp_path, at, capfd):
    """Full from step 120 to 230: a checkpoint, a model, an evaluation, TensorBoard's file and the table of episodes."""
    with small_disk(tmp_path / "disk", megabytes=20) as disk:
        found = {}

        def fill_up(callback):
            found["before"] = latest_checkpoint(run).name
            fill(disk)

        def make_room(callback):
            found["during"] = latest_checkpoint(run).name, len(read_evaluations(run)["timesteps"])
            found["files"] = {path.name for path in run.rglob("*") if path.name.startswith(".")}
            (disk / "filling").unlink()

        run = disk / "sac_por" / "Pendulum-v1_1"
        at(step_120=fill_up, step_230=make_room)
        flags = ["-n", "450", "--eval-freq", "100", "--save-freq", "100", "--log-interval", "1", "-f", str(disk)]
        assert main([*POR, *flags, *POR_SMALL]) == 0
        shown = capfd.readouterr().err
        assert found["before"] == found["during"][0] == "step_100" and found["during"][1] == 1
        assert found["files"] <= {".lock", ".origin"}, "what could not be written whole takes no room"
        notes = [line for line in shown.splitlines() if line.startswith("note: cannot write")]
        assert all("No space left on device; free some space. The run continues; " in line for line in notes)
        for name in ("rl_model_200_steps.zip", "step_200", "evaluations.npz", "events"):
            assert len([line for line in notes if f"/{name}:" in line]) == 1, (name, notes)
        assert "Traceback" not in shown
        # When there was room again, all of it came, but the model of step 200 and TensorBoard's rows of that time.
        assert read_evaluations(run)["timesteps"].tolist() == [100, 200, 300, 400, 450]
        models = {path.name for path in run.glob("rl_model_*")}
        assert models == {f"rl_model_{step}_steps.zip" for step in (100, 300, 400)}
        assert load_model(run / "Pendulum-v1.zip").num_timesteps == 450
        rows = (run / "0.monitor.csv").read_text().splitlines()[2:]
        assert [row.split(",")[1] for row in rows] == ["200", "200"]
        order, _ = read_order([run])
        assert order["step"].max() >= 400


def test_the_end_of_a_run_on_a_full_disk_can_be_repeated(tmp_path, at, capsys, monkeypatch):
    with small_disk(tmp_path / "disk", megabytes=20) as disk:
        run = disk / "sac" / "Pendulum-v1_1"
        at(step_140=lambda _: fill(disk))
        flags = ["-n", "150", "--eval-freq", "-1", "--save-freq", "100", "-f", str(disk)]
        assert main([*SAC, *flags, *SMALL]) == 2
        said = last_line(capsys)
        assert f"cannot write {run}/Pendulum-v1.zip: No space left on device; free some space; the last checkpoint" in said
        assert said.endswith(f"{run}/checkpoint/step_100, resume from it with: python train.py --resume {run}")
        (disk / "filling").unlink()
        monkeypatch.undo()
        assert main(["--resume", str(run)]) == 0
        assert load_model(run / "Pendulum-v1.zip").num_timesteps == 150


def test_a_disk_that_becomes_read_only_keeps_the_checkpoint(tmp_path, at, capsys):
    with small_disk(tmp_path / "disk", megabytes=20) as disk:
        run = disk / "sac" / "Pendulum-v1_1"
        at(step_120=lambda _: make_read_only(disk))
        flags = ["-n", "150", "--eval-freq", "-1", "--save-freq", "100", "-f", str(disk)]
        assert main([*SAC, *flags, *SMALL]) == 2
        assert f"cannot write {run}/Pendulum-v1.zip: Read-only file system; the last checkpoint is" in last_line(capsys)
        assert latest_checkpoint(run).name == "step_100"


def test_a_read_only_folder_of_a_run_is_said_at_once(tmp_path, capsys):
    with small_disk(tmp_path / "disk", megabytes=20) as disk:
        assert main([*SAC, "-n", "60", "--eval-freq", "-1", "-f", str(disk), *SMALL]) == 0
        make_read_only(disk)
        run = disk / "sac" / "Pendulum-v1_1"
        assert main(["--resume", str(run), "-n", "90"]) == 2
        assert last_line(capsys) == f"train.py: error: cannot write in {run}: Read-only file system; give another folder"
        assert take_inventory([run])[0].state == "finished", "it can be read"
        assert load_model(run / "Pendulum-v1.zip").num_timesteps == 60


# -- worker processes and signals ------------------------------------------------------------------------------------------


@pytest.fixture
def workers():
    """Two environments in worker processes, in the middle of an episode."""
    env = WorkerProcesses([partial(gym.make, "Pendulum-v1")] * 2)
    env.reset()
    for _ in range(5):
        env.step(np.zeros((2, 1)))
    yield env
    env.close()


@pytest.mark.parametrize("moment", ["within a step", pytest.param("between steps", marks=pytest.mark.slow)])
def test_workers_outlive_signals_and_a_lost_one_is_an_error_that_closing_does_not_wait_for(moment, workers):
    for number in (signal.SIGINT, signal.SIGTERM):
        for process in workers.processes:
            os.kill(process.pid, number)
    time.sleep(0.3)
    assert len(workers.step(np.zeros((2, 1)))[0]) == 2
    others = [psutil.Process(process.pid) for process in workers.processes]
    if moment == "within a step":
        workers.step_async(np.zeros((2, 1)))
    os.kill(workers.processes[1].pid, signal.SIGKILL)
    begin = time.monotonic()
    with pytest.raises(UserError, match="worker 1 of 2 environment processes was killed by SIGKILL; is there enough memory"):
        if moment == "within a step":
            workers.step_wait()
        workers.step(np.zeros((2, 1)))
    workers.close()
    assert time.monotonic() - begin < 10
    assert not any(process.is_running() and process.status() != psutil.STATUS_ZOMBIE for process in others)


@pytest.mark.parametrize(
    "ask",
    [
        lambda env: env.get_attr("spec"),
        lambda env: env.set_attr("x", 1),
        lambda env: env.env_is_wrapped(gym.Wrapper),
        lambda env: env.reset(),
    ],
)
def test_every_question_to_a_lost_worker_is_an_error_in_words(ask, workers):
    os.kill(workers.processes[1].pid, signal.SIGKILL)
    with pytest.raises(UserError, match="worker 1 of 2 environment processes was killed by SIGKILL"):
        ask(workers)


def test_a_worker_that_ends_while_it_starts_is_an_error_and_takes_the_others_with_it():
    before = set(psutil.Process().children(recursive=True))
    with pytest.raises(UserError, match="an environment process ended while it made its environment"):
        WorkerProcesses([partial(gym.make, "Pendulum-v1"), partial(os._exit, 3)])
    started = set(psutil.Process().children(recursive=True)) - before
    # What stays are multiprocessing's own two, which the next workers use.
    wait_for(lambda: sum(process.is_running() and process.status() != psutil.STATUS_ZOMBIE for process in started) <= 2)


@pytest.mark.slow
def test_workers_end_with_a_process_that_does_not_close_them(tmp_path):
    script = tmp_path / "leaves.py"
    script.write_text(
        "import gymnasium\nfrom functools import partial\nfrom sb3_por.training.workers import WorkerProcesses\n"
        "if __name__ == '__main__':\n"
        "    env = WorkerProcesses([partial(gymnasium.make, 'Pendulum-v1')] * 2)\n    env.reset()\n"
        "    print(*(process.pid for process in env.processes), flush=True)\n    1 / 0\n"
    )
    done = subprocess.run([sys.executable, script], env=ENV, capture_output=True, text=True, timeout=240)
    assert "ZeroDivisionError" in done.stderr
    assert not any(psutil.pid_exists(int(pid)) for pid in done.stdout.split())


#: For programs that are started here
ENV = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}


@pytest.fixture
def start():
    """Starts train.py in a process group of its own; it does not outlive the test."""
    started = []

    def popen(*words):
        command = [sys.executable, "train.py", *map(str, words)]
        started.append(subprocess.Popen(command, cwd=ROOT, env=ENV, stderr=subprocess.PIPE, text=True, start_new_session=True))
        return started[-1]

    yield popen
    for process in started:
        process.kill()
        process.communicate()


def wait_for(condition, seconds=250):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


TWO_WORKERS = ["--vec-env", "subproc", "-params", "n_envs:2", *SMALL[1:]]


@pytest.mark.slow
@pytest.mark.parametrize("moment", [0.0, 0.2])
def test_a_run_that_loses_a_worker_says_so_and_is_resumed(moment, tmp_path, start):
    flags = ["-n", "1200", "--eval-freq", "-1", "--save-freq", "60", "-f", tmp_path]
    process = start(*SAC, *flags, *TWO_WORKERS)
    run = tmp_path / "sac" / "Pendulum-v1_1"
    wait_for(lambda: latest_checkpoint(run))
    time.sleep(moment)
    # The workers are children of multiprocessing's server of processes.
    of_server = [child for child in psutil.Process(process.pid).children(recursive=True) if not child.children()]
    victim = max(of_server, key=lambda child: child.create_time())
    victim.kill()
    _, errors = process.communicate(timeout=240)
    said = errors.splitlines()[-1]
    assert process.returncode == 2, errors
    assert "environment processes was killed by SIGKILL; is there enough memory for all of them?; the last checkpoint" in said
    assert "Traceback" not in errors
    assert main(["--resume", str(run)]) == 0
    assert load_model(run / "Pendulum-v1.zip").num_timesteps == 1200


def test_a_second_sigterm_does_not_cut_the_checkpoint_short(tmp_path, at, capsys):
    """A run of a suite gets one from the cluster and one from the suite."""

    def terminate_twice(callback):
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.01)

    at(step_70=terminate_twice)
    assert main([*SAC, "-n", "100", "--eval-freq", "-1", "-f", str(tmp_path), *SMALL]) == 130
    run = tmp_path / "sac" / "Pendulum-v1_1"
    assert last_line(capsys) == f"train.py: interrupted at step 70; resume with: python train.py --resume {run}"
    assert latest_checkpoint(run).name == "step_70"


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_to_all_processes_of_a_run_saves_a_checkpoint(number, tmp_path, start):
    """As Slurm's scancel and Ctrl-C in a terminal send it."""
    flags = ["-n", "1200", "--eval-freq", "-1", "--save-freq", "0", "-f", tmp_path]
    process = start(*SAC, *flags, *TWO_WORKERS)
    run = tmp_path / "sac" / "Pendulum-v1_1"
    wait_for(lambda: (run / "0.monitor.csv").is_file() and len((run / "0.monitor.csv").read_text().splitlines()) > 2)
    assert latest_checkpoint(run) is None
    os.killpg(process.pid, number)
    _, errors = process.communicate(timeout=240)
    assert process.returncode == 130, errors
    step = int(latest_checkpoint(run).name.removeprefix("step_"))
    assert errors.splitlines()[-1] == f"train.py: interrupted at step {step}; resume with: python train.py --resume {run}"
    assert main(["--resume", str(run)]) == 0
    assert load_model(run / "Pendulum-v1.zip").num_timesteps == 1200


# -- numbers that are not finite -------------------------------------------------------------------------------------------


def poison(parameters):
    """Make the next gradient of a network's first weights NaN."""

    def spoil(callback):
        parameter = next(parameters(callback.model))
        hook = parameter.register_hook(lambda gradient: (hook.remove(), gradient * float("nan"))[1])

    return spoil


NETWORKS = {
    "critic": lambda model: model.critic.parameters(),
    "actor": lambda model: model.actor.mu.parameters(),
    "objective": lambda model: model.policy.objective.parameters(),
}


@pytest.mark.parametrize("network", NETWORKS)
def test_a_gradient_that_is_nan_ends_training_and_names_the_last_checkpoint(network, tmp_path, at, capsys):
    at(step_130=poison(NETWORKS[network]))
    flags = ["-n", "300", "--eval-freq", "-1", "--save-freq", "60", "-f", str(tmp_path)]
    assert main([*POR, *flags, *POR_SMALL]) == 2
    said = last_line(capsys)
    run = tmp_path / "sac_por" / "Pendulum-v1_1"
    step = int(re.search(r"diverged before step (\d+):", said)[1])
    assert step in (130, 131), "in the same update or the next one"
    assert re.search(
        r": (the networks hold NaN|\w+_loss is nan at update \d+: lower the learning_rate, or load an earlier model); ", said
    )
    checkpoint = run / "checkpoint" / "step_120"
    command = f"python train.py --resume {run} -params learning_rate:LOWER"
    assert said.endswith(f"; the last checkpoint is {checkpoint}, resume from it with: {command}")
    for file in run.rglob("*.zip"):
        assert not has_diverged(load_model(file)), file


def test_networks_of_other_algorithms_that_hold_nan_are_not_saved(tmp_path, at, capsys):
    at(step_70=lambda callback: next(callback.model.critic.parameters()).data.fill_(float("nan")))
    flags = ["-n", "200", "--eval-freq", "-1", "--save-freq", "60", "-f", str(tmp_path)]
    assert main([*SAC, *flags, *SMALL, "learning_starts:1000"]) == 2
    run = tmp_path / "sac" / "Pendulum-v1_1"
    assert f"the networks hold NaN; the last checkpoint is {run}/checkpoint/step_60" in last_line(capsys)
    assert [file.name for file in run.glob("*.zip")] == ["rl_model_60_steps.zip"]


# -- clocks and locks ----------------------------------------------------------------------------------------------------


def test_a_clock_that_jumps_changes_nothing(tmp_path, monkeypatch):
    def train(folder):
        flags = ["-n", "220", "--eval-freq", "100", "--save-freq", "100", "--log-interval", "1", "-f", str(folder)]
        assert main([*POR, *flags, *POR_SMALL]) == 0
        return folder / "sac_por" / "Pendulum-v1_1"

    steady = train(tmp_path / "steady")
    jumps = itertools.cycle([0, 86_400, -86_400, 3_600, -10 * 365 * 86_400])
    true_time, true_time_ns = time.time, time.time_ns
    with monkeypatch.context() as patch:
        patch.setattr(time, "time", lambda: true_time() + next(jumps))
        patch.setattr(time, "time_ns", lambda: true_time_ns() + next(jumps) * 10**9)
        jumping = train(tmp_path / "jumping")
    first, second = read_evaluations(steady), read_evaluations(jumping)
    seconds = second.pop("wall_clock_s")
    assert (np.diff(seconds) > 0).all() and 0 < seconds[0] < seconds[-1] < 300
    del first["wall_clock_s"]
    assert all(np.array_equal(first[name], second[name], equal_nan=True) for name in first)
    weights = [load_model(run / "Pendulum-v1.zip").policy.state_dict() for run in (steady, jumping)]
    assert all(th.equal(value, weights[1][name]) for name, value in weights[0].items())
    orders = [read_order([run])[0] for run in (steady, jumping)]
    assert orders[0]["step"].tolist() == orders[1]["step"].tolist()


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS], ids=errno.errorcode.get)
def test_a_file_system_without_locks_is_said_and_used(code, tmp_path, monkeypatch, capsys):
    """As NFS without its lock service answers, and FUSE."""

    def refuse(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", refuse)
    assert main([*SAC, "-n", "60", "--eval-freq", "-1", "-f", str(tmp_path), *SMALL]) == 0
    run = tmp_path / "sac" / "Pendulum-v1_1"
    if code != errno.ENOSYS:  # where filelock has a lock of its own
        note = f"note: the file system of {run} has no locks ({os.strerror(code)}): see to it that no second process"
        assert note in capsys.readouterr().err
    assert take_inventory([run])[0].state == "finished"
    assert main(["--resume", str(run), "-n", "90"]) == 0


@pytest.mark.slow
def test_a_shared_memory_that_is_too_small_is_not_missed(tmp_path):
    """Containers have 64 MB in /dev/shm, or less: here 64 KiB, in a mount namespace of its own."""
    flags = ["-n", "160", "--eval-freq", "80", "--save-freq", "60", "-f", str(tmp_path), *TWO_WORKERS]
    words = " ".join(map(shlex.quote, [sys.executable, "train.py", *SAC, *flags]))
    script = f"mount -t tmpfs -o size=64k tmpfs /dev/shm || exit 77; {words}"
    command = ["unshare", "--mount", "bash", "-c", script]
    if shutil.which("unshare") is None:
        pytest.skip("unshare is not installed")
    done = subprocess.run(command, cwd=ROOT, env=ENV, capture_output=True, text=True, timeout=240)
    if done.returncode == 77 or "unshare" in done.stderr:
        pytest.skip(f"no mount namespace: {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr
    assert load_model(tmp_path / "sac" / "Pendulum-v1_1" / "Pendulum-v1.zip").num_timesteps == 160
