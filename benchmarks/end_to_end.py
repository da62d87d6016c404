"""
How many environment steps a second training makes, and what environments and learner would make alone.

    python benchmarks/end_to_end.py                                        sac_por on PourWater-v0, 64 pixels, batch 64
    python benchmarks/end_to_end.py --env FoldCloth-v0 --envs 2 --json     two worker processes

`env_steps_per_s` is random play in worker processes, `learner_steps_per_s` updates alone (one for each `--steps-per-update`
environment steps). `ratio` is what training reaches of the smaller of the two: 1 would be perfect overlap. All four are
measured in turn, again and again; of the rates the medians count, and of the ratios within a round, so that a machine that
is slower for a while slows both sides. PyTorch has one thread, so that the workers have the other core.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

import softbody_envs  # noqa: F401  registers the tasks
from sb3_por import SACPOR
from softbody_envs import ENV_IDS


def make_env(env_id: str, n_envs: int, image_size: int) -> VecEnv:
    """Worker processes, one an environment."""
    return SubprocVecEnv([lambda: gym.make(env_id, image_size=image_size)] * n_envs, start_method="forkserver")


def make_model(arguments: argparse.Namespace, overlap: bool) -> SACPOR:
    """A learner past its warm-up, with environments of its own."""
    model = SACPOR(
        "CnnPolicy",
        make_env(arguments.env, arguments.envs, arguments.image_size),
        learning_rate=5e-4,
        batch_size=arguments.batch,
        buffer_size=5000,
        learning_starts=200,
        train_freq=max(1, arguments.steps_per_update // arguments.envs),
        gradient_steps=1,
        reward_scale=4.0,
        overlap=overlap,
        seed=0,
    )
    return model.learn(300)


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """
    :return: a row of the four rates and the two ratios
    """
    env = make_env(arguments.env, arguments.envs, arguments.image_size)
    env.seed(0)
    env.reset()
    plain, overlapped = make_model(arguments, overlap=False), make_model(arguments, overlap=True)
    n_updates = arguments.steps // arguments.steps_per_update

    def play() -> None:
        for _ in range(arguments.steps // arguments.envs):
            env.step(np.random.uniform(-1, 1, (arguments.envs, *env.action_space.shape)))

    calls: dict[str, Callable[[], Any]] = {
        "env_steps_per_s": play,
        "learner_steps_per_s": lambda: plain.train(n_updates, arguments.batch),
        "steps_per_s": lambda: overlapped.learn(arguments.steps, reset_num_timesteps=False),
        "steps_per_s_without_overlap": lambda: plain.learn(arguments.steps, reset_num_timesteps=False),
    }
    rates: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(arguments.rounds):
        for name, call in calls.items():
            before = time.perf_counter()
            call()
            rates[name].append(arguments.steps / (time.perf_counter() - before))
    for vector in (env, plain.get_env(), overlapped.get_env()):
        vector.close()  # type: ignore[union-attr]
    bounds = [min(pair) for pair in zip(rates["env_steps_per_s"], rates["learner_steps_per_s"], strict=True)]

    def ratio(name: str) -> float:
        return round(statistics.median(rate / bound for rate, bound in zip(rates[name], bounds, strict=True)), 2)

    return {
        "env": arguments.env,
        "envs": arguments.envs,
        "image_size": arguments.image_size,
        "batch": arguments.batch,
        **{name: round(statistics.median(values), 1) for name, values in rates.items()},
        "ratio": ratio("steps_per_s"),
        "ratio_without_overlap": ratio("steps_per_s_without_overlap"),
    }


def main() -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON instead of lines")
    parser.add_argument("--env", choices=ENV_IDS, default="PourWater-v0", metavar="ENV")
    parser.add_argument("--envs", type=int, default=1, help="worker processes")
    parser.add_argument("--image-size", type=int, default=64, help="pixels")
    parser.add_argument("--batch", type=int, default=64, help="transitions per update")
    parser.add_argument("--steps-per-update", type=int, default=1, help="environment steps for each update")
    parser.add_argument("--steps", type=int, default=200, help="environment steps in a turn")
    parser.add_argument("--rounds", type=int, default=7, help="how often each has its turn")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    row = measure(arguments)
    print(json.dumps([row], indent=1) if arguments.json else "\n".join(f"{name:28s}{value}" for name, value in row.items()))


if __name__ == "__main__":
    main()
