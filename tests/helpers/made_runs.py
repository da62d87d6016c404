"""Runs and tables of scores made for tests."""

from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from torch.utils.tensorboard import SummaryWriter

from sb3_por.analysis.scores import COLUMNS

STEPS = [100, 200, 300]


def write_run(
    folder,
    algo="sac_por",
    env="PourWater-v0",
    seed=1,
    performance=(0.1, 0.2, 0.4),
    steps=STEPS,
    settings=True,
    label=None,
    arguments=(),
):
    """A run folder as train.py leaves it, two episodes an evaluation."""
    run = folder / algo / f"{env}_{seed}"
    (run / env).mkdir(parents=True)
    if settings:
        recorded = {"algo": algo, "env": env, "seed": seed, "commit": "abc", "label": label}
        (run / env / "args.yml").write_text(yaml.safe_dump(recorded | dict(arguments)))
    episodes = np.array(performance)[:, None] + np.array([-0.05, 0.05])
    np.savez(
        run / "evaluations.npz",
        timesteps=steps,
        results=episodes * 100,
        ep_lengths=np.full(episodes.shape, 100),
        successes=episodes > 0.3,
        normalized_performance=episodes,
        wall_clock_s=np.array(steps) / 10,
    )
    return run


def log_order(folder, losses, first_step=100, returns=()):
    """A TensorBoard file as a run of POR writes it, read after those that are there; with mean returns of its evaluations."""
    with SummaryWriter(folder, filename_suffix=".new") as writer:
        for step, mean_return in zip(STEPS, returns, strict=False):
            writer.add_scalar("eval/mean_reward", mean_return, step)
        for i, loss in enumerate(losses):
            writer.add_scalar("train/por_loss", loss, first_step + 100 * i)
            writer.add_scalar("train/por_accuracy", 1 - loss, first_step + 100 * i)
            writer.add_scalar("train/encoder_grad_norm_critic", 10.0, first_step + 100 * i)
            writer.add_scalar("train/encoder_grad_norm_por", loss, first_step + 100 * i)
            writer.add_scalar("train/por_coef", 2 * loss, first_step + 100 * i)
    # Files are read in the order of their names, which begin with the second: made within one second, 10 would come before 9
    (written,) = Path(folder).glob("*.new")
    written.rename(written.with_name(f"events.out.tfevents.{len(list(written.parent.iterdir())):010d}.made"))


def table(algo, env, seed, performance, steps=STEPS):
    """The rows of one run in a table of scores."""
    return pd.DataFrame(
        {"env": env, "algo": algo, "seed": seed, "step": steps, "normalized_performance": performance, "commit": ""},
        columns=COLUMNS,
    )


def random_scores(algos=("sac_por", "sac_drq", "sac"), envs=("T", "U"), n_seeds=4, steps=STEPS):
    """A full grid of random scores; those of the first algorithm are 0.3 higher."""
    rng = np.random.default_rng(0)
    runs = [(algo, env, seed) for algo in algos for env in envs for seed in range(n_seeds)]
    tables = [table(*run, 0.7 * rng.uniform(size=len(steps)) + 0.3 * (run[0] == algos[0]), steps) for run in runs]
    return pd.concat(tables, ignore_index=True)
