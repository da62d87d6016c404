"""
How soon does an encoder see where things are? Trains encoders, by regression, to tell from an image where the second picker
is, seen from the first, how high both are, and where the ends of the rope are or, seen from its picker, each corner to take.

    python benchmarks/encoders.py [--json]             about five minutes
    python benchmarks/encoders.py --env FoldCloth-v0   of the cloth instead of the rope
    python benchmarks/encoders.py MODEL.zip ...        what agents' encoders have learned by their own loss

`error_cm` is the root mean square error along x and y in scenes that were not trained on, `height_cm` that of the heights;
`constant` is what the mean of the training data would give. A picker takes an end within 5 cm. Images are shifted at random
as in training. Of an agent's encoder the features are taken as they are, and a head learns from them.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

import softbody_envs  # noqa: F401  registers the tasks
from sb3_por.evaluation.loading import load_model
from sb3_por.visual.augmentations import RandomShift
from sb3_por.visual.encoders import ConvEncoder
from softbody_envs.experts import make_expert
from softbody_envs.sim.pickers import REACH
from softbody_envs.variations import SPLITS

#: Images and targets
Frames = tuple[th.Tensor, th.Tensor]

STEPS = 40
#: Targets along x and y; those after them are heights.
N_FLAT = 6
ENCODERS: dict[str, dict[str, Any]] = {
    "of the settings": dict(strides=(4, 2, 1), n_filters=16),
    "of the settings, centered": dict(strides=(4, 2, 1), n_filters=16, center=True),
    "default": dict(),
    "default, centered": dict(center=True),
    "spatial softmax, centered": dict(strides=(2, 2), n_filters=16, center=True, spatial_softmax=True),
}


def ways_on_rope(state: np.ndarray) -> np.ndarray:
    """
    From picker 0 to the end that is nearer to it, to the other end, and to picker 1: x and y. Then the heights of picker 0 and
    1. In 0.08 m, ``(8,)``.
    """
    first, second = sorted((state[38:41], state[41:44]), key=lambda way: float(np.linalg.norm(way)))
    return np.concatenate([first[:2], second[:2], (state[33:35] - state[30:32]) / REACH, state[[32, 35]] / REACH])


def ways_on_cloth(state: np.ndarray) -> np.ndarray:
    """
    From each picker to the corner that it starts nearer to, and from picker 0 to picker 1: x and y. Then the heights of picker
    0 and 1. In 0.08 m, ``(8,)``.
    """
    return np.concatenate([state[20:22], state[23:25], (state[15:17] - state[12:14]) / REACH, state[[14, 17]] / REACH])


WAYS = {"StraightenRope-v0": ways_on_rope, "FoldCloth-v0": ways_on_cloth}


def collect(env_id: str, split: str, scenes: int, image_size: int, rng: np.random.Generator) -> tuple[th.Tensor, th.Tensor]:
    """Every second frame of play that is partly random, partly the expert's, and where things are in it."""
    env = gym.make(env_id, obs_type="dict", image_size=image_size, split=split)
    expert, ways = make_expert(env_id), WAYS[env_id]
    images, targets = [], []
    for variation in list(SPLITS[split])[:scenes]:
        observation, _ = env.reset(options={"variation": variation})
        expert.reset()
        share = rng.choice([0.0, 0.3, 0.7, 1.0])
        for step in range(STEPS):
            if step % 3 == 0:
                random_action, is_random = rng.uniform(-1, 1, 8), rng.random() < share
            wanted = expert.act(observation["state"]) + 0.2 * rng.normal(size=8)
            action = np.clip(random_action if is_random else wanted, -1, 1).astype(np.float32)
            observation, *_ = env.step(action)
            if step % 2 == 0:
                images.append(observation["image"])
                targets.append(ways(observation["state"]))
    env.close()
    return th.as_tensor(np.array(images)).permute(0, 3, 1, 2).contiguous(), th.as_tensor(np.array(targets)).float()


