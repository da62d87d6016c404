"""
What stays the same, to the last bit, on another processor, with other threads and with other versions of PyTorch: physics and
images; weights do not. ``OTHER_TORCH`` names folders with other versions, as ``pip install --target`` writes them.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = """
import hashlib, json, os
import gymnasium as gym
import numpy as np
import torch as th
import softbody_envs
from sb3_por import SACPOR

th.set_num_threads(int(os.environ["THREADS"]))

def digest(arrays):
    sum_ = hashlib.blake2b()
    for array in arrays:
        sum_.update(np.ascontiguousarray(array).tobytes())
    return sum_.hexdigest()

found = {"torch": th.__version__}
for env_id in ("PourWater-v0", "StraightenRope-v0", "FoldCloth-v0"):
    env = gym.make(env_id, obs_type="dict", image_size=64)
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    seen = []
    for _ in range(30):
        observation, reward, *_ = env.step(env.action_space.sample())
        seen += [observation["state"], observation["image"], np.float64(reward)]
    found[env_id] = digest(seen)
env = gym.make("FallingBall-v0", image_size=40)
model = SACPOR("CnnPolicy", env, buffer_size=300, batch_size=32, learning_starts=60, seed=0).learn(90)
found["weights"] = digest(parameter.detach().numpy() for parameter in model.policy.parameters())
found["size"] = float(sum(parameter.detach().double().square().sum() for parameter in model.policy.parameters()))
print(json.dumps(found))
"""
#: Environment variables with which the numerical libraries compute as on another processor
PROCESSORS = {
    "PyTorch without AVX": {"ATEN_CPU_CAPABILITY": "default"},
    "oneDNN with SSE4.1": {"ONEDNN_MAX_CPU_ISA": "SSE41"},
    "MKL as anywhere": {"MKL_CBWR": "COMPATIBLE"},
    "NumPy without AVX": {"NPY_DISABLE_CPU_FEATURES": "AVX2,FMA3,AVX512F,AVX512CD,AVX512_SKX"},
}
#: Folders with other versions of PyTorch
TORCHES = [folder for folder in os.environ.get("OTHER_TORCH", "").split(os.pathsep) if folder]


def run(threads=1, **variables):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "THREADS": str(threads)} | variables
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def here():
    return run()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_same_run_on_this_machine_is_the_same(here):
    assert run() == here


def assert_alike(there, here):
    """Physics and images are equal, and weights nearly."""
    assert all(there[name] == here[name] for name in here if name.endswith("-v0"))
    assert there["size"] == pytest.approx(here["size"], rel=1e-3)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("processor", PROCESSORS)
def test_on_another_processor_physics_and_images_are_the_same_and_weights_nearly(processor, here):
    assert_alike(run(**PROCESSORS[processor]), here)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_with_two_threads_physics_and_images_are_the_same_and_weights_nearly(here):
    assert_alike(run(threads=2), here)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.skipif(not TORCHES, reason="OTHER_TORCH names no folder with another version of PyTorch")
@pytest.mark.parametrize("folder", TORCHES)
def test_with_another_pytorch_physics_and_images_are_the_same_and_weights_nearly(folder, here):
    there = run(PYTHONPATH=os.pathsep.join([str(ROOT), folder]))
    assert there["torch"] != here["torch"]
    assert_alike(there, here)
