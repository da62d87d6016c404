"""
The ceiling of sight: how well could any agent act that sees these images? Clones the scripted expert, which sees the
state, into a network that sees images, and plays with the clone.

    python benchmarks/sight.py --env PourWater-v0 --size 64 --frames 1 [--csv results/sight/scores.csv]

DAgger (https://arxiv.org/abs/1011.0686): in each round the clone plays new scenes, the expert labels every step with
its action, and the clone learns from all steps so far. Every second round the clone plays held-out scenes to their end.
The data are enough when more rounds do not help. The expert's own score in the same scenes stands beside the clone's.

The mean of two actions can be neither of them, so the network predicts a distribution over ``N_BINS`` values of each
element of an action, and plays the most likely one. It also predicts the state, which speeds up learning; `blind` lists
the elements of the state that are predicted worst from held-out images.

No ceiling of the rope can be trusted yet: its two ends look alike, so which of them the state calls the first cannot be
seen, and the loss of the predicted state asks for it.
"""

import argparse
import csv
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from torch import nn

import softbody_envs  # noqa: F401  registers the tasks
from sb3_por.visual.encoders import SpatialSoftmax
from softbody_envs.experts import EXPERT_IDS, make_expert
from softbody_envs.variations import SPLITS

#: Number of values of an element of an action, from -1 to 1
N_BINS = 21
#: Steps after which the player of a training episode, expert or clone, is drawn again.
TURN = 10


