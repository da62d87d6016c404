"""The memory of a suite's runs is estimated from their settings, and too much of it is told before they start."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC

from sb3_por import SACPOR
from sb3_por.__main__ import main
from sb3_por.suites import memory
from sb3_por.suites.inputs import run_settings
from sb3_por.suites.memory import PROCESS, overcommitment, run_memory
from sb3_por.suites.suite_file import read_suite, suite_runs

GRID = """
algos: [sac_por]
envs: [FallingBall-v0]
seeds: [0, 1, 2, 3]
n_timesteps: 5000
workers: 3
hyperparams: {buffer_size: 3000, env_kwargs: {image_size: 40}}
"""


@pytest.fixture
def runs(tmp_path):
    def read(text=GRID):
        (tmp_path / "grid.yml").write_text(text)
        return suite_runs(read_suite(tmp_path / "grid.yml"), tmp_path)

    return read


def size_of(buffer):
    frames = [store.ring.nbytes for store in buffer._frames.values()] if hasattr(buffer, "_frames") else []
    return sum(value.nbytes for value in vars(buffer).values() if isinstance(value, np.ndarray)) + sum(frames)


def test_a_runs_memory_is_that_of_its_replay_buffer(runs):
    env = gym.make("FallingBall-v0", image_size=40)
    model = SACPOR("CnnPolicy", env, buffer_size=3000)
    assert run_memory(runs()[0]) - PROCESS == pytest.approx(size_of(model.replay_buffer), rel=0.05)
    of_sac = runs(GRID.replace("sac_por", "sac").replace("image_size: 40", "obs_type: pixels, image_size: 40"))[0]
    model = SAC("CnnPolicy", env, buffer_size=3000)
    assert run_memory(of_sac) - PROCESS == pytest.approx(size_of(model.replay_buffer), rel=0.05)


def test_the_buffer_never_holds_more_than_the_steps_of_the_run(runs):
    long, short = runs(), runs(GRID.replace("5000", "300"))
    assert (run_memory(long[0]) - PROCESS) == 10 * (run_memory(short[0]) - PROCESS)
    assert run_memory(runs(GRID.replace("sac_por", "ppo"))[0]) == PROCESS
    assert run_memory(runs(GRID.replace("image_size: 40", "no_such: 1"))[0]) == PROCESS


def test_a_setting_that_is_no_number_is_for_its_run_to_refuse(runs):
    whole = run_memory(runs(GRID.replace("buffer_size: 3000, ", ""))[0])
    assert run_memory(runs(GRID.replace("buffer_size: 3000", "buffer_size: null"))[0]) == whole
    assert run_memory(runs(GRID.replace("buffer_size: 3000", "frame_stack: '4'"))[0]) == whole


def test_with_demonstrations_the_settings_are_theirs(runs):
    text = GRID.replace("FallingBall-v0", "FoldCloth-v0").replace(
        "hyperparams: {buffer_size: 3000, env_kwargs: {image_size: 40}}", ""
    )
    of_demos = run_settings(runs(f"{text}demos: demos\n")[0])
    assert of_demos["bc_coef"] > 0 and "bc_coef" not in run_settings(runs(text)[0])


def test_runs_that_do_not_fit_together_are_told_before_they_start(runs, monkeypatch, tmp_path, capsys):
    all_runs = runs()
    one = run_memory(all_runs[0])
    for available, fitting in ((3.0, None), (2.9, 2), (0.5, 1)):
        monkeypatch.setattr(memory, "available_memory", lambda available=available: int(available * one) + 1)
        said = overcommitment(all_runs, 3)
        assert (said is None) == (fitting is None)
        assert said is None or f"3 runs at a time may take {3 * one / 2**30:.1f} GiB" in said
        assert said is None or f"set workers to {fitting}, or a smaller buffer_size" in said
    assert main(["suite", str(tmp_path / "grid.yml"), "--root", str(tmp_path), "--dry-run"]) == 0
    assert capsys.readouterr().err.startswith("note: 3 runs at a time may take ")
