"""
How many updates a second each algorithm makes, and how far that is from what its encoder costs by itself.

    python benchmarks/learner.py                              batch 128, 84-pixel images: a table
    python benchmarks/learner.py --json                       the same as JSON
    python benchmarks/learner.py --device cuda --batch 256    on a GPU
    python benchmarks/learner.py --profile sac_por            where an update of one algorithm spends its time

`ratio_to_sb3` is how many times as fast as Stable-Baselines3's own SAC with the same encoder, batch and threads.
`ratio_to_floor` is the time of an update over that of the bare encoder passes that the algorithm needs: 1 would be an
algorithm that costs nothing beside its convolutions. All are timed in turn, again and again, so that a busy machine slows
them alike; the medians count. The floor has the memory allocator that the algorithm has.
"""

import argparse
import json
import multiprocessing
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import gymnasium as gym
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

import softbody_envs  # noqa: F401  registers the tasks
from sb3_por.acceleration.precision import PRECISIONS
from sb3_por.algorithms import SACCURL, SACMRQ, SACPOR, SACSPR, TQCPOR, SACDrQ
from sb3_por.visual.encoders import ConvEncoder, make_projection
from sb3_por.visual.sac import VisualSAC

#: Frames in the replay buffer while the updates are timed.
N_FRAMES = 400


class WholeEncoder(BaseFeaturesExtractor):
    """Trunk and projection in one, for algorithms that know of no parts."""

    def __init__(self, observation_space: gym.Space):
        trunk = ConvEncoder(observation_space)
        super().__init__(observation_space, trunk.features_dim)
        self.trunk = trunk
        self.projection = make_projection(trunk)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.projection(self.trunk(observations))


#: Name: class, its arguments, and the encoder passes that one update needs, in batches: with gradient, without, and back
#: again through those with gradient, for an objective with an optimizer of its own. All need o_t with gradient for the
#: critic, o_{t+1} from the momentum encoder for the target, and from the trunk for the actor.
ALGORITHMS: dict[str, tuple[type[Any], dict[str, Any], tuple[float, float, int]]] = {
    # Actor, critic and target encode for themselves. With gradient: o_t for the actor, for the critic, and for the
    # critic's judgement of the actor, in which SB3 does not stop it. Without: o_{t+1} for the actor and for the target.
    "sac (SB3)": (SAC, {"policy_kwargs": {"features_extractor_class": WholeEncoder}}, (3, 2, 0)),
    "visual_sac": (VisualSAC, {}, (1, 2, 0)),
    "sac_por": (SACPOR, {}, (1, 2.5, 0)),  # half a batch of earlier frames passes the momentum encoder
    "sac_por (paper)": (SACPOR, {"pairing": "paper"}, (1, 2, 0)),
    "tqc_por": (TQCPOR, {}, (1, 2.5, 0)),
    "sac_drq": (SACDrQ, {}, (2, 4, 0)),
    "sac_curl": (SACCURL, {}, (1, 3, 1)),  # a second augmentation
    "sac_spr": (SACSPR, {}, (1, 7, 1)),  # a window of five frames
    "sac_mrq": (SACMRQ, {}, (1, 7, 1)),
}


def make_model(name: str, batch: int, image_size: int, device: str, options: dict[str, Any]) -> Any:
    """An algorithm of the table with some frames in its replay buffer."""
    algorithm, arguments, _ = ALGORITHMS[name]
    env = gym.make("FallingBall-v0", image_size=image_size)
    options = {} if algorithm is SAC else options
    model = algorithm(
        "CnnPolicy",
        env,
        batch_size=batch,
        buffer_size=N_FRAMES,
        learning_starts=N_FRAMES,
        train_freq=N_FRAMES,
        device=device,
        seed=0,
        **arguments,
        **options,
    )
    model.learn(N_FRAMES)
    return model


def make_floor(name: str, batch: int, image_size: int, device: str) -> Callable[[], None]:
    """The bare encoder passes of one update, batch by batch, on images that are already float and on the device."""
    *shares, n_again = ALGORITHMS[name][2]
    trained, untrained = ([batch] * int(share) + [round(batch * (share % 1))] for share in shares)
    space = gym.spaces.Box(0, 255, (3, image_size, image_size), "uint8")
    encoder = WholeEncoder(space).to(device)
    images = th.rand(batch, 3, image_size, image_size, device=device)
    images = images.contiguous(memory_format=th.channels_last)

    def passes() -> None:
        encoder.zero_grad()
        for n_images in filter(None, trained):
            output = encoder(images[:n_images]).sum()
            for again in reversed(range(1 + n_again)):
                output.backward(retain_graph=again > 0)
        with th.no_grad():
            for n_images in filter(None, untrained):
                encoder(images[:n_images])

    return passes


