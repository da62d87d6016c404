"""
What a checkpoint of a full replay buffer costs, the first one and later ones.

    python benchmarks/checkpoints.py                    20 000 frames of random pouring, 64 pixels: 4 minutes
    python benchmarks/checkpoints.py --frames 2000 --json

Each row: the environment steps since the last checkpoint, the seconds that this one took, the MB that it wrote, and the MB
that the folder of checkpoints has then.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import gymnasium as gym

import softbody_envs  # noqa: F401  registers the tasks
from sb3_por import SACPOR
from sb3_por.runs.checkpoints import save_checkpoint

ENV_ID = "PourWater-v0"
#: Environment steps between the checkpoints after the first.
LATER = (500, 2000)


def sizes(folder: Path) -> dict[Path, int]:
    """Bytes of each file in a folder and below."""
    return {file: file.stat().st_size for file in folder.rglob("*") if file.is_file()}


def measure(n_frames: int) -> list[dict[str, float]]:
    """
    :param n_frames: size of the replay buffer, which is full at the first checkpoint
    :return: a row for each checkpoint
    """
    model = SACPOR("CnnPolicy", gym.make(ENV_ID), buffer_size=n_frames, learning_starts=10 * n_frames, seed=0)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for n_steps in (n_frames, *LATER):
            model.learn(n_steps, reset_num_timesteps=False)
            before = sizes(Path(folder))
            start = time.perf_counter()
            save_checkpoint(model, Path(folder), ENV_ID)
            seconds = time.perf_counter() - start
            after = sizes(Path(folder))
            written = sum(size for file, size in after.items() if file not in before)
            rows.append(dict(steps=n_steps, seconds=seconds, mb_written=written / 1e6, mb_on_disk=sum(after.values()) / 1e6))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=20_000, help="size of the replay buffer")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    rows = measure(arguments.frames)
    if arguments.json:
        print(json.dumps(rows))
        return
    print("  steps  seconds  MB written  MB on disk")
    for row in rows:
        print(f"{row['steps']:7d}  {row['seconds']:7.2f}  {row['mb_written']:10.1f}  {row['mb_on_disk']:10.1f}")


if __name__ == "__main__":
    main()
