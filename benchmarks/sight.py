"""
The ceiling of sight: how well could any agent act that sees these images? Clones the scripted expert, which sees the
state, into a network that sees images, and plays with the clone.

    python benchmarks/sight.py --env StraightenRope-v0 [-params KEY:VALUE ...] [--csv results/sight/scores.csv]

Images, actions, encoder, augmentation and symmetries are those of the settings for demonstrations
(``zoo_hyperparams/demos.yml``), so that only the learning differs from that of an agent.

DAgger (https://arxiv.org/abs/1011.0686): in each round after the first the clone plays new scenes together with the
expert, the expert labels every step with its action, and the clone learns from all steps so far. The data are enough when
more rounds do not help. After every second round the clone plays held-out scenes to their end; the expert's own score in
the same scenes, at its first attempt, stands beside it. ``--rounds 1`` is plain cloning, and ``--disturbed`` adds the
disturbances of ``python -m sb3_por record``.

The loss is the agents' own, the squared error of the action. Where an expert remembers what it has chosen, the mean of two
of its actions is neither, and the ceiling is low because of that.
"""

import argparse
import csv
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

import softbody_envs  # noqa: F401  registers the tasks
from sb3_por.runs.environment import TrainingEnvironment
from sb3_por.training.arguments import Settings
from sb3_por.training.hyperparameters import changed, hyperparameter_file, read_hyperparameters
from sb3_por.training.record import Recorder, environment_parts, make_training_env
from sb3_por.visual.augmentations import RandomShift
from sb3_por.visual.encoders import ConvEncoder
from sb3_por.visual.policies import with_layer_norm
from sb3_por.visual.symmetries import turned
from softbody_envs.experts import EXPERT_IDS, make_expert
from softbody_envs.experts.pace import Pace
from softbody_envs.variations import SPLITS

#: Number of steps after which the player of a training episode, expert or clone, is drawn again.
TURN = 5
#: Share of these turns that the clone plays, and standard deviations of the noise on the actions of an episode.
SHARE = 0.7
NOISE = (0.0, 0.2, 0.5)
#: Smallest factor of the learning rate, which falls in the last round.
LAST_RATE = 0.05


class Batch(NamedTuple):
    """Images, uint8 ``(batch, channels, size, size)``, and the expert's actions, ``(batch, action_size)``."""

    observations: th.Tensor
    actions: th.Tensor


class Clone(nn.Module):
    """
    The settings' encoder and two hidden layers with layer norm.

    :param channels: Channels of an observation
    :param size: Height and width of an image
    :param action_size: Number of elements of an action
    :param encoder_kwargs: Arguments of the encoder
    """

    def __init__(self, channels: int, size: int, action_size: int, encoder_kwargs: dict[str, Any]):
        super().__init__()
        self.encoder = ConvEncoder(spaces.Box(0, 255, (channels, size, size), np.uint8), **encoder_kwargs)
        self.projection = self.encoder.make_projection()
        hidden = nn.Sequential(
            nn.Linear(self.encoder.features_dim, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, action_size)
        )
        self.head = with_layer_norm(hidden)

    def forward(self, images: th.Tensor) -> th.Tensor:
        """
        :param images: uint8 ``(batch, channels, size, size)``
        :return: Actions, ``(batch, action_size)``
        """
        return self.head(self.projection(self.encoder(images.float() / 255))).tanh()


class Memory:
    """
    Steps of all episodes.

    :param n_frames: Number of frames of an observation; the first frame of an episode is repeated
    """

    def __init__(self, n_frames: int) -> None:
        self.n_frames = n_frames
        self.frames: list[np.ndarray] = []
        self.actions: list[np.ndarray] = []
        self.starts: list[int] = []  # first step of the episode of each step

    def add(self, image: np.ndarray, action: np.ndarray, first: bool) -> None:
        """Add a step, the first of an episode or a later one, with the expert's action."""
        self.starts.append(len(self.frames) if first else self.starts[-1])
        self.frames.append(np.ascontiguousarray(image.transpose(2, 0, 1)))
        self.actions.append(action.astype(np.float32))

    def stack(self, step: int) -> np.ndarray:
        """The frames up to a step, ``(3 * n_frames, size, size)``."""
        indices = np.maximum(np.arange(step - self.n_frames + 1, step + 1), self.starts[step])
        return np.concatenate([self.frames[index] for index in indices])

    def sample(self, rng: np.random.Generator, batch: int) -> Batch:
        """Stacks and actions of steps drawn at random."""
        steps = rng.integers(0, len(self.frames), batch)
        images, actions = zip(*((self.stack(step), self.actions[step]) for step in steps), strict=True)
        return Batch(th.from_numpy(np.stack(images)), th.from_numpy(np.stack(actions)))


