"""Making of a ranker: videos in, a file, a report and a picture out."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

from sb3_por.analysis.controls import PlayedFrames, clock, mean, spearman, within_episodes
from sb3_por.analysis.plot_style import save_figure, style
from sb3_por.common.errors import UserError
from sb3_por.common.files import check_output
from sb3_por.evaluation.episodes import Episode, evaluation_episodes, training_episodes
from sb3_por.ranking.images import find_image, resize
from sb3_por.ranking.ranker import SUFFIX, Ranker
from sb3_por.ranking.training import train_ranker

#: Quantities in ``info`` that a potential is compared with
QUANTITIES = ("normalized_performance", "monotone")
#: One video in so many is held out
HELD_OUT = 5
#: Frames beneath the curve of the picture
N_SHOWN = 8


@dataclass(frozen=True)
class RandomPlay:
    """
    Episodes of random actions.

    :param videos: Frames of each episode
    :param quantities: Name -> value in each frame, one array an episode; only those that the environment reports
    """

    videos: list[np.ndarray]
    quantities: dict[str, list[np.ndarray]]


@dataclass(frozen=True)
class Agreement:
    """
    Spearman's correlation of a potential with a physical quantity in episodes of random actions.

    :param at_ends: Over the last frames of the episodes, which are at equal time: a clock has 0
    :param within: Over the frames of an episode, mean of the episodes in which the quantity varies
    :param clock_within: The same of the frame number
    """

    at_ends: float
    within: float
    clock_within: float


@dataclass(frozen=True)
class RankerReport:
    """
    Measurements of a ranker on what it has not been trained on. NaN where there is nothing to measure.

    :param next_frame: Share of pairs of successive frames of held-out videos that are ranked right; a clock has 1
    :param any_frames: The same of all pairs of a video
    :param agreement: Quantity -> agreement in held-out scenes
    :param random_end: Mean potential at the ends of these episodes
    :param random_highest: Highest potential in them
    """

    next_frame: float
    any_frames: float
    agreement: dict[str, Agreement]
    random_end: float = float("nan")
    random_highest: float = float("nan")

    def __str__(self) -> str:
        if np.isnan(self.next_frame):
            lines = ["no video was held out: give at least two"]
        else:
            lines = [
                f"held-out videos: successive frames are ranked right in {self.next_frame:.1%} of the pairs, any two frames "
                f"in {self.any_frames:.1%} (a clock: 100 %)"
            ]
        for name, one in self.agreement.items():
            lines.append(
                f"random episodes: rank correlation with {name} {one.at_ends:.2f} over their ends (a clock: 0), "
                f"{one.within:.2f} within them (a clock: {one.clock_within:.2f})"
            )
        if not np.isnan(self.random_end):
            lines.append(
                f"potential: 1 at the ends of the videos, {self.random_end:.2f} at those of random episodes, where it is "
                f"{self.random_highest:.2f} at most"
            )
        return "\n".join(lines)


def rank(
    videos: Sequence[np.ndarray],
    path: str | Path,
    make_env: Callable[[], gym.Env[Any, np.ndarray]] | None = None,
    env_id: str = "",
    n_random: int = 50,
    target: str = "order",
    updates: int = 1500,
    image_size: int = 64,
    seed: int = 0,
) -> RankerReport:
    """
    Train a ranker, measure it, and write it with a picture of its potential beside it (``.png``).

    :param videos: Frames of each video; one in five is held out
    :param path: The new file, ``.npz``
    :param make_env: Makes the environment whose random play gives the negatives, in training scenes, and in held-out scenes
        the measurements; None for neither
    :param env_id: Gymnasium id of that environment
    :param n_random: Episodes of random actions, of either kind
    :param target: See :func:`sb3_por.ranking.training.train_ranker`
    :param updates: See :func:`sb3_por.ranking.training.train_ranker`
    :param image_size: Height and width in pixels to which frames are resized
    :param seed: Seed of everything drawn
    :return: The measurements
    :raises UserError: If the files cannot be written, there is no image in the environment, or nothing could be learned
    """
    path = check_output(path, (SUFFIX,))
    if n_random < 1:
        raise UserError(f"negatives need at least 1 random episode, got {n_random}")
    order = np.random.default_rng(seed).permutation(len(videos))
    n_held_out = max(len(videos) // HELD_OUT, 1) if len(videos) > 1 else 0
    held_out, learned = [videos[i] for i in order[:n_held_out]], [videos[i] for i in order[n_held_out:]]
    negatives, played = [], RandomPlay([], {})
    if make_env is not None:
        negatives = play_at_random(make_env(), training_episodes(env_id, n_random, seed + 1), image_size, seed).videos
        played = play_at_random(make_env(), evaluation_episodes(env_id, n_random), image_size, seed + 1)
    ranker = train_ranker(learned, negatives, target, updates, image_size=image_size, seed=seed)
    if held_out:
        ranker.calibrate(held_out)
    report = measure(ranker, held_out, played)
    ranker.facts |= {"env": env_id, "n_held_out": n_held_out, "report": _for_json(asdict(report))}
    ranker.save(path)
    save_figure(draw(ranker, held_out or learned, played.videos), path.with_suffix(".png"))
    return report


def play_at_random(env: gym.Env[Any, np.ndarray], episodes: list[Episode], image_size: int = 64, seed: int = 0) -> RandomPlay:
    """
    Play episodes with random actions.

    :param env: An environment with one image in its observations, or with ``render_mode="rgb_array"``; is closed
    :param episodes: Episodes to play
    :param image_size: Height and width to which frames are resized
    :param seed: Seed of the actions
    :return: Frames and quantities
    :raises UserError: If the environment has no image
    """
    image = find_image(env.observation_space)
    if image is None and env.render_mode != "rgb_array":
        env.close()
        raise UserError(f"there is no single image in {env.observation_space}; --env-kwargs render_mode:rgb_array renders one")
    env.action_space.seed(seed)
    videos, infos = [], []
    for episode in episodes:
        options = None if episode.variation is None else {"variation": episode.variation}
        observation, info = env.reset(seed=episode.seed, options=options)
        frames, told, done = [], [], False
        while True:
            picture = np.asarray(env.render() if image is None else image(observation))
            frames.append(resize(picture[None], image_size)[0])
            told.append(info)
            if done:
                break
            observation, _, terminated, truncated, info = env.step(env.action_space.sample())
            if "sim_error" in info:
                break
            done = terminated or truncated
        videos.append(np.stack(frames))
        infos.append(told)
    env.close()
    names = [name for name in QUANTITIES if all(name in info for told in infos for info in told)]
    return RandomPlay(videos, {name: [np.array([info[name] for info in told], float) for told in infos] for name in names})


def measure(ranker: Ranker, held_out: Sequence[np.ndarray], played: RandomPlay) -> RankerReport:
    """
    :param ranker: A trained ranker
    :param held_out: Videos that it was not trained on
    :param played: Episodes of random actions that it was not trained on
    :return: The measurements
    """
    rises = [np.subtract.outer(p, p).T for p in map(ranker.potential, held_out)]  # [earlier, later]
    next_frame = np.concatenate([_right(np.diagonal(rise, 1)) for rise in rises]) if rises else np.empty(0)
    any_frames = np.concatenate([_right(rise[np.triu_indices(len(rise), 1)]) for rise in rises]) if rises else np.empty(0)
    if not played.videos:
        return RankerReport(mean(next_frame), mean(any_frames), {})
    potentials = [ranker.potential(video) for video in played.videos]
    agreement = {name: _agreement(potentials, values) for name, values in played.quantities.items()}
    end = float(np.mean([p[-1] for p in potentials]))
    return RankerReport(mean(next_frame), mean(any_frames), agreement, end, max(float(p.max()) for p in potentials))


def draw(ranker: Ranker, videos: Sequence[np.ndarray], random_videos: Sequence[np.ndarray] = ()) -> Figure:
    """
    Draw the potential over a video, with frames of it beneath.

    :param ranker: A trained ranker
    :param videos: The first is drawn bold, with its frames, the others faint
    :param random_videos: Episodes of random actions, for comparison
    :return: The figure
    """
    shown = np.unique(np.linspace(0, len(videos[0]) - 1, N_SHOWN).round().astype(int))
    with style():
        figure = Figure(figsize=(8, 4.8), layout="constrained")
        curves, *strip = figure.subplot_mosaic(
            [["curves"] * len(shown), [str(i) for i in shown]], height_ratios=(3, 1), gridspec_kw={"wspace": 0.02}
        ).values()
        for i, video in enumerate(random_videos):
            label = "random actions" if i == 0 else None
            curves.plot(_times(video), ranker.potential(video), color="#999999", linewidth=0.8, alpha=0.5, label=label)
        for i, video in enumerate(videos[1:]):
            label = "other videos" if i == 0 else None
            curves.plot(_times(video), ranker.potential(video), color="#56B4E9", linewidth=1, label=label)
        curves.plot(_times(videos[0]), ranker.potential(videos[0]), color="#0072B2", marker="o", label="the video beneath")
        curves.set(xlabel="share of the time", ylabel="potential", xlim=(0, 1))
        curves.legend(loc="upper left")
        for axes, i in zip(strip, shown, strict=True):
            axes.imshow(videos[0][i])
            axes.set_axis_off()
    return figure


def _times(video: np.ndarray) -> np.ndarray:
    return np.linspace(0, 1, len(video))


def _right(rise: np.ndarray) -> np.ndarray:
    """1 where the later frame is ranked later, 0 where the earlier one is; a tie is half right."""
    return 0.5 + 0.5 * np.sign(rise.astype(float))


def _agreement(potentials: list[np.ndarray], quantities: list[np.ndarray]) -> Agreement:
    lengths = np.array([len(p) for p in potentials])
    step = int(np.median(lengths)) - 1  # equal time, also where some episodes have ended early
    ends = [(p[step], q[step]) for p, q in zip(potentials, quantities, strict=True) if len(p) > step]
    episode, frame = np.repeat(np.arange(len(lengths)), lengths), np.concatenate([np.arange(n) for n in lengths])
    frames = PlayedFrames(episode, frame, np.concatenate(quantities))
    return Agreement(
        at_ends=spearman(*np.array(ends).T),
        within=mean(within_episodes(frames, np.concatenate(potentials))),
        clock_within=clock(frames, 1).correlation,
    )


def _for_json(value: Any) -> Any:
    """The same with None for NaN."""
    if isinstance(value, dict):
        return {name: _for_json(part) for name, part in value.items()}
    return None if np.isnan(value) else value