class Clone(nn.Module):
    """
    Strided convolutions, flat features beside positions, and two heads.

    :param n_frames: Number of RGB frames of an observation
    :param size: Height and width of a frame, pixels
    :param action_size: Number of elements of an action
    :param state_size: Number of elements of the state
    """

    def __init__(self, n_frames: int, size: int, action_size: int, state_size: int, n_filters: int = 16):
        super().__init__()
        self.action_size = action_size
        # Kernels of 6 pixels and strides of 4, then of 3 and 1; pixels in blocks of 2 x 2 are quicker to convolve
        self.trunk = nn.Sequential(
            nn.PixelUnshuffle(2),
            nn.Conv2d(12 * n_frames, n_filters, 3, stride=2),
            nn.ReLU(inplace=True),
            nn.Conv2d(n_filters, n_filters, 3),
            nn.ReLU(inplace=True),
        ).to(
            memory_format=th.channels_last
        )  # type: ignore[call-overload]
        channels, size = n_filters, (size // 2 - 3) // 2 + 1 - 2
        self.places = nn.Sequential(nn.Conv2d(channels, n_filters, 1), SpatialSoftmax(n_filters, size, size))
        pooled = (size - 3) // 2 + 1
        self.flat = nn.Sequential(
            nn.Conv2d(channels, n_filters, 3, stride=2),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(n_filters * pooled**2, 128),
            nn.LayerNorm(128),
        )
        self.body = nn.Sequential(nn.Linear(5 * n_filters + 128, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU())
        self.action, self.state = nn.Linear(256, action_size * N_BINS), nn.Linear(256, state_size)

    def forward(self, images: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param images: uint8 ``(batch, channels, size, size)``
        :return: logits ``(batch, action_size, N_BINS)`` and the standardized state ``(batch, state_size)``
        """
        maps = self.trunk(images.float() / 255 - 0.5)
        hidden = self.body(th.cat([self.places(maps), self.flat(maps)], dim=1))
        return self.action(hidden).unflatten(1, (self.action_size, N_BINS)), self.state(hidden)


def shares(actions: th.Tensor) -> th.Tensor:
    """Each element as weights of the two nearest values, ``(batch, action_size, N_BINS)``."""
    place = (actions + 1) / 2 * (N_BINS - 1)
    return (1 - (place.unsqueeze(-1) - th.arange(N_BINS)).abs()).clamp(min=0.0)


def most_likely(logits: th.Tensor) -> th.Tensor:
    """The mean over the most likely value and those beside it, ``(batch, action_size)``."""
    near = (th.arange(N_BINS) - logits.argmax(dim=-1, keepdim=True)).abs() <= 1
    return (logits.masked_fill(~near, -th.inf).softmax(dim=-1) * th.linspace(-1, 1, N_BINS)).sum(dim=-1)


class Memory:
    """
    Steps of all episodes.

    :param n_frames: Number of frames of an observation; the first frame of an episode is repeated
    """

    def __init__(self, n_frames: int) -> None:
        self.n_frames = n_frames
        self.frames: list[np.ndarray] = []
        self.states: list[np.ndarray] = []
        self.actions: list[np.ndarray] = []
        self.starts: list[int] = []  # first step of the episode of each step

    def add(self, observation: dict[str, np.ndarray], action: np.ndarray, first: bool) -> None:
        """Add a step, the first of an episode or a later one, with the expert's action."""
        self.starts.append(len(self.frames) if first else self.starts[-1])
        self.frames.append(np.ascontiguousarray(observation["image"].transpose(2, 0, 1)))
        self.states.append(observation["state"])
        self.actions.append(action)

    def stack(self, step: int) -> np.ndarray:
        """The frames up to a step, ``(3 * n_frames, size, size)``."""
        indices = np.maximum(np.arange(step - self.n_frames + 1, step + 1), self.starts[step])
        return np.concatenate([self.frames[index] for index in indices])

    def sample(self, rng: np.random.Generator, batch: int) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Stacks, actions and states of steps drawn at random."""
        steps = rng.integers(0, len(self.frames), batch)
        columns = [(self.stack(step), self.actions[step], self.states[step]) for step in steps]
        stacks, actions, states = (th.from_numpy(np.stack(column)) for column in zip(*columns, strict=True))
        return stacks, actions.float(), states


class Study:
    """A clone of one task's expert, with the scenes for training and testing."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args = args
        self.rng = np.random.default_rng(args.seed)
        th.manual_seed(args.seed)
        self.env = gym.make(args.env, obs_type="dict", image_size=args.size)
        self.expert = make_expert(args.env)
        action_size, state_size = self.env.action_space.shape[0], self.env.observation_space["state"].shape[0]  # type: ignore[index]  # a Dict space
        self.clone = Clone(args.frames, args.size, action_size, state_size)
        self.optimizer = th.optim.Adam(self.clone.parameters(), lr=args.lr, fused=True)
        self.memory = Memory(args.frames)
        self.mean, self.std = th.zeros(state_size), th.ones(state_size)

    def play(self, variation: int, memory: Memory, share: float, noise: float = 0.0, steps: int | None = None) -> float:
        """
        Play a scene and store its steps.

        :param share: Share of the turns that the clone plays; the expert plays the others
        :param noise: Standard deviation of the noise on actions
        :param steps: Number of steps; up to the horizon by default
        :return: Normalized performance at the end
        """
        observation, info = self.env.reset(options={"variation": variation})
        self.expert.reset()
        done, step, clones = False, 0, False
        while not done and step != steps:
            action = self.expert.act(observation["state"])
            memory.add(observation, action, first=step == 0)
            clones = self.rng.random() < share if step % TURN == 0 else clones
            if clones:
                action = self.tell(memory, len(memory.frames) - 1)[0]
            action = np.clip(action + noise * self.rng.normal(size=action.shape), -1, 1).astype(np.float32)
            observation, _, terminated, truncated, info = self.env.step(action)
            done, step = terminated or truncated, step + 1
        return float(info["normalized_performance"])

    def tell(self, memory: Memory, step: int) -> tuple[np.ndarray, np.ndarray]:
        """The clone's action and predicted state."""
        with th.no_grad():
            logits, told = self.clone(th.from_numpy(memory.stack(step))[None])
        return most_likely(logits)[0].numpy(), (told[0] * self.std + self.mean).numpy()

    def learn(self, updates: int) -> float:
        """Update on all steps so far; mean loss of the actions."""
        states = np.stack(self.memory.states)
        self.mean, self.std = th.from_numpy(states.mean(axis=0)), th.from_numpy(states.std(axis=0) + 1e-2)
        total = 0.0
        for _ in range(updates):
            images, actions, seen = self.memory.sample(self.rng, self.args.batch)
            logits, told = self.clone(images)
            loss = -(shares(actions) * logits.log_softmax(dim=-1)).sum(dim=-1).mean()
            total += loss.item() / updates
            loss = loss + nn.functional.smooth_l1_loss(told, (seen - self.mean) / self.std)
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(self.clone.parameters(), 10.0)
            self.optimizer.step()
        return total

    def blind(self, memory: Memory) -> str:
        """The elements of the state that are predicted worst, with the unexplained share of their variance."""
        steps = range(0, len(memory.frames), 5)
        states = np.stack([memory.states[step] for step in steps])
        errors = np.stack([self.tell(memory, step)[1] for step in steps]) - states
        left = np.square(errors).mean(axis=0) / (states.var(axis=0) + 1e-4)
        names = self.env.unwrapped.state_names  # type: ignore[attr-defined]
        return ", ".join(f"{names[i]} {left[i]:.2f}" for i in left.argsort()[::-1][:4])

    def run(self) -> Iterator[dict[str, Any]]:
        """All rounds; a row of the table after every second one."""
        args, start, held_out = self.args, time.time(), SPLITS["eval"][: self.args.scenes]
        expert = float(np.mean([self.play(variation, Memory(1), share=0.0) for variation in held_out]))
        for round_ in range(1, args.rounds + 1):
            for variation in self.rng.choice(SPLITS["train"], args.episodes):
                noise = self.rng.choice([0.0, 0.2, 0.5])
                self.play(int(variation), self.memory, 0.0 if round_ == 1 else 0.7, noise, args.steps)
            if round_ == args.rounds - 1:
                self.optimizer.param_groups[0]["lr"] /= 5
            loss = self.learn(args.updates)
            print(
                f"round {round_}: {len(self.memory.frames)} steps, loss {loss:.3f} ({time.time() - start:.0f} s)", flush=True
            )
            if round_ % 2 == 0:
                seen = Memory(args.frames)
                scores = [self.play(variation, seen, share=1.0) for variation in held_out]
                row = {name: getattr(args, name) for name in ("env", "size", "frames", "seed", "scenes")}
                row |= {"episodes": round_ * args.episodes, "steps": len(self.memory.frames), "updates": round_ * args.updates}
                row |= {"score": round(float(np.mean(scores)), 3), "worst": round(min(scores), 3), "expert": round(expert, 3)}
                print(row, "blind:", self.blind(seen), flush=True)
                yield row


def main() -> None:
    """Parse the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=EXPERT_IDS, default="PourWater-v0")
    parser.add_argument("--size", type=int, default=64, help="height and width of an image, pixels")
    parser.add_argument("--frames", type=int, default=1, help="frames of an observation")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--episodes", type=int, default=20, help="of a round")
    parser.add_argument("--steps", type=int, help="of a training episode; the horizon if not given")
    parser.add_argument("--updates", type=int, default=700, help="of a round")
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--lr", type=float, default=1e-3)
    parser.add_argument("--scenes", type=int, default=20, help="held-out scenes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--csv", type=Path, help="append scores to this table")
    args = parser.parse_args()
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
