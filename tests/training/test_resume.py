"""A killed run is resumed from its last checkpoint and ends like an uninterrupted one."""

import math
import os
import pickle
import random
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback

from sb3_por import SACPOR
from sb3_por.common.files import atomic_write
from sb3_por.evaluation.loading import load_model
from sb3_por.runs import checkpoints
from sb3_por.runs.checkpoints import latest_checkpoint, read_rng_state, remove_checkpoints, restore_buffer, save_checkpoint
from sb3_por.runs.folder import is_finished
from sb3_por.training.zoo import main

ROOT = Path(__file__).parents[2]
N_STEPS = 700
EVALUATED = [150, 300, 450, 600, 700]
FLAGS = ["--algo", "sac", "--env", "Pendulum-v1", "-n", str(N_STEPS), "--seed", "1", "--num-threads", "1"]
OFTEN = ["--save-freq", "50", "--eval-freq", "150", "--eval-episodes", "1", "--save-replay-buffer"]
SMALL = ["-params", "learning_starts:50", "buffer_size:500", "batch_size:16"]


@contextmanager
def killed_at(step):
    """The run inside ends at a step as if it had been killed there."""

    def die(callback):
        if callback.num_timesteps == step:
            raise RuntimeError("killed")
        return True

    with pytest.MonkeyPatch.context() as patch, pytest.raises(RuntimeError, match="killed"):
        patch.setattr("sb3_por.training.experiment.CheckpointCallback._on_step", die)
        yield


def model_with(n_transitions):
    model = SAC("MlpPolicy", "Pendulum-v1", buffer_size=200, learning_starts=1000, seed=0)
    return model.learn(n_transitions)


def same_buffer(first, second):
    return all(
        np.array_equal(value, getattr(second, name)) for name, value in vars(first).items() if isinstance(value, np.ndarray)
    )


def test_a_checkpoint_holds_model_buffer_and_generators(tmp_path):
    model = model_with(60)
    folder = save_checkpoint(model, tmp_path, "Pendulum-v1")
    assert latest_checkpoint(tmp_path) == folder == tmp_path / "checkpoint" / "step_60"
    drawn = np.random.rand()
    loaded = SAC.load(folder / "model.zip", env=model.env)
    restore_buffer(loaded, folder)
    assert loaded.num_timesteps == 60 and loaded.replay_buffer.pos == 60
    assert same_buffer(model.replay_buffer, loaded.replay_buffer)
    np.random.set_state(read_rng_state(folder)["numpy"])
    assert np.random.rand() == drawn
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.replay_buffer.pos == 80


def test_returns_of_several_steps_end_where_a_run_was_resumed(tmp_path):
    model = SAC("MlpPolicy", "Pendulum-v1", buffer_size=200, learning_starts=1000, n_steps=3, seed=0).learn(60)
    folder = save_checkpoint(model, tmp_path, "Pendulum-v1")
    restore_buffer(model, folder)
    assert model.replay_buffer.timeouts[:60, 0].tolist() == [0] * 59 + [1]


def test_a_sequence_buffer_comes_back_from_its_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoints, "BLOCK_SIZE", 100)
    model = SACPOR("MlpPolicy", "Pendulum-v1", buffer_size=50, learning_starts=1000, seed=0)
    model.learn(210)  # over a time limit at 200, and round the ring
    folder = save_checkpoint(model, tmp_path, "Pendulum-v1")
    loaded = SACPOR.load(folder / "model.zip")
    restore_buffer(loaded, folder)
    for np_random in (1, 2):
        batches = []
        for buffer in (model.replay_buffer, loaded.replay_buffer):
            np.random.seed(np_random)
            batches.append(buffer.sample(16))
        assert all(np.array_equal(a, b) for a, b in zip(batches[0][:5], batches[1][:5], strict=True))


