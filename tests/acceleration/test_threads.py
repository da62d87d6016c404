"""A model computes with one thread unless the user says otherwise, which only a process of its own can show."""

import os
import subprocess
import sys

import pytest

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