def make_head(n_features: int, n_targets: int) -> nn.Sequential:
    """An MLP as large as a critic."""
    hidden = (nn.Linear(n_features, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU())
    return nn.Sequential(*hidden, nn.Linear(256, n_targets))


def fit(
    network: nn.Module,
    inputs: th.Tensor,
    targets: th.Tensor,
    prepare: Callable[[th.Tensor], th.Tensor],
    arguments: argparse.Namespace,
) -> float:
    """
    :return: seconds
    """
    optimizer = th.optim.Adam(network.parameters(), lr=7e-4, fused=True)
    before = time.perf_counter()
    for _ in range(arguments.updates):
        rows = th.randint(0, len(inputs), (arguments.batch,))
        loss = nn.functional.mse_loss(network(prepare(inputs[rows])), targets[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return round(time.perf_counter() - before, 1)


def in_parts(network: Callable[[th.Tensor], th.Tensor], images: th.Tensor) -> th.Tensor:
    """A network's output for images, without gradient."""
    with th.no_grad():
        return th.cat([network(part) for part in images.split(500)])


def train(options: dict[str, Any], data: Frames, held_out: Frames, arguments: argparse.Namespace) -> dict[str, float]:
    """
    Train an encoder by the targets alone.

    :return: errors on the held-out frames and seconds of training
    """
    th.manual_seed(0)
    encoder = ConvEncoder(spaces.Box(0, 255, data[0].shape[1:], np.uint8), **options)
    network = nn.Sequential(encoder, encoder.make_projection(), make_head(encoder.features_dim, data[1].shape[1]))
    augment = RandomShift()
    seconds = fit(network, *data, lambda images: augment(images).float() / 255, arguments)
    outputs = in_parts(lambda images: network(images.float() / 255), held_out[0])
    return {"seconds": seconds, **errors(outputs, held_out[1])}


def probe(model: Path, data: Frames, held_out: Frames, arguments: argparse.Namespace) -> dict[str, float]:
    """
    Train nothing but a head, on the features of an agent's encoder (standardized).

    :return: errors on the held-out frames and seconds of training
    """
    encode = load_model(model, device="cpu").critic.encode
    features = in_parts(encode, data[0])
    deviation, mean = th.std_mean(features, dim=0)

    def standardize(features: th.Tensor) -> th.Tensor:
        return (features - mean) / (deviation + 1e-4)

    th.manual_seed(0)
    head = make_head(features.shape[1], data[1].shape[1])
    seconds = fit(head, features, data[1], standardize, arguments)
    outputs = in_parts(lambda images: head(standardize(encode(images))), held_out[0])
    return {"seconds": seconds, **errors(outputs, held_out[1])}


def errors(outputs: th.Tensor, targets: th.Tensor) -> dict[str, float]:
    """Root mean square errors, cm."""
    parts = {"error_cm": slice(None, N_FLAT), "height_cm": slice(N_FLAT, None)}
    squares = (outputs - targets).square()
    return {name: round(100 * REACH * squares[:, part].mean().sqrt().item(), 1) for name, part in parts.items()}


def main() -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", type=Path, metavar="MODEL.zip", help="agents whose encoders are probed instead")
    parser.add_argument("--env", choices=WAYS, default="StraightenRope-v0", help="environment id")
    parser.add_argument("--json", action="store_true", help="print JSON instead of lines")
    parser.add_argument("--image-size", type=int, default=64, help="pixels")
    parser.add_argument("--batch", type=int, default=64, help="frames per update")
    parser.add_argument("--updates", type=int, default=1000)
    parser.add_argument("--scenes", type=int, default=300, help="scenes to train on; a tenth as many are held out")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    rng = np.random.default_rng(0)
    data = collect(arguments.env, "train", arguments.scenes, arguments.image_size, rng)
    held_out = collect(arguments.env, "eval", max(1, arguments.scenes // 10), arguments.image_size, rng)
    rows: list[dict[str, Any]] = [{"encoder": "constant", "seconds": 0.0, **errors(data[1].mean(0), held_out[1])}]
    for name, options in ENCODERS.items() if not arguments.models else ():
        rows.append({"encoder": name, **train(options, data, held_out, arguments)})
    for model in arguments.models:
        rows.append({"encoder": str(model), **probe(model, data, held_out, arguments)})
    lines = [f"{row['encoder']:28s}{row['error_cm']:6.1f} cm{row['height_cm']:6.1f} cm{row['seconds']:8.1f} s" for row in rows]
    print(json.dumps(rows, indent=1) if arguments.json else "\n".join(lines))


if __name__ == "__main__":
    main()