def test_a_second_checkpoint_writes_what_is_new_and_removes_what_is_old(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoints, "BLOCK_SIZE", 120)  # ten observations
    model = model_with(100)
    save_checkpoint(model, tmp_path, "Pendulum-v1")
    blocks = tmp_path / "checkpoint" / "blocks"
    before = {block.name: block.stat().st_mtime_ns for block in blocks.iterdir()}
    model.learn(10, reset_num_timesteps=False)
    folder = save_checkpoint(model, tmp_path, "Pendulum-v1")
    after = {block.name: block.stat().st_mtime_ns for block in blocks.iterdir()}
    assert [path.name for path in (tmp_path / "checkpoint").iterdir() if path.name != "blocks"] == ["step_110"]
    assert {name for name in after if before.get(name) != after[name]} == set(after) - set(before)
    assert 0 < len(set(after) - set(before)) < len(after) / 2
    loaded = SAC.load(folder / "model.zip")
    restore_buffer(loaded, folder)
    assert same_buffer(model.replay_buffer, loaded.replay_buffer)


def test_a_checkpoint_that_was_being_written_is_not_taken_up(tmp_path, monkeypatch):
    model = model_with(20)
    whole = save_checkpoint(model, tmp_path, "Pendulum-v1")
    model.learn(10, reset_num_timesteps=False)
    for name in ("_write_buffer", "get_rng_state"):
        monkeypatch.setattr(checkpoints, name, lambda *_: (_ for _ in ()).throw(OSError("killed here")))
        with pytest.raises(OSError, match="killed here"):
            save_checkpoint(model, tmp_path, "Pendulum-v1")
        monkeypatch.undo()
        assert latest_checkpoint(tmp_path) == whole
        restore_buffer(SAC.load(whole / "model.zip"), whole)
    assert save_checkpoint(model, tmp_path, "Pendulum-v1").name == "step_30"
    assert sorted(path.name for path in (tmp_path / "checkpoint").iterdir()) == ["blocks", "step_30"]


def assert_finished(run):
    """As an uninterrupted run of the same settings ends."""
    files = {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file() and "tb/" not in str(path)}
    models = {f"rl_model_{step}_steps.zip" for step in range(50, N_STEPS, 50)}
    settings = {f"Pendulum-v1/{name}" for name in ("args.yml", "config.yml", "command.txt")}
    others = {"0.monitor.csv", "Pendulum-v1.zip", "best_model.zip", "evaluations.npz", "replay_buffer.pkl"}
    assert files - {".lock", ".origin"} == models | settings | others
    model = load_model(run / "Pendulum-v1.zip")
    assert model.num_timesteps == N_STEPS and model._n_updates == N_STEPS - 50
    for network in (model.actor, model.critic):
        assert {state["step"].item() for state in network.optimizer.state.values()} == {N_STEPS - 50}
    lengths = [int(row.split(",")[1]) for row in (run / "0.monitor.csv").read_text().splitlines()[2:]]
    assert set(lengths) <= {200} and sum(lengths) <= N_STEPS
    with np.load(run / "evaluations.npz") as file:
        assert file["timesteps"].tolist() == EVALUATED
        assert (np.diff(file["wall_clock_s"]) > 0).all()
    with open(run / "replay_buffer.pkl", "rb") as file:
        buffer = pickle.load(file)
    assert buffer.full and buffer.pos == N_STEPS % 500
    cos, sin, speed = buffer.observations[:, 0].T
    cost = np.arctan2(sin, cos) ** 2 + 0.1 * speed**2 + 0.001 * (2 * buffer.actions[:, 0, 0]) ** 2
    assert np.allclose(buffer.rewards[:, 0], -cost, atol=1e-3)
    # Each observation is followed by the next one, but where an episode or a process ended.
    follows = (buffer.next_observations[:-1] == buffer.observations[1:]).all(axis=(1, 2))
    assert follows.mean() > 0.9
    args = yaml.safe_load((run / "Pendulum-v1" / "args.yml").read_text())
    assert args["seed"] == 1 and args["resume"] is None and args["trained_agent"] == ""


def kill_during(command, run, past_step, delay, within=math.inf):
    """
    Start a command and kill it some time after it has a checkpoint past a step, at the latest within some seconds; True if it
    was still running.
    """
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    last_moment = time.monotonic() + within
    while process.poll() is None:
        folder = latest_checkpoint(run)
        is_past = folder is not None and int(folder.name.removeprefix("step_")) > past_step
        if is_past or time.monotonic() > last_moment:
            time.sleep(delay if is_past else 0)
            process.send_signal(signal.SIGKILL)
            break
        time.sleep(0.01)
    process.wait()
    assert process.returncode in (0, -signal.SIGKILL), process.stderr.read().decode()
    return process.returncode != 0


