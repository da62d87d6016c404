"""The partial-order objective against the paper: equations (3) and (4), labels, gradients, the encoder leak."""

import math
from types import SimpleNamespace

import pytest
import torch as th
from torch import nn

from sb3_por.objectives import EncodedBatch, PartialOrder

FEATURES_DIM = 4


class TinyEncoder(nn.Sequential):
    """An encoder of frames that are vectors of three numbers."""

    def __init__(self):
        super().__init__(nn.Linear(3, 6), nn.Linear(6, FEATURES_DIM))


def paired(first, second):
    """
    A batch for each pairing whose pairs are ``(first, second)``: where the encoders are swapped, the first frame is the past
    and the second one the present.
    """
    half = len(first) // 2
    present, has_past = th.cat([second[:half], first[half:]]), th.ones(half, 1, dtype=th.bool)
    return dict(
        paper=EncodedBatch(first, future=second),
        swap=EncodedBatch(present, future=second, past=first[:half], has_past=has_past),
    )


@pytest.fixture
def frames():
    th.manual_seed(0)
    return SimpleNamespace(past=th.randn(4, 3), present=th.randn(8, 3), future=th.randn(8, 3))


class FixedLogits(nn.Module):
    """A classifier whose logit is 2 where the first quantity is larger than the second, else -1."""

    def forward(self, first, second):
        return th.where(first[:, 0] > second[:, 0], 2.0, -1.0)


def column(numbers):
    return th.tensor(numbers)[:, None]


@pytest.mark.parametrize("pairing", ["paper", "swap"])
def test_loss_is_equation_4_on_hand_computed_values(pairing):
    objective = PartialOrder(FEATURES_DIM, 1, pairing=pairing)
    objective.g, objective.c = nn.Identity(), FixedLogits()
    # Pair 0 is in order: c(x_t, x_t+k) = sigmoid(-1), c(x_t+k, x_t) = sigmoid(2); pair 1 is the other way round
    loss, metrics = objective.loss(paired(column([0.0, 5.0]), column([1.0, 3.0]))[pairing])
    c_low, c_high = 1 / (1 + math.exp(1)), 1 / (1 + math.exp(-2))
    pair_0 = -math.log(1 - c_low) - math.log(c_high)
    pair_1 = -math.log(1 - c_high) - math.log(c_low)
    assert loss.item() == pytest.approx((pair_0 + pair_1) / 2, abs=1e-6)
    assert metrics["loss"].item() == pytest.approx((pair_0 + pair_1) / 4, abs=1e-6)
    assert metrics["accuracy"].item() == 0.5


def test_label_0_is_earlier_first():
    objective = PartialOrder(FEATURES_DIM, 1)
    objective.g, objective.c = nn.Identity(), FixedLogits()
    assert objective.loss(paired(column([0.0, 1.0]), column([2.0, 3.0]))["swap"])[1]["accuracy"].item() == 1.0
    assert objective.loss(paired(column([2.0, 3.0]), column([0.0, 1.0]))["swap"])[1]["accuracy"].item() == 0.0


def test_ties_count_half():
    objective = PartialOrder(FEATURES_DIM, 1, order_head="difference")
    loss, metrics = objective.loss(paired(th.ones(4, FEATURES_DIM), th.ones(4, FEATURES_DIM))["swap"])
    assert loss.item() == pytest.approx(2 * math.log(2))
    assert metrics["accuracy"].item() == 0.5


@pytest.mark.parametrize("pairing", ["paper", "swap"])
@pytest.mark.parametrize("order_head", ["mlp", "difference", "coordinatewise"])
def test_gradients_reach_online_encoder_g_and_c(frames, pairing, order_head):
    objective, f_o, f_m = PartialOrder(FEATURES_DIM, 1, pairing=pairing, order_head=order_head), TinyEncoder(), TinyEncoder()
    has_past = column([True, True, False, True])
    with th.no_grad():
        future, past = f_m(frames.future), f_m(frames.past)
    objective.loss(EncodedBatch(f_o(frames.present), future=future, past=past, has_past=has_past))[0].backward()
    # A constant cancels in a difference
    cancels = {"difference": "c.net.2.bias", "coordinatewise": "g.2.bias"}.get(order_head)
    for name, parameter in [*objective.named_parameters(), *f_o.named_parameters()]:
        if name != cancels:
            assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_paper_pairing_has_the_present_first_and_the_future_second(frames):
    s_t, s_tk = PartialOrder(FEATURES_DIM, 1, pairing="paper").pairs(EncodedBatch(frames.present, future=frames.future))
    assert th.equal(s_t, frames.present) and th.equal(s_tk, frames.future)


