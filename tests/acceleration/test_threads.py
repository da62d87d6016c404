"""A model computes with one thread unless the user says otherwise, which only a process of its own can show."""

import os
import subprocess
import sys

import pytest

CORES = str(os.cpu_count())
BUILD = """
import gymnasium as gym
import torch as th
from sb3_por import SACPOR
{before}
model = SACPOR("MlpPolicy", "Pendulum-v1", buffer_size=10, device="cpu")
{after}
SACPOR("MlpPolicy", "Pendulum-v1", buffer_size=10, device="cpu")
print(th.get_num_threads())
"""


@pytest.mark.skipif(os.cpu_count() == 1, reason="one thread is the default of one core")
@pytest.mark.parametrize(
    ("before", "after", "environment", "expected"),
    [
        ("", "", {}, 1),
        ("th.set_num_threads(3)", "", {}, 3),
        ("", "th.set_num_threads(2)", {}, 2),
        ("", "", {"OMP_NUM_THREADS": "2"}, 2),
    ],
)
def test_number_of_threads(before, after, environment, expected):
    clean = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    command = [sys.executable, "-c", BUILD.format(before=before, after=after)]
    shown = subprocess.run(command, env=clean | environment, capture_output=True, text=True, check=True)
    assert shown.stdout.split()[-1] == str(expected)


@pytest.mark.parametrize(
    ("words", "environment", "expected"),
    [([], {}, "1"), (["--num-threads", CORES], {}, CORES), ([], {"OMP_NUM_THREADS": CORES}, CORES)],
)
def test_number_of_threads_of_a_run(words, environment, expected, tmp_path):
    script = "import sys, torch as th; from sb3_por.training.zoo import main; main(sys.argv[1:]); print(th.get_num_threads())"
    run = ["--algo", "sac", "--env", "Pendulum-v1", "-n", "1", "-f", str(tmp_path), "--eval-freq", "-1", *words]
    clean = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    command = [sys.executable, "-c", script, *run]
    shown = subprocess.run(command, env=clean | environment, capture_output=True, text=True, check=True)
    assert shown.stdout.split()[-1] == expected
