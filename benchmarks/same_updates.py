"""
Compare the weights of two versions of the learner, bit for bit, after the same 60 updates.

    python benchmarks/same_updates.py                           the hashes of this checkout
    python benchmarks/same_updates.py --against ../other        and those of another one, side by side

A hash covers every parameter, buffer and optimizer state. It depends on the processor and on PyTorch, so both versions
run here, each in a process of its own; the exit code is 1 if any hash differs.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer

from sb3_por import SACCURL, SACPOR, SACSPR, TQCPOR, SACDrQ, VisualSAC, VisualTQC

N_WARM_UP, N_UPDATES, BATCH_SIZE = 60, 60, 16


class DotEnv(gym.Env):
    """A bright dot that moves as the action says; episodes of 17 steps end by truncation, some earlier by termination."""

    def __init__(self, obs_type: str):
        self.obs_type = obs_type
        image, state = spaces.Box(0, 255, (20, 20, 3), np.uint8), spaces.Box(-1, 1, (2,), np.float32)
        goal = {"observation": state, "achieved_goal": state, "desired_goal": state}
        self.observation_space = {
            "pixels": image,
            "state": state,
            "dict": spaces.Dict({"image": image, "state": state}),
            "goal": spaces.Dict(goal),
        }[obs_type]
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.t = float(self.np_random.uniform()), 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.x, self.t = float(np.clip(self.x + 0.1 * float(action[0]), 0, 1)), self.t + 1
        return self._observe(), 1 - abs(self.x - 0.5), self.x == 1.0, self.t >= 17, {}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, _: Any) -> np.ndarray:
        return -np.linalg.norm(achieved - desired, axis=-1)

    def _observe(self) -> Any:
        image = np.zeros((20, 20, 3), np.uint8)
        image[self.t // 2 : self.t // 2 + 5, round(15 * self.x) : round(15 * self.x) + 5] = (255, 200, 100)
        state = np.array([2 * self.x - 1, self.t / 10 - 1], np.float32)
        goal = {"observation": state, "achieved_goal": state, "desired_goal": np.zeros(2, np.float32)}
        return {"pixels": image, "state": state, "dict": {"image": image, "state": state}, "goal": goal}[self.obs_type]


#: Name: class, observation type, and further arguments.
SETTINGS: dict[str, tuple[type[Any], str, dict[str, Any]]] = {
    "visual_sac": (VisualSAC, "pixels", {}),
    "visual_tqc": (VisualTQC, "pixels", {}),
    "sac_por": (SACPOR, "pixels", {"diagnostics_interval": 7}),
    "sac_por paper": (SACPOR, "pixels", {"pairing": "paper", "diagnostics_interval": 7}),
    "sac_por k": (SACPOR, "pixels", {"k": 4, "random_k": True, "order_head": "difference"}),
    "sac_por n-step": (SACPOR, "pixels", {"n_steps": 3, "order_head": "coordinatewise"}),
    "sac_por dict": (SACPOR, "dict", {}),
    "sac_por state": (SACPOR, "state", {}),
    "sac_por her": (SACPOR, "goal", {"replay_buffer_class": HerReplayBuffer}),
    "sac_por bfloat16": (SACPOR, "pixels", {"precision": "bfloat16"}),
    "sac_por own trunks": (SACPOR, "pixels", {"policy_kwargs": {"share_features_extractor": False}}),
    "sac_por settings": (
        SACPOR,
        "pixels",
        {"actor_update_interval": 2, "target_update_interval": 2, "start_at_mean_reward": True, "reward_scale": 3.0},
    ),
    "tqc_por": (TQCPOR, "pixels", {}),
    "sac_drq": (SACDrQ, "pixels", {}),
    "sac_drq 1 1": (SACDrQ, "pixels", {"n_augmentations": 1, "n_target_augmentations": 1}),
    "sac_curl": (SACCURL, "pixels", {"diagnostics_interval": 7}),
    "sac_spr": (SACSPR, "pixels", {"horizon": 3, "diagnostics_interval": 7}),
    "sac_spr gsde": (SACSPR, "pixels", {"horizon": 2, "use_sde": True}),
}


def train(name: str) -> Any:
    """A model of these settings after ``N_UPDATES`` updates."""
    algorithm, obs_type, options = SETTINGS[name]
    convolutions = {"n_filters": 4, "strides": (2, 2)} if obs_type in ("pixels", "dict") else {}
    arguments = {"buffer_size": 300, "learning_starts": N_WARM_UP, "batch_size": BATCH_SIZE, "seed": 0, "device": "cpu"}
    policy_kwargs = {"net_arch": [16], "features_extractor_kwargs": convolutions, **options.get("policy_kwargs", {})}
    policy = {"pixels": "CnnPolicy", "state": "MlpPolicy"}.get(obs_type, "MultiInputPolicy")
    env = gym.wrappers.TimeLimit(DotEnv(obs_type), 17)
    return algorithm(policy, env, **{**arguments, **options, "policy_kwargs": policy_kwargs}).learn(N_WARM_UP + N_UPDATES)


def digest(model: Any) -> str:
    """Hash of all parameters, buffers and optimizer states of a model."""
    hashed = hashlib.blake2b(digest_size=8)

    def update(value: Any) -> None:
        if isinstance(value, th.Tensor):
            hashed.update(value.detach().cpu().contiguous().numpy().tobytes())
        elif isinstance(value, dict):
            for key in sorted(value, key=str):
                hashed.update(str(key).encode())
                update(value[key])
        elif isinstance(value, list | tuple):
            for item in value:
                update(item)
        else:
            hashed.update(repr(value).encode())

    update(model.get_parameters())
    return hashed.hexdigest()


def measure() -> dict[str, str]:
    """Name of each setting: its hash."""
    th.set_num_threads(1)
    return {name: digest(train(name)) for name in SETTINGS}


def measure_other(checkout: str) -> dict[str, str]:
    """The hashes of another checkout, from a process of its own."""
    path = os.pathsep.join([str(Path(checkout).resolve()), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(Path(__file__).resolve()), "--json"]
    output = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, check=True, capture_output=True, text=True)
    return json.loads(output.stdout)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", metavar="CHECKOUT", help="another checkout of this project to compare with")
    parser.add_argument("--json", action="store_true", help="print JSON")
    args = parser.parse_args()
    here = measure()
    if args.json:
        print(json.dumps(here))
        return 0
    there = measure_other(args.against) if args.against else here
    for name, value in here.items():
        print(f"{name:20s} {value}  {'same' if there[name] == value else there[name]}")
    return int(here != there)


if __name__ == "__main__":
    sys.exit(main())