def test_swap_pairing_has_the_present_second_in_half_of_the_batch_but_not_at_the_start_of_an_episode(frames):
    has_past = column([True, True, False, True])
    batch = EncodedBatch(frames.present, future=frames.future, past=frames.past, has_past=has_past)
    s_t, s_tk = PartialOrder(FEATURES_DIM, 1, pairing="swap").pairs(batch)
    past, present, future = frames.past, frames.present, frames.future
    assert th.equal(s_t, th.cat([past[:2], present[2:3], past[3:], present[4:]]))
    assert th.equal(s_tk, th.cat([present[:2], future[2:3], present[3:4], future[4:]]))


def test_sham_pairs_are_those_of_swap_in_an_order_drawn_by_chance():
    early, late = column([0.0] * 2000), column([1.0] * 2000)
    batch = EncodedBatch(early, future=late, past=early[:1000], has_past=column([False] * 1000))
    objective = PartialOrder(FEATURES_DIM, 1, pairing="sham")
    objective.g, objective.c = nn.Identity(), FixedLogits()
    th.manual_seed(0)
    s_t, s_tk = objective.pairs(batch)
    assert th.equal(s_t + s_tk, early + late)
    assert s_t.mean().item() == pytest.approx(0.5, abs=0.05)
    assert not th.equal(s_t, objective.pairs(batch)[0])
    assert objective.loss(batch)[1]["accuracy"].item() == pytest.approx(0.5, abs=0.05)
    objective.pairing = "swap"
    assert objective.loss(batch)[1]["accuracy"].item() == 1.0


@pytest.mark.parametrize("order_head", ["mlp", "difference", "coordinatewise"])
def test_learns_an_order_and_a_potential_that_follows_it(order_head):
    th.manual_seed(0)
    objective = PartialOrder(FEATURES_DIM, 1, order_head=order_head)
    optimizer = th.optim.Adam(objective.parameters(), lr=3e-3)
    for _ in range(300):
        features = th.randn(64, FEATURES_DIM)
        # Time is one direction in the features
        loss, metrics = objective.loss(paired(features, features + th.tensor([0.0, 0.5, 0.0, 0.0]))["swap"])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert metrics["accuracy"] > 0.95
    line = th.zeros(20, FEATURES_DIM)
    line[:, 1] = th.linspace(-1.5, 1.5, 20)
    with th.no_grad():
        ranks = objective.potential(line).argsort().argsort()
    assert th.corrcoef(th.stack([ranks.float(), th.arange(20.0)]))[0, 1] > 0.95


def train_on_frames_without_time(pairing):
    """POR with an encoder and its moving average on i.i.d. frames: there is nothing to learn but the encoder."""
    th.manual_seed(0)
    f_o, f_m = TinyEncoder(), TinyEncoder().requires_grad_(False)
    f_m.load_state_dict(f_o.state_dict())
    objective = PartialOrder(FEATURES_DIM, 1, pairing=pairing)
    optimizer = th.optim.Adam([*f_o.parameters(), *objective.parameters()], lr=1e-3)

    def encode(present, future, past):
        return EncodedBatch(f_o(present), future=f_m(future), past=f_m(past), has_past=th.ones(len(past), 1, dtype=th.bool))

    losses = []
    for _ in range(1000):
        loss, metrics = objective.loss(encode(th.randn(64, 3), th.randn(64, 3), th.randn(32, 3)))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(metrics["loss"].item())
        for online, momentum in zip(f_o.parameters(), f_m.parameters(), strict=True):
            momentum.lerp_(online.detach(), 0.05)
    frames = th.randn(4096, 3)
    with th.no_grad():
        control = objective.control(encode(frames, frames, frames[:2048]))
    return sum(losses[-100:]) / 100, control


def test_paper_pairing_tells_the_encoders_apart_where_there_is_no_time():
    loss, control = train_on_frames_without_time("paper")
    assert loss < 0.1
    assert control["leak_accuracy"] > 0.95


def test_swap_pairing_stays_at_chance_where_there_is_no_time():
    loss, control = train_on_frames_without_time("swap")
    assert loss == pytest.approx(math.log(2), abs=0.02)
    assert control["leak_loss"].item() == pytest.approx(math.log(2), abs=0.02)


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(pairing="random"), "pairing must be one of paper, swap"),
        (dict(order_head="linear"), "order_head must be one of mlp, difference, coordinatewise"),
        (dict(order_dim=FEATURES_DIM), "order_dim must be at least 1 and less than"),
        (dict(k=0), "k must be at least 1"),
    ],
)
def test_wrong_settings_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        PartialOrder(FEATURES_DIM, 1, **kwargs)
