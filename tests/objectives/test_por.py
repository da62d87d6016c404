"""The partial-order objective against the paper: equations (3) and (4), labels, gradients, the encoder leak."""

import math

import pytest
import torch as th
from torch import nn

from sb3_por.objectives import PartialOrder
from sb3_por.visual.views import Views

FEATURES_DIM = 4


class TinyCritic(nn.Module):
    """An owner of an encoder, as far as ``Views`` is concerned."""

    def __init__(self):
        super().__init__()
        self.trunk = nn.Linear(3, 6)
        self.projection = nn.Linear(6, FEATURES_DIM)


def make_views(critic, critic_target, obs, future):
    return Views(critic, critic_target, {"obs": obs, "next": future, "future": future})


@pytest.fixture
def views():
    th.manual_seed(0)
    return make_views(TinyCritic(), TinyCritic().requires_grad_(False), th.randn(8, 3), th.randn(8, 3))


class FixedLogits(nn.Module):
    """A classifier whose logit is 2 where the first quantity is larger than the second, else -1."""

    def forward(self, first, second):
        return th.where(first[:, 0] > second[:, 0], 2.0, -1.0)


class Identity(nn.Module):
    """Encoder and feature extractor that keep the number they see."""

    trunk = projection = staticmethod(lambda frame: frame)

    def forward(self, features):
        return features


def hand_views(earlier, later):
    return make_views(Identity(), Identity(), th.tensor(earlier)[:, None], th.tensor(later)[:, None])


@pytest.mark.parametrize("pairing", ["paper", "swap"])
def test_loss_is_equation_4_on_hand_computed_values(pairing):
    objective = PartialOrder(FEATURES_DIM, 1, pairing=pairing)
    objective.g, objective.c = Identity(), FixedLogits()
    # Pair 0 is in order: c(x_t, x_t+k) = sigmoid(-1), c(x_t+k, x_t) = sigmoid(2); pair 1 is the other way round
    loss, metrics = objective.loss(hand_views([0.0, 5.0], [1.0, 3.0]))
    c_low, c_high = 1 / (1 + math.exp(1)), 1 / (1 + math.exp(-2))
    pair_0 = -math.log(1 - c_low) - math.log(c_high)
    pair_1 = -math.log(1 - c_high) - math.log(c_low)
    assert loss.item() == pytest.approx((pair_0 + pair_1) / 2, abs=1e-6)
    assert metrics["loss"].item() == pytest.approx((pair_0 + pair_1) / 4, abs=1e-6)
    assert metrics["accuracy"].item() == 0.5


def test_label_0_is_earlier_first():
    objective = PartialOrder(FEATURES_DIM, 1)
    objective.g, objective.c = Identity(), FixedLogits()
    assert objective.loss(hand_views([0.0, 1.0], [2.0, 3.0]))[1]["accuracy"].item() == 1.0
    assert objective.loss(hand_views([2.0, 3.0], [0.0, 1.0]))[1]["accuracy"].item() == 0.0


def test_ties_count_half():
    objective = PartialOrder(FEATURES_DIM, 1, order_head="difference")
    views = make_views(Identity(), Identity(), th.ones(4, FEATURES_DIM), th.ones(4, FEATURES_DIM))
    loss, metrics = objective.loss(views)
    assert loss.item() == pytest.approx(2 * math.log(2))
    assert metrics["accuracy"].item() == 0.5


@pytest.mark.parametrize("pairing", ["paper", "swap"])
@pytest.mark.parametrize("order_head", ["mlp", "difference", "coordinatewise"])
def test_gradients_reach_online_encoder_g_and_c_and_nothing_else(views, pairing, order_head):
    objective = PartialOrder(FEATURES_DIM, 1, pairing=pairing, order_head=order_head)
    loss, _ = objective.loss(views)
    loss.backward()
    # A constant cancels in a difference
    cancels = {"difference": "c.net.2.bias", "coordinatewise": "g.2.bias"}.get(order_head)
    for name, parameter in [*objective.named_parameters(), *views.critic.named_parameters()]:
        if name != cancels:
            assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name
    assert all(parameter.grad is None for parameter in views.critic_target.parameters())


def test_paper_pairing_encodes_the_earlier_frame_online_and_the_later_with_momentum(views):
    s_t, s_tk = PartialOrder(FEATURES_DIM, 1, pairing="paper").pairs(views)
    assert th.equal(s_t, views.critic.projection(views.critic.trunk(views.frames["obs"])))
    assert th.equal(s_tk, views.critic_target.projection(views.critic_target.trunk(views.frames["future"])))


def test_swap_pairing_swaps_the_encoders_and_keeps_the_times_in_half_of_the_batch(views):
    s_t, s_tk = PartialOrder(FEATURES_DIM, 1, pairing="swap").pairs(views)
    online = {name: views.critic.projection(views.critic.trunk(views.frames[name])) for name in ("obs", "future")}
    momentum = {
        name: views.critic_target.projection(views.critic_target.trunk(views.frames[name])) for name in ("obs", "future")
    }
    th.testing.assert_close(s_t, th.cat([momentum["obs"][:4], online["obs"][4:]]))
    th.testing.assert_close(s_tk, th.cat([online["future"][:4], momentum["future"][4:]]))


def test_swap_pairing_takes_earlier_frames_in_half_of_the_batch_where_there_are_some(views):
    views.frames["past"] = th.randn(4, 3)
    views.data["past_gaps"] = th.tensor([1, 1, 0, 1])
    s_t, s_tk = PartialOrder(FEATURES_DIM, 1, pairing="swap").pairs(views)
    online = views.critic.projection(views.critic.trunk(views.frames["obs"]))
    future, past = (
        views.critic_target.projection(views.critic_target.trunk(views.frames[name])) for name in ("future", "past")
    )
    # Pair 2 is the first of its episode
    th.testing.assert_close(s_t, th.cat([past[:2], online[2:3], past[3:], online[4:]]))
    th.testing.assert_close(s_tk, th.cat([online[:2], future[2:3], online[3:4], future[4:]]))


@pytest.mark.parametrize("order_head", ["mlp", "difference", "coordinatewise"])
def test_learns_an_order_and_a_potential_that_follows_it(order_head):
    th.manual_seed(0)
    objective = PartialOrder(FEATURES_DIM, 1, order_head=order_head, hidden_dim=32)
    optimizer = th.optim.Adam(objective.parameters(), lr=3e-3)
    for _ in range(300):
        features = th.randn(64, FEATURES_DIM)
        # Time is one direction in the features
        views = make_views(Identity(), Identity(), features, features + th.tensor([0.0, 0.5, 0.0, 0.0]))
        loss, metrics = objective.loss(views)
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
    critic, critic_target = TinyCritic(), TinyCritic().requires_grad_(False)
    critic_target.load_state_dict(critic.state_dict())
    objective = PartialOrder(FEATURES_DIM, 1, pairing=pairing, hidden_dim=32)
    optimizer = th.optim.Adam([*critic.parameters(), *objective.parameters()], lr=1e-3)
    losses = []
    for _ in range(1000):
        loss, metrics = objective.loss(make_views(critic, critic_target, th.randn(64, 3), th.randn(64, 3)))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(metrics["loss"].item())
        for online, momentum in zip(critic.parameters(), critic_target.parameters(), strict=True):
            momentum.lerp_(online.detach(), 0.05)
    frames = th.randn(4096, 3)
    with th.no_grad():
        control = objective.control(make_views(critic, critic_target, frames, frames.clone()))
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