def kill_and_finish(folder, n_kills, rng):
    """Two of three kills hit the training some way on, the third a process that starts, loads or trains."""
    run = folder / "sac" / "Pendulum-v1_1"
    command = [sys.executable, "train.py", *FLAGS, *OFTEN, "-f", str(folder), *SMALL]
    for n in range(n_kills):
        past_step = n * N_STEPS // (n_kills + 2)
        within = rng.uniform(0, 8) if n % 3 == 2 else math.inf
        assert kill_during(command, run, past_step, rng.uniform(0, 0.3), within), "it ended too early"
        command = [sys.executable, "train.py", "--resume", str(run)]
    # In this process: it starts faster.
    assert main(["--resume", str(run)]) == 0
    return run


def test_a_killed_run_ends_like_an_uninterrupted_one(tmp_path):
    assert_finished(kill_and_finish(tmp_path, 1, random.Random(0)))


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_a_run_killed_at_thirty_random_moments_ends_like_an_uninterrupted_one(tmp_path):
    assert main([*FLAGS, *OFTEN, "-f", str(tmp_path / "whole"), *SMALL]) == 0
    whole = tmp_path / "whole" / "sac" / "Pendulum-v1_1"
    assert_finished(whole)
    killed = kill_and_finish(tmp_path / "killed", 30, random.Random(1))
    assert_finished(killed)
    with np.load(whole / "evaluations.npz") as first, np.load(killed / "evaluations.npz") as second:
        assert {name: first[name].shape for name in first} == {name: second[name].shape for name in second}


@pytest.mark.slow
def test_a_killed_run_ends_bit_for_bit_as_one_that_was_stopped_at_its_last_checkpoint(tmp_path, monkeypatch):
    """Whatever the kill destroyed, and however often it is resumed."""
    flags = [*FLAGS, "-n", "330", "--save-freq", "150", "--eval-freq", "110", "--eval-episodes", "1", "--save-replay-buffer"]

    def end_at(step, how):
        def end(callback):
            if callback.num_timesteps == step:
                how(callback)
            return True

        return end

    def kill(callback):
        raise RuntimeError("killed")

    def stop(callback):
        callback.stop_requested = True

    runs = {}
    for name, step, how in (("killed", 222, kill), ("stopped", 150, stop)):
        with monkeypatch.context() as patch:
            patch.setattr("sb3_por.training.experiment.CheckpointCallback._on_step", end_at(step, how))
            command = [*flags, "-f", str(tmp_path / name), *SMALL]
            if how is kill:
                with pytest.raises(RuntimeError, match="killed"):
                    main(command)
            else:
                assert main(command) == 130
        runs[name] = tmp_path / name / "sac" / "Pendulum-v1_1"
        assert latest_checkpoint(runs[name]).name == "step_150"
    runs["copy"] = tmp_path / "copy" / "Pendulum-v1_1"
    shutil.copytree(runs["killed"], runs["copy"])
    for run in runs.values():
        assert main(["--resume", str(run)]) == 0
    expected = load_model(runs["stopped"] / "Pendulum-v1.zip").policy.state_dict()
    buffers = [pickle.loads((run / "replay_buffer.pkl").read_bytes()) for run in runs.values()]
    for run, buffer in zip(runs.values(), buffers, strict=True):
        weights = load_model(run / "Pendulum-v1.zip").policy.state_dict()
        assert all(th.equal(value, expected[name]) for name, value in weights.items()), run
        assert same_buffer(buffer, buffers[0])
        with np.load(run / "evaluations.npz") as first, np.load(runs["stopped"] / "evaluations.npz") as second:
            assert all(np.array_equal(first[name], second[name], True) for name in first if name != "wall_clock_s")


