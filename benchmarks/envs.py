"""
How fast the tasks are on one core, and how that grows with worker processes.

    python benchmarks/envs.py                                 every task, observation type and image size: a table
    python benchmarks/envs.py --json                          the same as JSON
    python benchmarks/envs.py --envs FoldCloth-v0 --sizes 84  some of it
    python benchmarks/envs.py --workers 1 2 4                 control steps/s of several processes together

`steps_per_s` is by the clock, `steps_per_cpu_s` by the time that the process had a core: on a machine that does other
things, too, the second is closer to the truth.
"""

import argparse
import json
import time
from typing import Any

import gymnasium as gym
import numpy as np

from softbody_envs import ENV_IDS
from softbody_envs.env import OBS_TYPES

SIZES = (64, 84, 128)
#: Control steps that are timed, and resets.
N_STEPS = 150
N_RESETS = 10


def measure(env_id: str, obs_type: str, image_size: int, n_steps: int) -> dict[str, Any]:
    """
    Time random play and resets in this process, apart from each other.

    :return: control steps per second of the clock and of the processor's time, and seconds a reset takes
    """
    env = gym.make(env_id, obs_type=obs_type, image_size=image_size)
    env.action_space.seed(0)
    env.reset(seed=0)
    wall = cpu = 0.0
    for _ in range(n_steps):
        action = env.action_space.sample()
        wall_before, cpu_before = time.perf_counter(), time.process_time()
        truncated = env.step(action)[3]
        wall, cpu = wall + time.perf_counter() - wall_before, cpu + time.process_time() - cpu_before
        if truncated:
            env.reset()
    before = time.perf_counter()
    for _ in range(N_RESETS):
        env.reset()
    reset_s = (time.perf_counter() - before) / N_RESETS
    env.close()
    return {
        "env": env_id,
        "obs_type": obs_type,
        "image_size": image_size if obs_type != "state" else None,
        "steps_per_s": round(n_steps / wall, 1),
        "steps_per_cpu_s": round(n_steps / cpu, 1),
        "reset_s": round(reset_s, 4),
    }


def measure_workers(env_id: str, image_size: int, n_workers: int, n_steps: int) -> dict[str, Any]:
    """
    Time random play in several processes, resets included.

    :return: control steps per second of the clock, all processes together
    """
    vector = gym.make_vec(env_id, num_envs=n_workers, vectorization_mode="async", image_size=image_size)
    vector.action_space.seed(0)
    vector.reset(seed=0)
    actions = [vector.action_space.sample() for _ in range(n_steps)]
    before = time.perf_counter()
    for action in actions:
        vector.step(action)
    wall = time.perf_counter() - before
    vector.close()
    return {
        "env": env_id,
        "obs_type": "pixels",
        "image_size": image_size,
        "workers": n_workers,
        "steps_per_s": round(n_workers * n_steps / wall, 1),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as text in columns."""
    cells = [list(rows[0]), *([str("" if value is None else value) for value in row.values()] for row in rows)]
    widths = np.array([[len(cell) for cell in line] for line in cells]).max(axis=0)
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in cells)


def main() -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--envs", nargs="+", default=ENV_IDS, choices=ENV_IDS, metavar="ENV")
    parser.add_argument("--obs-types", nargs="+", default=OBS_TYPES, choices=OBS_TYPES)
    parser.add_argument("--sizes", nargs="+", type=int, default=SIZES, help="of images, pixels")
    parser.add_argument("--steps", type=int, default=N_STEPS, help="control steps to time")
    parser.add_argument("--workers", nargs="+", type=int, help="measure so many processes together instead")
    arguments = parser.parse_args()
    if arguments.workers:
        rows = [
            measure_workers(env_id, arguments.sizes[0], n, arguments.steps)
            for env_id in arguments.envs
            for n in arguments.workers
        ]
    else:
        rows = [
            measure(env_id, obs_type, size, arguments.steps)
            for env_id in arguments.envs
            for obs_type in arguments.obs_types
            for size in (arguments.sizes[:1] if obs_type == "state" else arguments.sizes)
        ]
    print(json.dumps(rows, indent=1) if arguments.json else table(rows))


if __name__ == "__main__":
    main()
