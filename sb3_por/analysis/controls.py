"""
Controls for the claim that a learned order follows a physical quantity: pure functions on frames of held-out episodes.

Episodes start alike, so the time since the start is visible in every frame and is itself an order. Within an episode a
potential that only tells the time correlates with every quantity that grows. These measures separate the two.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields

import numpy as np
from scipy.stats import rankdata

#: (indices, indices of as many frames) -> belief in [0, 1] that the second frame of each pair is the later one.
Belief = Callable[[np.ndarray, np.ndarray], np.ndarray]
#: Largest difference of equal quantities.
TOLERANCE = 1e-6
#: Episodes that a correlation at equal time needs.
MIN_EPISODES = 3


@dataclass(frozen=True)
class PlayedFrames:
    """
    The frames of several episodes, one after the other.

    :param episode: index of each frame's episode
    :param step: number of each frame in its episode, from 0
    :param quantity: physical quantity in each frame, ``info["monotone"]``; NaN if it is not reported
    """

    episode: np.ndarray
    step: np.ndarray
    quantity: np.ndarray

    def __len__(self) -> int:
        return len(self.episode)


@dataclass(frozen=True)
class Controls:
    """
    Agreement of an order with time and with the physical quantity. NaN where there is nothing to measure.

    :param correlation: Spearman correlation of potential and quantity within an episode, mean over episodes in which the
        quantity varies; time alone can explain it
    :param partial_correlation: the same given time (Spearman partial correlation), chance 0
    :param equal_time_correlation: Spearman correlation over episodes at the same step, mean over steps at which the quantity
        varies, chance 0; time cannot explain it
    :param pair_accuracy: fraction of pairs of an episode, k steps apart, in which the later frame is judged later, chance 0.5
    :param pair_accuracy_unchanged: the same over pairs with equal quantities
    :param pair_accuracy_changed: the same over the other pairs
    :param equal_time_accuracy: fraction of pairs of two episodes at the same step in which the frame with the larger quantity
        is judged later, chance 0.5; time cannot explain it
    """

    correlation: float
    partial_correlation: float
    equal_time_correlation: float
    pair_accuracy: float
    pair_accuracy_unchanged: float
    pair_accuracy_changed: float
    equal_time_accuracy: float


#: Names of the measures.
MEASURES = [field.name for field in fields(Controls)]


def measure_controls(frames: PlayedFrames, potential: np.ndarray, belief: Belief, k: int) -> Controls:
    """
    Measure an order on played frames.

    :param frames: the frames
    :param potential: a number for each frame that is larger the later the frame comes in the order
    :param belief: the order's judgement of pairs
    :param k: distance of the pairs within an episode, steps
    """
    earlier, later = pairs_within_episodes(frames, [k])
    smaller, larger = pairs_at_equal_time(frames)
    unchanged, changed = by_change(frames, earlier, later)
    right = belief(earlier, later)
    return Controls(
        correlation=mean(within_episodes(frames, potential)),
        partial_correlation=mean(within_episodes_given_time(frames, potential)),
        equal_time_correlation=mean(at_equal_time(frames, potential)),
        pair_accuracy=mean(right),
        pair_accuracy_unchanged=mean(right[unchanged]),
        pair_accuracy_changed=mean(right[changed]),
        equal_time_accuracy=mean(belief(smaller, larger)),
    )


def clock(frames: PlayedFrames, k: int) -> Controls:
    """The order of a clock, which knows the frame's number and nothing else: what time alone can explain."""
    time = frames.step.astype(float)
    return measure_controls(frames, time, lambda first, second: 0.5 + 0.5 * np.sign(time[second] - time[first]), k)


def within_episodes(frames: PlayedFrames, potential: np.ndarray) -> np.ndarray:
    """Spearman correlation of potential and quantity in each episode; NaN where the quantity is constant."""
    return np.array([spearman(potential[rows], frames.quantity[rows]) for rows in _groups(frames.episode)])


def within_episodes_given_time(frames: PlayedFrames, potential: np.ndarray) -> np.ndarray:
    """Spearman partial correlation given time in each episode; NaN where time determines the quantity's ranks."""
    groups = _groups(frames.episode)
    return np.array([partial_spearman(potential[rows], frames.quantity[rows], frames.step[rows]) for rows in groups])


