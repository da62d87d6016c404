"""
Does the classifier read time, or which encoder it looks at? Trains SACPOR with both pairings where the answer is known.

    python benchmarks/leak.py -o results/leak            trains (resumable: finished runs are skipped) and draws
    python benchmarks/leak.py -o results/leak --plot     draws from the committed table

`iid` shows noise without any time, `SwingingBall-v0` a reversible motion, `FallingBall-v0` one that gives its direction
away in every pair of frames, `PourWater-v0` the task. Where nothing leaks, the loss on pairs of one frame with itself
(k = 0) stays at ln 2 = 0.693 and the accuracy at 1/2.
"""

import argparse
import csv
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from stable_baselines3.common.callbacks import BaseCallback

import softbody_envs  # noqa: F401  (registers its ids)
from sb3_por import SACPOR

ENVS = ("iid", "SwingingBall-v0", "FallingBall-v0", "PourWater-v0")
PAIRINGS = ("paper", "swap")
METRICS = ("por_loss", "por_accuracy", "por_leak_loss", "por_leak_accuracy")
COLUMNS = ("env", "pairing", "seed", "update", *METRICS)
#: Updates between two rows of the table; each is a mean over them.
INTERVAL = 100


class IidFrames(gym.Env):
    """Images of independent noise, larger than a pixel: no frame tells anything of another."""

    def __init__(self, image_size: int = 64) -> None:
        self.observation_space = gym.spaces.Box(0, 255, (image_size, image_size, 3), np.uint8)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def _frame(self) -> np.ndarray:
        coarse = self.np_random.integers(0, 256, (8, 8, 3), dtype=np.uint8)
        return np.kron(coarse, np.ones((8, 8, 1), np.uint8))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return self._frame(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return self._frame(), float(self.np_random.normal()), False, False, {}


class Record(BaseCallback):
    """Keeps the mean of the objective's metrics over each interval of updates."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[float, ...]] = []
        self._since: list[list[float]] = []

    def _on_step(self) -> bool:
        updates = self.model._n_updates
        if updates > 0:
            # The control is measured every few updates; its last value stands until the next.
            self._since.append([self.logger.name_to_value.get(f"train/{name}", np.nan) for name in METRICS])
            if updates % INTERVAL == 0:
                self.rows.append((updates, *np.nanmean(self._since, axis=0).tolist()))
                self._since.clear()
        return True


def train(env_id: str, pairing: str, seed: int, n_updates: int) -> list[tuple[float, ...]]:
    """
    :return: rows of update, por_loss, por_accuracy, por_leak_loss, por_leak_accuracy
    """
    if env_id == "iid":
        env: gym.Env = gym.wrappers.TimeLimit(IidFrames(), 100)
    else:
        env = gym.make(env_id, image_size=64)
    model = SACPOR(
        "CnnPolicy",
        env,
        learning_rate=5e-4,
        batch_size=64,
        buffer_size=20_000,
        learning_starts=1000,
        reward_scale=4.0,
        por_coef=0.1,
        pairing=pairing,
        diagnostics_interval=20,
        seed=seed,
    )
    record = Record()
    model.learn(1000 + n_updates, callback=record, log_interval=10**9)
    env.close()
    return record.rows


def draw(table: pd.DataFrame, path: Path) -> None:
    """One column an environment: accuracy on real pairs above, the k = 0 control below."""
    envs = [env for env in ENVS if env in set(table["env"])]
    figure = Figure(figsize=(3 * len(envs), 5), layout="constrained")
    axes = figure.subplots(2, len(envs), sharex=True, squeeze=False)
    for column, env in enumerate(envs):
        for row, (metric, chance) in enumerate((("por_accuracy", 0.5), ("por_leak_loss", np.log(2)))):
            axis = axes[row, column]
            axis.axhline(chance, color="0.6", lw=1)
            for pairing, color, style in zip(PAIRINGS, ("#D55E00", "#0072B2"), ("--", "-"), strict=True):
                for _, run in table[(table["env"] == env) & (table["pairing"] == pairing)].groupby("seed"):
                    axis.plot(run["update"], run[metric], style, color=color, label=pairing)
            axis.set_ylim((0.4, 1.02) if row == 0 else (0, 0.9))
            axis.set_title(env if row == 0 else "")
    axes[0, 0].set_ylabel("accuracy, real pairs")
    axes[1, 0].set_ylabel("loss, k = 0 control (chance ln 2)")
    for axis in axes[1]:
        axis.set_xlabel("updates")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    axes[0, 0].legend(unique.values(), unique.keys(), title="pairing", frameon=False)
    figure.savefig(path, dpi=150)


def main() -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("results/leak"))
    parser.add_argument("--updates", type=int, default=2500)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--envs", nargs="+", default=ENVS, choices=ENVS)
    parser.add_argument("--plot", action="store_true", help="only draw")
    arguments = parser.parse_args()
    matplotlib.use("Agg")
    arguments.output.mkdir(parents=True, exist_ok=True)
    path = arguments.output / "leak.csv"
    if not path.exists():
        path.write_text(",".join(COLUMNS) + "\n")
    for seed in range(arguments.seeds):
        for env_id in () if arguments.plot else arguments.envs:
            for pairing in PAIRINGS:
                done = pd.read_csv(path)
                if ((done["env"] == env_id) & (done["pairing"] == pairing) & (done["seed"] == seed)).any():
                    continue
                rows = train(env_id, pairing, seed, arguments.updates)
                with path.open("a", newline="") as file:
                    csv.writer(file).writerows((env_id, pairing, seed, *(round(x, 5) for x in row)) for row in rows)
                print(env_id, pairing, seed, dict(zip(("update", *METRICS), rows[-1], strict=True)), flush=True)
    draw(pd.read_csv(path), arguments.output / "leak.png")


if __name__ == "__main__":
    main()
