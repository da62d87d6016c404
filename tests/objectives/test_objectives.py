"""CURL, SPR and MR.Q's objective on tasks that only they can explain; every algorithm runs, saves and learns."""

import math

import pytest
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy
from torch import nn
from toy_envs import DotEnv

from sb3_por import ALGORITHMS, SACCURL, SACMRQ, SACPOR, SACSPR, TQCPOR, SACDrQ, VisualTQC
from sb3_por.objectives import Contrastive, EncodedBatch, ModelBased, SelfPredictive
from sb3_por.objectives.mrq import two_hot

POLICY = dict(net_arch=[16], features_extractor_kwargs=dict(features_dim=8, n_filters=4, strides=(2, 2)))


class LinearEncoder(nn.Module):
    """A trunk and a projection."""

    def __init__(self, in_dim, out_dim):
        super().__init__()
        self.trunk = nn.Linear(in_dim, out_dim)
        self.projection = nn.Sequential(nn.LayerNorm(out_dim), nn.Tanh())

    def forward(self, frames):
        return self.projection(self.trunk(frames))


def encode(f_o, f_m, obs, positive=None, window=None, **actions):
    """The batch of an objective from frames that are vectors."""
    with th.no_grad():
        others = {name: f_m(frames) for name, frames in dict(positive=positive, window=window).items() if frames is not None}
    return EncodedBatch(f_o(obs), **others, **actions)


def train(objective, make_frames, in_dim=6, n_updates=400):
    """Train an encoder with the objective alone and a momentum encoder after it; returns both and the last metrics."""
    encoder, momentum = LinearEncoder(in_dim, objective.features_dim), LinearEncoder(in_dim, objective.features_dim)
    momentum.load_state_dict(encoder.state_dict())
    momentum.requires_grad_(False)
    parameters = [p for p in [*encoder.parameters(), *objective.parameters()] if p.requires_grad]
    optimizer = th.optim.Adam(parameters, lr=3e-3)
    for _ in range(n_updates):
        loss, metrics = objective.loss(encode(encoder, momentum, **make_frames()))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        for online, average in zip(encoder.parameters(), momentum.parameters(), strict=True):
            average.lerp_(online.detach(), 0.05)
        objective.update_momentum(0.05)
    return encoder, metrics


def test_curl_recognises_frames_by_what_augmentation_leaves():
    th.manual_seed(0)

    def frames():
        # Three numbers say which frame it is, three are noise that each augmentation draws anew
        content = th.randn(32, 3)
        obs, positive = (th.cat([content, 3 * th.randn(32, 3)], dim=1) for _ in range(2))
        return {"obs": obs, "positive": positive}

    encoder, metrics = train(Contrastive(8, 1), frames, n_updates=600)
    # Chance is an accuracy of 1/32
    assert metrics["accuracy"] > 0.3 and metrics["loss"] < 0.6 * math.log(32)
    weight = encoder.trunk.weight
    assert weight[:, :3].norm() > 2 * weight[:, 3:].norm()


def test_curl_is_at_chance_where_the_positive_is_another_frame():
    th.manual_seed(0)
    _, metrics = train(Contrastive(8, 1), lambda: {"obs": th.randn(32, 6), "positive": th.randn(32, 6)}, n_updates=100)
    assert metrics["loss"] > 0.9 * math.log(32)


def make_rollouts(actions_shown):
    """A point moves as the actions say; the objective may be shown other actions."""
    start, actions = th.randn(64, 2), th.randn(64, 3, 2)
    window = start[:, None] + actions.cumsum(dim=1)
    rewards = window[:, :, 0]
    shown = {"window_actions": actions_shown(actions), "window_rewards": rewards, "window_mask": th.ones(64, 3)}
    return {"obs": start, "window": window, **shown}


def test_spr_predicts_what_the_actions_do():
    losses = {}
    for name, shown in (("true", lambda actions: actions), ("other", th.randn_like)):
        th.manual_seed(0)
        objective = SelfPredictive(8, 2, horizon=3)
        _, metrics = train(objective, lambda shown=shown: make_rollouts(shown), in_dim=2)
        losses[name] = metrics["loss"].item()
    assert losses["true"] < 0.5 * losses["other"]


def test_spr_ignores_what_is_after_the_episode():
    th.manual_seed(0)
    objective = SelfPredictive(8, 2, horizon=3)
    encoder = LinearEncoder(2, 8)
    rollouts = make_rollouts(lambda actions: actions)
    rollouts["window_mask"][:, 1:] = 0
    loss, _ = objective.loss(encode(encoder, encoder, **rollouts))
    rollouts["window"][:, 1:] += 5
    rollouts["window_actions"][:, 1:] += 5
    th.testing.assert_close(objective.loss(encode(encoder, encoder, **rollouts))[0], loss)