def at_equal_time(frames: PlayedFrames, potential: np.ndarray) -> np.ndarray:
    """Spearman correlation over episodes at each step; NaN where the quantity is constant or there are few episodes."""
    groups = [rows for rows in _groups(frames.step) if len(rows) >= MIN_EPISODES]
    return np.array([spearman(potential[rows], frames.quantity[rows]) for rows in groups])


def pairs_within_episodes(frames: PlayedFrames, distances: Iterable[int]) -> tuple[np.ndarray, np.ndarray]:
    """
    Pairs of frames of one episode.

    :param frames: the frames
    :param distances: steps between the frames of a pair
    :return: indices of the earlier frames, and of the later ones
    """
    earlier, later = [np.empty(0, int)], [np.empty(0, int)]
    for k in distances:
        first = np.arange(len(frames) - k)
        first = first[frames.episode[first] == frames.episode[first + k]]
        earlier.append(first)
        later.append(first + k)
    return np.concatenate(earlier), np.concatenate(later)


def by_change(frames: PlayedFrames, earlier: np.ndarray, later: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Split pairs by whether the quantity changes.

    :return: masks of the pairs with equal quantities, and of those with different ones; unknown quantities are in neither
    """
    change = np.abs(frames.quantity[later] - frames.quantity[earlier])
    return change <= TOLERANCE, change > TOLERANCE


def pairs_at_equal_time(frames: PlayedFrames) -> tuple[np.ndarray, np.ndarray]:
    """
    Pairs of frames of two episodes at the same step with different quantities.

    :return: indices of the frames with the smaller quantity, and of those with the larger
    """
    pairs: list[np.ndarray] = [np.empty((2, 0), int)]
    for rows in _groups(frames.step):
        quantity = frames.quantity[rows]
        pairs.append(rows[np.array(np.nonzero(quantity - quantity[:, None] > TOLERANCE))])
    smaller, larger = np.concatenate(pairs, axis=1)
    return smaller, larger


def spearman(potential: np.ndarray, quantity: np.ndarray) -> float:
    """Spearman correlation; NaN for a constant quantity, 0 for a constant potential, which knows nothing of it."""
    return _correlation(rankdata(potential), rankdata(quantity)) if np.isfinite(quantity).all() else float("nan")


def partial_spearman(potential: np.ndarray, quantity: np.ndarray, time: np.ndarray) -> float:
    """
    Spearman correlation of potential and quantity given time: the correlation of their ranks after a linear regression on
    the ranks of time. NaN where nothing is left of the quantity, 0 where nothing is left of the potential.
    """
    if not np.isfinite(quantity).all():
        return float("nan")
    ranks = rankdata(time)
    return _correlation(_residual(rankdata(potential), ranks), _residual(rankdata(quantity), ranks))


def mean(values: np.ndarray) -> float:
    """Mean of the values that are no NaN; NaN if there are none."""
    values = values[~np.isnan(values)]
    return float(values.mean()) if len(values) else float("nan")


def _correlation(potential: np.ndarray, quantity: np.ndarray) -> float:
    """Pearson correlation; NaN for a constant quantity, 0 for a constant potential."""
    p, q = potential - potential.mean(), quantity - quantity.mean()
    negligible = 1e-9 * len(p) ** 1.5  # of ranks: rounding errors of a regression that leaves nothing
    p_norm, q_norm = np.linalg.norm(p), np.linalg.norm(q)
    if q_norm <= negligible:
        return float("nan")
    return 0.0 if p_norm <= negligible else float(p @ q / (p_norm * q_norm))


def _residual(ranks: np.ndarray, of_time: np.ndarray) -> np.ndarray:
    """Ranks after a linear regression on the ranks of time."""
    ranks, of_time = ranks - ranks.mean(), of_time - of_time.mean()
    variance = of_time @ of_time
    return ranks - (ranks @ of_time) / variance * of_time if variance > 0 else ranks


def _groups(labels: np.ndarray) -> list[np.ndarray]:
    """Indices of the frames with each label."""
    return [np.flatnonzero(labels == label) for label in np.unique(labels)]