class Study:
    """A clone of one task's expert, with the scenes for training and testing."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args = args
        self.rng = np.random.default_rng(args.seed)
        th.manual_seed(args.seed)
        settings = read_hyperparameters(hyperparameter_file("sac_drq", args.env, demos=True), args.env)
        settings = changed(settings, args.hyperparams, {"env_kwargs": args.env_kwargs | {"obs_type": "dict"}})
        parts = environment_parts(TrainingEnvironment.of_settings(args.env, settings))
        self.env = make_training_env(args.env, parts["env_kwargs"], parts["env_wrapper"])
        self.disturbed_env = Recorder(self.env, args.disturbed)
        self.expert = make_expert(args.env, Pace.of(self.env))
        self.size, self.planar_actions = settings["env_kwargs"]["image_size"], settings.get("planar_actions")
        encoder_kwargs = settings["policy_kwargs"]["features_extractor_kwargs"]
        assert self.env.action_space.shape is not None
        self.clone = Clone(3 * args.frames, self.size, self.env.action_space.shape[0], encoder_kwargs)
        self.optimizer = th.optim.Adam(self.clone.parameters(), lr=args.lr, fused=True)
        self.shift = RandomShift(settings.get("augmentation_pad", 4))
        self.memory = Memory(args.frames)

    def play(self, env: gym.Env, variation: int, memory: Memory, share: float, noise: float = 0.0) -> float:
        """
        Play a scene and store its steps.

        :param share: Share of the turns that the clone plays; the expert plays the others
        :param noise: Standard deviation of the noise on actions
        :return: Normalized performance at the end
        """
        observation, info = env.reset(seed=variation, options={"variation": variation})
        self.expert.reset()
        done, step, clones = False, 0, False
        while not done:
            action = self.expert.act(observation["state"])
            memory.add(observation["image"], action, first=step == 0)
            clones = self.rng.random() < share if step % TURN == 0 else clones
            if clones:
                with th.no_grad():
                    action = self.clone(th.from_numpy(memory.stack(len(memory.frames) - 1))[None])[0].numpy()
            action = np.clip(action + noise * self.rng.normal(size=action.shape), -1, 1).astype(np.float32)
            observation, _, terminated, truncated, info = env.step(action)
            done, step = terminated or truncated, step + 1
        return float(info["normalized_performance"])

    def learn(self, updates: int, last: bool) -> float:
        """Update on all steps so far, with a rate that falls in the last round; mean loss."""
        total = 0.0
        for update in range(updates):
            if last:
                self.optimizer.param_groups[0]["lr"] = self.args.lr * max(LAST_RATE, 1 - update / updates)
            batch = self.memory.sample(self.rng, self.args.batch)
            if self.planar_actions is not None:
                batch = turned(batch, self.planar_actions)
            loss = nn.functional.mse_loss(self.clone(self.shift(batch.observations)), batch.actions)
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
            self.optimizer.step()
            total += loss.item() / updates
        return total

    def run(self) -> Iterator[dict[str, Any]]:
        """All rounds; a row of the table after every second one and after the last."""
        args, start, held_out = self.args, time.time(), SPLITS["eval"][: self.args.scenes]
        expert = float(np.mean([self.play(self.env, variation, Memory(1), share=0.0) for variation in held_out]))
        for round_ in range(1, args.rounds + 1):
            for variation in self.rng.choice(SPLITS["train"], args.episodes, replace=False):
                noise = 0.0 if args.disturbed else self.rng.choice(NOISE)
                self.play(self.disturbed_env, int(variation), self.memory, 0.0 if round_ == 1 else SHARE, noise)
            loss = self.learn(args.updates, last=round_ == args.rounds)
            seconds = time.time() - start
            print(f"round {round_}: {len(self.memory.frames)} steps, loss {loss:.3f} ({seconds:.0f} s)", flush=True)
            if round_ % 2 == 0 or round_ == args.rounds:
                scores = [self.play(self.env, variation, Memory(args.frames), share=1.0) for variation in held_out]
                row = {"env": args.env, "size": self.size, "frames": args.frames, "disturbed": args.disturbed}
                row |= {"seed": args.seed, "scenes": args.scenes, "episodes": round_ * args.episodes}
                row |= {"steps": len(self.memory.frames)}
                row |= {"updates": round_ * args.updates, "score": round(float(np.mean(scores)), 3)}
                row |= {"worst": round(min(scores), 3), "expert": round(expert, 3)}
                print(row, flush=True)
                yield row


def parser() -> argparse.ArgumentParser:
    """The command line."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--env", choices=EXPERT_IDS, default="StraightenRope-v0")
    arguments.add_argument("-params", "--hyperparams", nargs="+", default={}, action=Settings, metavar="KEY:VALUE")
    arguments.add_argument("--env-kwargs", nargs="+", default={}, action=Settings, metavar="KEY:VALUE")
    arguments.add_argument("--frames", type=int, default=1, help="frames of an observation")
    arguments.add_argument("--rounds", type=int, default=8)
    arguments.add_argument("--episodes", type=int, default=25, help="of a round")
    arguments.add_argument("--disturbed", type=float, default=0.0, help="probability that a disturbance follows a step")
    arguments.add_argument("--updates", type=int, default=1250, help="of a round")
    arguments.add_argument("--batch", type=int, default=64)
    arguments.add_argument("--lr", type=float, default=7e-4)
    arguments.add_argument("--scenes", type=int, default=20, help="held-out scenes")
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--csv", type=Path, help="append scores to this table")
    return arguments


def main() -> None:
    """Parse the arguments and run."""
    args = parser().parse_args()
    th.set_num_threads(1)
    for row in Study(args).run():
        if args.csv is not None:
            args.csv.parent.mkdir(parents=True, exist_ok=True)
            with args.csv.open("a", newline="") as file:
                writer = csv.DictWriter(file, row)
                if file.tell() == 0:
                    writer.writeheader()
                writer.writerow(row)


if __name__ == "__main__":
    main()