def seconds(function: Callable[[], Any], n: int, device: str) -> float:
    """Seconds that one call takes, on average over n."""
    _wait(device)
    before = time.perf_counter()
    for _ in range(n):
        function()
    _wait(device)
    return (time.perf_counter() - before) / n


def _wait(device: str) -> None:
    if device == "cuda":
        th.cuda.synchronize()


def work(pipe: Connection, threads: int, name: str, batch: int, image_size: int, device: str, options: dict[str, Any]) -> None:
    """
    Time one algorithm and its floor whenever the pipe says ``("update" or "floor", n)``; it takes the seconds back. In a
    process of its own: `sb3_por` sets the memory allocator of its process, which would help Stable-Baselines3, too.
    """
    th.set_num_threads(threads)
    model = make_model(name, batch, image_size, device, options)
    calls = {"update": lambda: model.train(1, batch), "floor": make_floor(name, batch, image_size, device)}
    for what, n in iter(pipe.recv, None):
        pipe.send(seconds(calls[what], n, device))


def measure(
    names: list[str],
    threads: int,
    batch: int,
    image_size: int,
    device: str,
    rounds: int,
    updates: int,
    options: dict[str, Any],
) -> list[dict[str, Any]]:
    """
    Time updates of the algorithms and their floors in turn.

    :return: a row for each algorithm
    """
    context = multiprocessing.get_context("spawn")
    pipes: dict[str, Connection] = {}
    for name in names:
        pipes[name], theirs = context.Pipe()
        context.Process(target=work, args=(theirs, threads, name, batch, image_size, device, options), daemon=True).start()
    times: dict[tuple[str, str], list[float]] = defaultdict(list)
    for _ in range(rounds + 1):
        for name, pipe in pipes.items():
            for what in ("update", "floor"):
                pipe.send((what, updates))
                times[name, what].append(pipe.recv())
    for pipe in pipes.values():
        pipe.send(None)
    median = {key: statistics.median(values[1:]) for key, values in times.items()}  # the first round warms up
    stock = median.get(("sac (SB3)", "update"))
    return [
        {
            "algo": name,
            "device": device,
            "batch": batch,
            "image_size": image_size,
            "updates_per_s": round(1 / median[name, "update"], 2),
            "ratio_to_sb3": round(stock / median[name, "update"], 2) if stock else None,
            "ratio_to_floor": round(median[name, "update"] / median[name, "floor"], 2),
        }
        for name in names
    ]


def profile(name: str, batch: int, image_size: int, device: str, updates: int, options: dict[str, Any]) -> str:
    """
    :return: a table of the operations that take most of an update
    """
    model = make_model(name, batch, image_size, device, options)
    model.train(5, batch)
    activities = [th.profiler.ProfilerActivity.CPU] + [th.profiler.ProfilerActivity.CUDA] * (device == "cuda")
    with th.profiler.profile(activities=activities) as recorded:
        model.train(updates, batch)
        _wait(device)
    return recorded.key_averages().table(sort_by=f"self_{device}_time_total", row_limit=25)


def print_table(rows: list[dict[str, Any]]) -> None:
    columns = list(rows[0])
    cells = [columns, *([str(row[column]) for column in columns] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    for line in cells:
        print("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--algos", nargs="+", choices=ALGORITHMS, default=list(ALGORITHMS), metavar="ALGO")
    parser.add_argument("--batch", type=int, default=128, help="transitions per update")
    parser.add_argument("--image-size", type=int, default=84, help="pixels")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--threads", type=int, default=2, help="of PyTorch on the CPU")
    parser.add_argument("--rounds", type=int, default=7, help="how often each algorithm has its turn")
    parser.add_argument("--updates", type=int, default=5, help="updates in a turn")
    parser.add_argument("--profile", choices=ALGORITHMS, metavar="ALGO", help="profile one algorithm instead")
    parser.add_argument("--precision", choices=PRECISIONS, default="float32", help="of our algorithms")
    parser.add_argument("--compile", metavar="MODE", help="compile our networks with this mode of torch.compile")
    arguments = parser.parse_args()
    options = {"precision": arguments.precision, "compile_mode": arguments.compile}
    th.set_num_threads(arguments.threads)
    where = (arguments.batch, arguments.image_size, arguments.device)
    if arguments.profile:
        print(profile(arguments.profile, *where, arguments.updates, options))
        return
    rows = measure(arguments.algos, arguments.threads, *where, arguments.rounds, arguments.updates, options)
    print(json.dumps(rows, indent=1)) if arguments.json else print_table(rows)


if __name__ == "__main__":
    main()