def test_spr_loss_is_the_sum_over_steps_of_2_minus_2_cosines():
    th.manual_seed(0)
    objective = SelfPredictive(8, 2, horizon=3)
    encoder = LinearEncoder(2, 8)
    rollouts = make_rollouts(lambda actions: actions)
    loss, metrics = objective.loss(encode(encoder, encoder, **rollouts))
    latent, total = encoder(rollouts["obs"]), 0.0
    targets = objective.momentum_projector(encoder(rollouts["window"]))
    for k in range(3):
        latent = objective.model(th.cat([latent, rollouts["window_actions"][:, k]], dim=1))
        prediction = objective.predictor(objective.projector(latent))
        prediction, target = (vector / vector.norm(dim=1, keepdim=True) for vector in (prediction, targets[:, k]))
        total = total + (prediction - target).square().sum(dim=1).mean()
    assert loss.item() == pytest.approx(total.item(), rel=1e-5)
    assert metrics["loss"].item() == pytest.approx(total.item() / 3, rel=1e-5)


def test_mrq_predicts_what_the_actions_do_and_earn():
    metrics = {}
    for name, shown in (("true", lambda actions: actions), ("other", th.randn_like)):
        th.manual_seed(0)
        objective = ModelBased(8, 2, horizon=3)
        metrics[name] = train(objective, lambda shown=shown: make_rollouts(shown), in_dim=2)[1]
    assert metrics["true"]["dynamics_error"] < 0.5 * metrics["other"]["dynamics_error"]
    assert metrics["true"]["reward_loss"] < 0.8 * metrics["other"]["reward_loss"]


def test_mrq_ignores_what_is_after_the_episode():
    th.manual_seed(0)
    objective, encoder = ModelBased(8, 2, horizon=3), LinearEncoder(2, 8)
    rollouts = make_rollouts(lambda actions: actions)
    rollouts["window_mask"][:, 1:] = 0
    loss, metrics = objective.loss(encode(encoder, encoder, **rollouts))
    for name in ("window", "window_actions", "window_rewards"):
        rollouts[name][:, 1:] += 5
    again, metrics_again = objective.loss(encode(encoder, encoder, **rollouts))
    th.testing.assert_close(again, loss)
    th.testing.assert_close(metrics_again, metrics)


def test_mrq_loss_is_the_sum_over_steps_of_the_errors_of_features_and_rewards():
    th.manual_seed(0)
    objective, encoder = ModelBased(8, 2, horizon=3), LinearEncoder(2, 8)
    rollouts = make_rollouts(lambda actions: actions)
    loss, _ = objective.loss(encode(encoder, encoder, **rollouts))
    latent, total = encoder(rollouts["obs"]), 0.0
    for k in range(3):
        outputs = objective.model(th.cat([latent, rollouts["window_actions"][:, k]], dim=1))
        latent, log_probabilities = outputs[:, :8], outputs[:, 8:].log_softmax(dim=1)
        total += (latent - encoder(rollouts["window"][:, k])).square().mean()
        total += 0.1 * -(two_hot(rollouts["window_rewards"][:, k]) * log_probabilities).sum(dim=1).mean()
    assert loss.item() == pytest.approx(total.item(), rel=1e-5)


@pytest.mark.parametrize("value", [0.0, 0.3, -7.0, 1e4])
def test_two_hot_weights_keep_the_value(value):
    weights = two_hot(th.tensor([value]))
    assert weights.sum().item() == pytest.approx(1.0) and (weights > 0).sum() <= 2
    symlog = (weights * th.linspace(-10, 10, 65)).sum()
    assert (symlog.sign() * symlog.abs().expm1()).item() == pytest.approx(value, rel=1e-3, abs=1e-5)


def test_two_hot_holds_at_the_largest_value():
    assert two_hot(th.tensor([1e9]))[0, -1] == 1.0


@pytest.mark.parametrize(
    "make", [lambda: Contrastive(8, 2), lambda: SelfPredictive(8, 2, horizon=3), lambda: ModelBased(8, 2, horizon=3)]
)
def test_gradients_reach_online_encoder_and_objective_and_nothing_else(make):
    th.manual_seed(0)
    objective, encoder, momentum = make(), LinearEncoder(2, 8), LinearEncoder(2, 8).requires_grad_(False)
    rollouts = make_rollouts(lambda actions: actions)
    objective.loss(encode(encoder, momentum, positive=rollouts["obs"] + 0.1, **rollouts))[0].backward()
    trained = [*encoder.parameters(), *(p for p in objective.parameters() if p.requires_grad)]
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in trained)
    assert all(p.grad is None for p in momentum.parameters())


