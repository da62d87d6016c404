"""The controls of a learned order give the known answers on made episodes."""

import numpy as np
import pytest
from scipy.stats import spearmanr

from sb3_por.analysis.controls import (
    PlayedFrames,
    at_equal_time,
    clock,
    measure_controls,
    pairs_at_equal_time,
    pairs_within_episodes,
    partial_spearman,
    spearman,
    within_episodes,
)

N_EPISODES, N_STEPS = 20, 40


@pytest.fixture
def frames():
    """Pouring: the quantity grows from some step on, another in each episode, by jumps of different size."""
    rng = np.random.default_rng(0)
    step = np.tile(np.arange(N_STEPS), N_EPISODES)
    starts, jumps = rng.integers(5, 20, N_EPISODES), rng.integers(0, 3, (N_EPISODES, N_STEPS))
    quantity = np.cumsum(jumps * (np.arange(N_STEPS) >= starts[:, None]), axis=1).ravel()
    return PlayedFrames(np.repeat(np.arange(N_EPISODES), N_STEPS), step, quantity.astype(float))


def judge(potential):
    return lambda first, second: 0.5 + 0.5 * np.sign(potential[second] - potential[first])


def controls_of(frames, potential, k=1):
    return measure_controls(frames, potential, judge(potential), k)


def test_a_potential_that_tells_the_time_is_the_clock_and_nothing_more(frames):
    time = controls_of(frames, np.exp(frames.step / 10))
    assert time == clock(frames, 1)
    assert time.correlation > 0.9, "within an episode a clock looks like a gauge"
    assert time.partial_correlation == time.equal_time_correlation == 0
    assert time.pair_accuracy == time.pair_accuracy_unchanged == time.pair_accuracy_changed == 1
    assert time.equal_time_accuracy == 0.5


def test_a_potential_that_is_the_quantity_passes_every_control(frames):
    gauge = controls_of(frames, frames.quantity**3)
    assert gauge.correlation == gauge.partial_correlation == gauge.equal_time_correlation == pytest.approx(1)
    assert gauge.pair_accuracy_changed == gauge.equal_time_accuracy == 1
    assert gauge.pair_accuracy_unchanged == 0.5, "without a change there is nothing to tell"
    assert 0.5 < gauge.pair_accuracy < 1


def test_a_potential_that_is_noise_passes_none(frames):
    noise = controls_of(frames, np.random.default_rng(1).normal(size=len(frames)))
    assert noise.correlation == pytest.approx(0, abs=0.15) and noise.partial_correlation == pytest.approx(0, abs=0.15)
    assert noise.equal_time_correlation == pytest.approx(0, abs=0.15)
    for accuracy in (noise.pair_accuracy, noise.pair_accuracy_changed, noise.equal_time_accuracy):
        assert accuracy == pytest.approx(0.5, abs=0.1)


def test_time_and_quantity_are_told_apart_where_both_are_mixed(frames):
    mixed = controls_of(frames, frames.step + 0.05 * frames.quantity)
    assert mixed.pair_accuracy == 1 and mixed.correlation >= 0.9
    assert mixed.equal_time_accuracy == 1, "the time is equal there, so that the small part decides"


def test_correlations_are_those_of_the_textbook():
    rng = np.random.default_rng(2)
    a, b, c = rng.normal(size=(3, 50))
    b, c = a + b, np.round(a + c)
    ab, ac, bc = (spearmanr(*pair).statistic for pair in ((a, b), (a, c), (b, c)))
    assert spearman(a, b) == pytest.approx(ab)
    assert partial_spearman(a, b, c) == pytest.approx((ab - ac * bc) / np.sqrt((1 - ac**2) * (1 - bc**2)))


def test_what_cannot_be_measured_is_nan(frames):
    constant = PlayedFrames(frames.episode, frames.step, np.ones(len(frames)))
    unknown = PlayedFrames(frames.episode, frames.step, np.full(len(frames), np.nan))
    for silent in (constant, unknown):
        measured = controls_of(silent, frames.step)
        assert np.isnan([measured.correlation, measured.partial_correlation, measured.equal_time_correlation]).all()
        assert np.isnan([measured.pair_accuracy_changed, measured.equal_time_accuracy]).all()
        assert measured.pair_accuracy == 1
    assert controls_of(constant, frames.step).pair_accuracy_unchanged == 1
    assert np.isnan(controls_of(unknown, frames.step).pair_accuracy_unchanged)
    growing = PlayedFrames(frames.episode, frames.step, frames.step.astype(float))
    measured = controls_of(growing, frames.step)
    assert measured.correlation == pytest.approx(1) and np.isnan(measured.partial_correlation), "time determines it"
    two = PlayedFrames(np.repeat([0, 1], 5), np.tile(np.arange(5), 2), np.arange(10.0))
    assert len(at_equal_time(two, two.quantity)) == 0, "two episodes always correlate perfectly"


def test_episodes_in_which_the_quantity_is_constant_do_not_count(frames):
    still = np.where(frames.episode == 0, 7.0, frames.quantity)
    correlations = within_episodes(PlayedFrames(frames.episode, frames.step, still), frames.step)
    assert np.isnan(correlations[0]) and np.isfinite(correlations[1:]).all()


def test_pairs_stay_within_an_episode_or_at_one_step():
    frames = PlayedFrames(np.array([0, 0, 0, 1, 1]), np.array([0, 1, 2, 0, 1]), np.array([0.0, 3, 3, 0, 1]))
    earlier, later = pairs_within_episodes(frames, [1, 2])
    assert sorted(zip(earlier, later, strict=True)) == [(0, 1), (0, 2), (1, 2), (3, 4)]
    smaller, larger = pairs_at_equal_time(frames)
    assert list(zip(smaller, larger, strict=True)) == [(4, 1)]
