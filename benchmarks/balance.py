"""
Follow the two gradients at the encoder under fixed and balanced weights of POR, on the same frames.

    python benchmarks/balance.py -o results/balance    1000 updates for each weight, about ten minutes on one core

The frames are 50 random episodes of pouring with the settings of suites/fair.yml (actions held for ten control steps, progress
as the reward). No agent acts: this measures who trains the encoder, not what is learned with it.
"""

import argparse
import csv
from pathlib import Path

import gymnasium as gym
import yaml
from stable_baselines3.common.logger import Logger

import softbody_envs  # noqa: F401  (registers its ids)
from sb3_por import SACPOR
from softbody_envs.wrappers import ActionRepeat, ProgressReward

ENV = "PourWater-v0"
SETTINGS = Path(__file__).parents[1] / "zoo_hyperparams" / "sac_por.yml"
COEFS: tuple[str | float, ...] = (0.0, 1.0, 100.0, "auto_0.1", "auto_0.3")
#: Updates between two rows of the table; each is a mean over them
INTERVAL = 50
COLUMNS = ("por_coef", "seed", "update", "weight", "grad_norm_critic", "grad_norm_por", "cosine", "loss", "accuracy")
METRICS = (
    *("por_coef", "encoder_grad_norm_critic", "encoder_grad_norm_por", "encoder_grad_cosine"),
    *("por_loss", "por_accuracy"),
)


def make_model(env: gym.Env, por_coef: str | float, seed: int, n_frames: int) -> SACPOR:
    """
    :return: A model with the settings of ``zoo_hyperparams/sac_por.yml``, without a frame
    """
    of_run = {"n_timesteps", "env_kwargs", "env_wrapper", "gradient_steps"}
    settings = {name: value for name, value in yaml.safe_load(SETTINGS.read_text())[ENV].items() if name not in of_run}
    settings |= {"por_coef": por_coef, "buffer_size": n_frames, "learning_starts": n_frames, "diagnostics_interval": 5}
    return SACPOR(env=env, seed=seed, device="cpu", **settings)


def follow(model: SACPOR, n_updates: int) -> list[tuple[float, ...]]:
    """
    :return: Rows of update and the ``METRICS``
    """
    rows = []
    for update in range(INTERVAL, n_updates + 1, INTERVAL):
        model.train(INTERVAL, model.batch_size)
        logged = model.logger.name_to_value
        rows.append((update, *(logged[f"train/{name}"] for name in METRICS)))
        model.logger.dump()
    return rows


def main() -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("results/balance"))
    parser.add_argument("--updates", type=int, default=1000)
    parser.add_argument("--frames", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--image-size", type=int, default=64)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    env = ProgressReward(ActionRepeat(gym.make(ENV, image_size=arguments.image_size), repeat=10, scale=0.7))
    played = make_model(env, 0.0, arguments.seed, arguments.frames).learn(arguments.frames)
    rows = []
    for coef in COEFS:
        model = make_model(env, coef, arguments.seed, arguments.frames)
        model.replay_buffer = played.replay_buffer
        model.set_logger(Logger(folder=None, output_formats=[]))
        rows += [
            (coef, arguments.seed, update, *(f"{value:.5g}" for value in values))
            for update, *values in follow(model, arguments.updates)
        ]
        print(dict(zip(COLUMNS, rows[-1], strict=True)), flush=True)
    env.close()
    with (arguments.output / "balance.csv").open("w", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *rows])


if __name__ == "__main__":
    main()