def test_a_resumed_run_forgets_the_episodes_that_it_plays_again_and_removes_half_a_file(tmp_path, monkeypatch):
    with killed_at(220):
        main([*FLAGS, "-n", "360", "--save-freq", "150", "--eval-freq", "300", "-f", str(tmp_path), *SMALL])
    run = tmp_path / "sac" / "Pendulum-v1_1"
    monitor = run / "0.monitor.csv"
    with open(monitor, "a") as file:
        file.write("-900.1,2")  # a row that a kill cut
    assert len(monitor.read_text().splitlines()) == 4
    with pytest.raises(SystemExit), monkeypatch.context() as patch:
        with atomic_write(run / "rl_model_150_steps.zip") as unfinished:
            unfinished.touch()
            patch.setattr(Path, "unlink", lambda *_, **__: None)  # as after a kill
            raise SystemExit
    assert unfinished.exists()
    seconds = run / "checkpoint" / "step_150" / "seconds.json"
    assert float(seconds.read_text()) > 0
    seconds.write_text("1000.0")
    assert main(["--resume", str(run)]) == 0
    with np.load(run / "evaluations.npz") as file:
        assert 1000 < file["wall_clock_s"][0] < 2000, "the run took 1000 s before"
    rows = monitor.read_text().splitlines()[2:]
    assert len(rows) == 1 and rows[0].split(",")[1] == "200", "the episode of steps 150 to 350"
    assert not unfinished.exists()


def test_a_kill_while_checkpoints_are_removed_leaves_a_finished_run(tmp_path, monkeypatch, capsys):
    assert main([*FLAGS, "-n", "60", "--eval-freq", "-1", "-f", str(tmp_path), *SMALL]) == 0
    run = tmp_path / "sac" / "Pendulum-v1_1"
    save_checkpoint(load_model(run / "Pendulum-v1.zip"), run, "Pendulum-v1")
    with monkeypatch.context() as patch:
        patch.setattr("shutil.rmtree", lambda *_, **__: (_ for _ in ()).throw(OSError("killed here")))
        with pytest.raises(OSError, match="killed here"):
            remove_checkpoints(run)
    assert (run / "checkpoint").exists() and latest_checkpoint(run) is None
    for folder in (run, tmp_path):  # or one with a single run in it
        with pytest.raises(SystemExit) as exit:
            main(["--resume", str(folder)])
        assert exit.value.code == 0 and f"{run} is finished: nothing to do" in capsys.readouterr().out
    assert not (run / "checkpoint").exists()