def make_model(cls, env=None, **kwargs):
    defaults = dict(policy_kwargs=POLICY, buffer_size=300, learning_starts=20, batch_size=8, seed=0, device="cpu")
    return cls("CnnPolicy", env or DotEnv(size=20, falling=True), **{**defaults, **kwargs})


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_trains_saves_and_goes_on(name, tmp_path):
    model = make_model(ALGORITHMS[name], diagnostics_interval=5).learn(40)
    assert all(math.isfinite(value) for key, value in model.logger.name_to_value.items() if key.startswith("train/"))
    model.save(tmp_path / "model.zip")
    loaded = ALGORITHMS[name].load(tmp_path / "model.zip", env=DotEnv(size=20, falling=True), device="cpu")
    for (key, one), other in zip(model.policy.state_dict().items(), loaded.policy.state_dict().values(), strict=True):
        assert th.equal(one, other), key
    assert len(loaded.critic.optimizer.state) == len(model.critic.optimizer.state) > 0
    loaded.learn(10, reset_num_timesteps=False)
    assert loaded.num_timesteps == 50


@pytest.mark.parametrize("kwargs", [dict(use_sde=True), dict(ent_coef=0.1, n_steps=2)])
def test_tqc_keeps_exploration_and_n_step_options(kwargs):
    make_model(TQCPOR, **kwargs).learn(30)


def test_tqc_target_drops_the_top_quantiles():
    model = make_model(VisualTQC, top_quantiles_to_drop_per_net=3)
    features, actions = th.randn(4, 8), th.randn(4, 1)
    values = model._next_values(features, actions, th.zeros(4, 1))
    everything = model.critic_target.quantiles(features, actions).flatten(1)
    assert values.shape == (4, 2 * 25 - 2 * 3)
    assert th.equal(values, everything.sort(dim=1).values[:, :44])


def test_momentum_projector_follows_the_projector():
    model = make_model(SACSPR, tau=0.01).learn(21)
    spr = model.policy.objective
    before = [p.clone() for p in spr.momentum_projector.parameters()]
    model.train(1, 8)
    for theta_m, old, theta_o in zip(spr.momentum_projector.parameters(), before, spr.projector.parameters(), strict=True):
        th.testing.assert_close(theta_m, 0.05 * theta_o.detach() + 0.95 * old)


def test_drq_has_one_tau_and_two_augmentations_of_each():
    model = make_model(SACDrQ)
    assert (model.momentum_tau, model.n_augmentations, model.n_target_augmentations) == (model.tau, 2, 2)


@pytest.mark.parametrize("cls", [SACCURL, SACSPR, SACMRQ])
def test_the_critic_cannot_drown_out_an_objective_with_an_optimizer_of_its_own(cls):
    moved = []
    for reward_scale in (1.0, 1e6):
        model = make_model(cls, reward_scale=reward_scale, aux_lr_ratio=0.5, learning_rate=1e-3).learn(21)
        optimizer, critic_optimizer = model.policy.objective_optimizer, model.critic.optimizer
        assert optimizer.param_groups[0]["lr"] == 0.5 * critic_optimizer.param_groups[0]["lr"]
        owned = {id(parameter) for parameter in optimizer.param_groups[0]["params"]}
        trained = [*model.critic.encoder_parameters(), *model.policy.objective.parameters()]
        assert owned == {id(parameter) for parameter in trained if parameter.requires_grad}
        critic_optimizer.step = lambda: None
        before = [parameter.detach().clone() for parameter in model.critic.encoder_parameters()]
        model.train(1, 8)
        after = model.critic.encoder_parameters()
        moved.append(max((a - b).abs().max().item() for a, b in zip(after, before, strict=True)))
    # Adam's steps are as large as its learning rate, whatever else pulls
    assert moved[0] == pytest.approx(moved[1], rel=0.5) and 1e-4 < moved[1] < 3e-3


def test_an_objective_without_one_is_trained_with_the_critic():
    model = make_model(SACPOR)
    assert model.policy.objective_optimizer is None
    owned = {id(parameter) for parameter in model.critic.optimizer.param_groups[0]["params"]}
    assert {id(parameter) for parameter in model.policy.objective.parameters()} <= owned


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.timeout(900)
def test_every_algorithm_improves_from_pixels(name):
    env = DotEnv(size=20, falling=True)
    kwargs = dict(horizon=2) if name in ("sac_spr", "sac_mrq") else {}
    model = make_model(
        ALGORITHMS[name],
        env,
        learning_rate=1e-3,
        buffer_size=2000,
        learning_starts=100,
        batch_size=16,
        gamma=0.9,
        ent_coef="auto_0.1",
        augmentation_pad=1,
        policy_kwargs=dict(net_arch=[32, 32], features_extractor_kwargs=dict(n_filters=8, strides=(2, 2))),
        **kwargs,
    )
    before, _ = evaluate_policy(model, env, 10, warn=False)
    model.learn(700)
    after, _ = evaluate_policy(model, env, 10, warn=False)
    # Of 20; staying where the episode begins, as at random, gives 10 on average
    assert after > 16.5 > before