def test_a_run_killed_before_its_first_checkpoint_begins_again_in_its_folder(tmp_path):
    class Dies(BaseCallback):
        def _on_step(self):
            raise RuntimeError("killed")

    flags = ["-n", "60", "--eval-freq", "-1", "-f", str(tmp_path)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sb3_por.training.experiment.CheckpointCallback._on_step", Dies._on_step)
        with pytest.raises(RuntimeError, match="killed"):
            main([*FLAGS, *flags, *SMALL])
    run = tmp_path / "sac" / "Pendulum-v1_1"
    assert latest_checkpoint(run) is None
    assert main(["--resume", str(run), "-params", "batch_size:8"]) == 0
    model = load_model(run / "Pendulum-v1.zip")
    assert model.num_timesteps == 60 and model.batch_size == 8 and model.learning_starts == 50
    assert yaml.safe_load((run / "Pendulum-v1" / "config.yml").read_text())["batch_size"] == 8
    assert [path.name for path in (tmp_path / "sac").iterdir()] == ["Pendulum-v1_1"]


def test_resume_of_what_is_finished_no_run_or_in_use_is_said(tmp_path, capsys):
    assert main(["--resume", str(tmp_path)]) == 2
    assert "is not the folder of a run" in capsys.readouterr().err
    flags = ["-n", "20", "--eval-freq", "-1", "-f", str(tmp_path)]
    assert main([*FLAGS, *flags, *SMALL]) == 0
    run = tmp_path / "sac" / "Pendulum-v1_1"
    for folder in (run, tmp_path):  # or one with a single run in it
        with pytest.raises(SystemExit) as exit:
            main(["--resume", str(folder)])
        assert exit.value.code == 0 and f"{run} is finished: nothing to do" in capsys.readouterr().out
    os.remove(run / "Pendulum-v1.zip")
    script = "import filelock, sys; lock = filelock.FileLock(sys.argv[1]); lock.acquire(); print(1, flush=True); input()"
    holder = subprocess.Popen([sys.executable, "-c", script, run / ".lock"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    holder.stdout.readline()
    assert main(["--resume", str(run)]) == 2
    assert "another process is at work in" in capsys.readouterr().err
    holder.communicate(b"\n")
    assert (run / "Pendulum-v1" / "args.yml").exists()


def test_a_run_that_began_with_a_model_is_resumed_without_that_model(tmp_path, capsys):
    brief = ["--eval-freq", "-1", "--save-freq", "20"]
    assert main([*FLAGS, *brief, "-n", "30", "-f", str(tmp_path / "first"), *SMALL]) == 0
    start = tmp_path / "first" / "sac" / "Pendulum-v1_1" / "Pendulum-v1.zip"

    with killed_at(55):
        main([*FLAGS, *brief, "-n", "100", "-i", str(start), "-f", str(tmp_path / "second"), *SMALL])
    run = tmp_path / "second" / "sac" / "Pendulum-v1_1"
    assert main(["--resume", str(run), "-i", str(start)]) == 2
    assert "--resume continues a run with its own model; leave out -i" in capsys.readouterr().err
    start.unlink()
    assert main(["--resume", str(run), "-n", "60"]) == 0  # fewer than it was to have
    assert load_model(run / "Pendulum-v1.zip").num_timesteps == 60
    lengths = [int(row.split(",")[1]) for row in (run / "0.monitor.csv").read_text().splitlines()[2:]]
    assert sum(lengths) <= 60

    shutil.rmtree(run / "checkpoint", ignore_errors=True)
    (run / "Pendulum-v1.zip").unlink()
    arguments = yaml.safe_load((run / "Pendulum-v1" / "args.yml").read_text()) | {"trained_agent": str(start)}
    (run / "Pendulum-v1" / "args.yml").write_text(yaml.safe_dump(arguments))
    assert main(["--resume", str(run)]) == 2
    assert f"has no checkpoint yet, and {start}, which it began with, is gone" in capsys.readouterr().err
    assert main(["--resume", ""]) == 2
    assert "--resume needs the name of a run's folder" in capsys.readouterr().err


def test_checkpoints_of_a_process_at_work_are_left_alone(tmp_path, monkeypatch):
    assert main([*FLAGS, "-n", "20", "--eval-freq", "-1", "-f", str(tmp_path), *SMALL]) == 0
    run = tmp_path / "sac" / "Pendulum-v1_1"
    written = run / "checkpoint" / ".new"
    written.mkdir(parents=True)
    monkeypatch.setattr("sb3_por.training.arguments.is_locked", lambda folder: folder == run)
    with pytest.raises(SystemExit):
        main(["--resume", str(run)])
    assert written.exists()
    monkeypatch.undo()
    with pytest.raises(SystemExit):
        main(["--resume", str(run)])
    assert not written.exists()


@pytest.mark.parametrize("keeps_buffer", [True, False])
def test_a_finished_run_is_extended_in_its_folder(keeps_buffer, tmp_path, capsys, monkeypatch):
    flags = ["-n", "60", "--eval-freq", "60", "--eval-episodes", "1", "-f", str(tmp_path)]
    assert main([*FLAGS, *flags, *(["--save-replay-buffer"] if keeps_buffer else []), *SMALL]) == 0
    run = tmp_path / "sac" / "Pendulum-v1_1"
    with pytest.raises(SystemExit) as exit:
        main(["--resume", str(run), "-n", "60"])
    assert exit.value.code == 0 and "Pass -n with more than its 60 steps" in capsys.readouterr().out
    sizes = []
    with monkeypatch.context() as patch:

        def die(callback):
            sizes.append(callback.model.replay_buffer.size())
            raise RuntimeError("killed")

        patch.setattr("sb3_por.training.experiment.CheckpointCallback._on_step", die)
        with pytest.raises(RuntimeError, match="killed"):
            main(["--resume", str(run), "-n", "90"])
    assert sizes == [60 if keeps_buffer else 0]
    assert ("has no replay_buffer.pkl" in capsys.readouterr().err) != keeps_buffer
    assert latest_checkpoint(run).name == "step_60", "an interrupted run from its first step on"
    assert main(["--resume", str(run)]) == 0
    assert load_model(run / "Pendulum-v1.zip").num_timesteps == 90
    with np.load(run / "evaluations.npz") as file:
        assert file["timesteps"].tolist() == [60, 90] and (np.diff(file["wall_clock_s"]) > 0).all()


def test_an_extension_that_is_interrupted_is_resumed_again(tmp_path):
    """Killed once after a checkpoint of its own and once before the next one, it ends like one that nobody has killed."""
    often = ["--save-freq", "50", "--eval-freq", "40", "--eval-episodes", "1", "--save-replay-buffer"]
    runs = []
    for name in ("whole", "killed"):
        assert main([*FLAGS, "-n", "60", *often, "-f", str(tmp_path / name), *SMALL]) == 0
        runs.append(tmp_path / name / "sac" / "Pendulum-v1_1")
    whole, killed = runs
    assert main(["--resume", str(whole), "-n", "230"]) == 0

    for step, more, checkpoint in ((130, ["-n", "230"], "step_100"), (145, [], "step_100"), (180, [], "step_150")):
        with killed_at(step):
            main(["--resume", str(killed), *more])
        assert latest_checkpoint(killed).name == checkpoint
        assert not is_finished(killed, "Pendulum-v1"), "the model of 60 steps is not the last one"
    assert main(["--resume", str(killed)]) == 0
    assert latest_checkpoint(killed) is None and is_finished(killed, "Pendulum-v1")
    for run in runs:
        model = load_model(run / "Pendulum-v1.zip")
        assert (model.num_timesteps, model._n_updates, model._total_timesteps) == (230, 230 - 50, 230)
        with np.load(run / "evaluations.npz") as file:
            assert file["timesteps"].tolist() == [40, 60, 80, 120, 160, 200, 230]
            assert (np.diff(file["wall_clock_s"]) > 0).all()
        with open(run / "replay_buffer.pkl", "rb") as file:
            assert pickle.load(file).pos == 230
        lengths = [int(row.split(",")[1]) for row in (run / "0.monitor.csv").read_text().splitlines()[2:]]
        assert sum(lengths) <= 230
    names = [{path.name for path in run.iterdir()} for run in runs]
    assert names[0] == names[1]


def test_a_resumed_run_that_cannot_begin_keeps_its_settings(tmp_path, capsys):
    flags = [
        "--algo",
        "sac_por",
        "--env",
        "FallingBall-v0",
        "-n",
        "30",
        "--seed",
        "1",
        "--eval-freq",
        "30",
        "--eval-episodes",
        "2",
    ]
    small = ["learning_starts:10", "buffer_size:60", "batch_size:8", "policy:MlpPolicy", "policy_kwargs:{}"]
    assert main([*flags, "--env-kwargs", "obs_type:state", "-f", str(tmp_path), "-params", *small]) == 0
    run = tmp_path / "sac_por" / "FallingBall-v0_1"
    before = {path: path.read_text() for path in run.glob("FallingBall-v0/*.yml")}
    for more, message in {
        ("--demos", "nosuch"): "demonstrations",  # that there are none, or what they need
        ("--env", "PourWater-v0"): "--resume continues sac_por on FallingBall-v0; leave out --env",
        ("--algo", "sac"): "leave out --algo",
    }.items():
        assert main(["--resume", str(run), "-n", "60", *more]) == 2
        assert message in capsys.readouterr().err
        assert {path: path.read_text() for path in run.glob("FallingBall-v0/*.yml")} == before
    assert main(["--resume", str(run), "-n", "60", "--eval-episodes", "3"]) == 2
    assert "resume with --eval-episodes 2" in capsys.readouterr().err
    assert main(["--resume", str(run), "-n", "60", "--eval-episodes", "2"]) == 0
