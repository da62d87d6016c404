"""The shared training step: who trains the encoder, how often what is updated, what is logged."""

import math
from unittest.mock import Mock

import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TransformReward
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import preprocess_obs
from toy_envs import DotEnv

from sb3_por import SACPOR, TQCPOR, SACDrQ, VisualSAC

POLICY = dict(net_arch=[16], features_extractor_kwargs=dict(features_dim=8, n_filters=4, strides=(2, 2)))


def make_model(cls=VisualSAC, env=None, policy="CnnPolicy", n_collected=30, **kwargs):
    defaults = dict(policy_kwargs=POLICY, buffer_size=200, learning_starts=1000, batch_size=8, seed=0, device="cpu")
    return cls(policy, env or DotEnv(falling=True), **{**defaults, **kwargs}).learn(n_collected)


def snapshot(parameters):
    return [parameter.detach().clone() for parameter in parameters]


def same(before, parameters):
    return all(th.equal(old, new) for old, new in zip(before, parameters, strict=True))


def test_actor_shares_the_critics_trunk_and_owns_its_projection():
    policy = make_model().policy
    assert policy.actor.features_extractor is policy.critic.features_extractor
    assert policy.actor.projection is not policy.critic.projection
    trained = {id(p) for group in policy.actor.optimizer.param_groups for p in group["params"]}
    assert not trained & {id(p) for p in policy.critic.parameters()}
    assert {id(p) for p in policy.actor.projection.parameters()} <= trained


def test_unshared_actor_trains_a_trunk_of_its_own():
    model = make_model(policy_kwargs=dict(POLICY, share_features_extractor=False))
    assert model.actor.features_extractor is not model.critic.features_extractor
    before = snapshot(model.actor.features_extractor.parameters())
    model.train(1, 8)
    assert not same(before, model.actor.features_extractor.parameters())


def test_critic_loss_trains_the_encoder_and_actor_loss_leaves_no_gradient_there():
    model = make_model()
    batch = model.sample(8)
    losses = model.losses(batch)
    losses.critic.backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in model.critic.encoder_parameters())
    model.critic.optimizer.zero_grad()
    before = snapshot(model.actor.own_parameters())
    model._step_actor(batch, losses)
    assert all(p.grad is None for p in model.critic.parameters())
    assert not same(before, model.actor.own_parameters())


def test_momentum_encoder_gets_no_gradient_and_follows_equation_3_exactly():
    model = make_model(SACPOR, encoder_tau=0.05, tau=0.01)
    for _ in range(3):
        momentum, target_heads = snapshot(model.critic_target.encoder_parameters()), snapshot(
            model.critic_target.head_parameters()
        )
        model.train(1, 8)
        assert all(p.grad is None for p in model.critic_target.parameters())
        for tau, old, new, online in (
            (0.05, momentum, model.critic_target.encoder_parameters(), model.critic.encoder_parameters()),
            (0.01, target_heads, model.critic_target.head_parameters(), model.critic.head_parameters()),
        ):
            for theta_m, updated, theta_o in zip(old, new, online, strict=True):
                th.testing.assert_close(updated, tau * theta_o.detach() + (1 - tau) * theta_m, rtol=1e-6, atol=1e-8)


def test_objective_and_critic_are_trained_by_one_loss_in_one_step():
    model = make_model(SACPOR)
    groups = model.critic.optimizer.param_groups
    expected = [*model.critic.parameters(), *model.policy.objective.parameters()]
    assert [id(p) for group in groups for p in group["params"]] == [id(p) for p in expected]
    before = snapshot(expected)
    model.train(1, 8)
    assert all(not th.equal(old, new) for old, new in zip(before, expected, strict=True))


def test_weight_0_trains_as_without_objective():
    plain, weightless = make_model(n_collected=20), make_model(SACPOR, n_collected=20, por_coef=0.0, pairing="paper")
    for model in (plain, weightless):
        model.encoder_tau = 0.05
        th.manual_seed(0)
        np.random.seed(0)
        model.train(4, 8)
    for one, other in zip(plain.critic.parameters(), weightless.critic.parameters(), strict=True):
        th.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)


def test_intervals_count_over_the_whole_training():
    model = make_model(actor_update_interval=3, target_update_interval=2)
    changed = []
    for _ in range(6):
        actor, target = snapshot(model.actor.own_parameters()), snapshot(model.critic_target.parameters())
        model.train(1, 8)
        changed.append((not same(actor, model.actor.own_parameters()), not same(target, model.critic_target.parameters())))
    assert changed == [(False, False), (False, True), (True, False), (False, True), (False, False), (True, True)]


@pytest.mark.parametrize("ratio", [1.0, 10.0])
def test_temperature_has_a_learning_rate_of_its_own(ratio):
    model = make_model(ent_coef="auto_0.1", learning_rate=1e-3, ent_coef_lr_ratio=ratio)
    before = model.log_ent_coef.item()
    model.train(1, 8)
    # Adam's first step is as long as its learning rate
    assert abs(model.log_ent_coef.item() - before) == pytest.approx(1e-3 * ratio, rel=1e-2)
    assert {group["lr"] for group in model.actor.optimizer.param_groups} == {1e-3}


def count_encodings(model):
    """Rows that pass each trunk in one update."""
    rows = {}
    for name, critic in (("online", model.critic), ("momentum", model.critic_target)):
        rows[name] = []
        critic.features_extractor.register_forward_hook(lambda _m, args, _o, name=name: rows[name].append(len(args[0])))
    model.train(1, 8)
    return {name: sum(counts) for name, counts in rows.items()}


@pytest.mark.parametrize(
    "cls, kwargs, expected",
    [
        # o_t and o_{t+1} online, o_{t+1} momentum
        (VisualSAC, {}, dict(online=16, momentum=8)),
        # The objective shares them all in the paper's pairing at k = 1
        (SACPOR, dict(pairing="paper"), dict(online=16, momentum=8)),
        # Half of the earlier frames pass f_m too
        (SACPOR, dict(pairing="swap"), dict(online=16, momentum=12)),
        (SACPOR, dict(pairing="paper", k=2), dict(online=16, momentum=16)),
    ],
)
def test_each_frame_passes_each_encoder_once(cls, kwargs, expected):
    assert count_encodings(make_model(cls, **kwargs)) == expected


def test_reward_scale_scales_the_target():
    model = make_model(reward_scale=3.0, gamma=0.0)
    targets = []
    critic_loss = model._critic_loss
    model._critic_loss = lambda features, actions, target: targets.append(target) or critic_loss(features, actions, target)
    np.random.seed(0)
    model.train(1, 8)
    np.random.seed(0)
    th.testing.assert_close(targets[0], 3.0 * model.sample(8).rewards)


@pytest.mark.parametrize(("cls", "n_steps"), [(VisualSAC, 1), (VisualSAC, 3), (TQCPOR, 1)])
def test_values_may_start_at_what_the_mean_reward_is_worth(cls, n_steps):
    def q_values(start):
        env = TransformReward(DotEnv(), lambda reward: -2.0)
        model = make_model(cls, env, gamma=0.9, reward_scale=3.0, n_steps=n_steps, start_at_mean_reward=start)
        model._start_values = Mock(wraps=model._start_values)
        model.train(1, 8)
        model.train(1, 8)
        assert model._start_values.call_count == int(start)
        data = model.sample(30)
        with th.no_grad():
            return [th.stack(list(net(data.observations, data.actions))).mean() for net in (model.critic, model.critic_target)]

    # The sum of 0.9^t times -2 times 3 over all steps: 10 times -6
    assert q_values(True) == pytest.approx([-60.0] * 2, abs=2.0)
    assert q_values(False) == pytest.approx([0.0] * 2, abs=2.0)


def test_starting_at_the_mean_reward_needs_a_discount():
    with pytest.raises(ValueError, match="gamma < 1"):
        make_model(gamma=1.0, start_at_mean_reward=True)


def share_of_switching_units(**kwargs):
    """Of the last hidden layer, where rewards are far below 0."""
    env = TransformReward(DotEnv(), lambda reward: 20 * (reward - 10.0))
    model = make_model(env=env, n_collected=100, gamma=0.95, learning_rate=1e-3, **kwargs)
    model.train(200, 8)
    data = model.sample(200)
    with th.no_grad():
        hidden = th.cat([model.critic.encode(data.observations), data.actions], dim=1)
        hidden = model.critic.q_networks[0][:-1](hidden)
    active = (hidden > 0).float().mean(dim=0)
    return ((active > 0) & (active < 1)).float().mean().item()


@pytest.mark.parametrize("layer_norm", [False, True])
def test_hidden_units_stay_between_always_and_never_where_values_start_at_the_mean_reward(layer_norm):
    policy_kwargs = dict(POLICY, critic_layer_norm=layer_norm)
    started = share_of_switching_units(policy_kwargs=policy_kwargs, start_at_mean_reward=True)
    assert started > share_of_switching_units(policy_kwargs=policy_kwargs) + 0.2


@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize("cls", [VisualSAC, TQCPOR])
def test_layer_norm_of_the_actor_is_trained_and_follows(cls, share, tmp_path):
    model = make_model(cls, policy_kwargs=dict(POLICY, actor_layer_norm=True, share_features_extractor=share))
    kinds = [type(layer).__name__ for layer in model.actor.latent_pi]
    assert kinds == ["Linear", "LayerNorm", "ReLU"] * (len(kinds) // 3)
    norms = [layer.weight for layer in model.actor.latent_pi if isinstance(layer, th.nn.LayerNorm)]
    before = snapshot(norms)
    model.train(2, 8)
    assert norms and all(not th.equal(*pair) for pair in zip(before, norms, strict=True))
    model.policy.save(tmp_path / "policy.pth")
    loaded = type(model.policy).load(tmp_path / "policy.pth", device="cpu")
    assert all(map(th.equal, model.actor.state_dict().values(), loaded.actor.state_dict().values()))


@pytest.mark.parametrize("cls", [VisualSAC, TQCPOR])
def test_layer_norm_of_the_critics_is_trained_and_follows(cls):
    model = make_model(cls, policy_kwargs=dict(POLICY, critic_layer_norm=True))
    names = [name for name, _ in model.critic.named_parameters() if name.startswith("qf")]
    assert names == [name for name, _ in model.critic_target.named_parameters() if name.startswith("qf")]
    for critic in (model.critic, model.critic_target):
        for index, head in enumerate(critic.q_networks):
            kinds = [type(layer).__name__ for layer in head]
            assert kinds == ["Linear", "LayerNorm", "ReLU"] * (len(kinds) // 3) + ["Linear"]
            assert getattr(critic, f"qf{index}") is head
    before = snapshot(model.critic.head_parameters()), snapshot(model.critic_target.head_parameters())
    model.train(2, 8)
    for old, new in zip(before, (model.critic.head_parameters(), model.critic_target.head_parameters()), strict=True):
        assert all(not th.equal(*pair) for pair in zip(old, new, strict=True))


def test_k_and_m_augmentations_are_averaged():
    model = make_model(n_augmentations=2, n_target_augmentations=2, augmentation_pad=0)
    assert count_encodings(model) == dict(online=32, momentum=16)
    frames = model._augmentation.frames(model.sample(4), None, 3, 2)
    assert (len(frames.present), len(frames.next)) == (12, 8)


def test_augmentations_average_losses_and_targets():
    """With K = M = 2 copies of the same frames the loss is that of one."""
    losses = []
    for n in (1, 2):
        model = make_model(n_augmentations=n, n_target_augmentations=n, augmentation_pad=0, gamma=0.0)
        np.random.seed(0)
        losses.append(model.losses(model.sample(8)).critic.item())
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)


def test_frames_are_augmented_independently():
    model = make_model(SACPOR, augmentation_pad=4)
    th.manual_seed(0)
    batch = model.sample(64)
    first, second = model._augmentation(batch.observations), model._augmentation(batch.observations)
    twice = model._augmentation(batch.observations, 2)
    assert len(twice) == 128 and not th.equal(twice[:64], twice[64:])
    assert not th.equal(first, second)
    assert first.dtype == th.float32 and first.max() <= 1.0


def test_logs_objective_control_and_gradient_norms():
    model = make_model(SACPOR, diagnostics_interval=2)
    model.train(2, 8)
    logged = model.logger.name_to_value
    expected = {"por_loss", "por_accuracy", "por_leak_loss", "por_leak_accuracy", "critic_loss", "actor_loss", "ent_coef"}
    expected |= {"ent_coef_loss", "entropy", "n_updates", "encoder_grad_norm_critic", "encoder_grad_norm_por"}
    assert {f"train/{name}" for name in expected} <= set(logged)
    assert all(math.isfinite(logged[f"train/{name}"]) for name in expected)
    assert logged["train/encoder_grad_norm_por"] > 0


def test_what_is_logged_is_the_mean_of_all_updates_since_the_last_time():
    model, values = make_model(SACPOR), iter([1.0, 3.0, 8.0])
    model._update = lambda batch_size: model._metrics.add("value", th.tensor(next(values)))
    model.train(1, 8)
    model.train(1, 8)
    assert model.logger.name_to_value["train/value"] == 2.0
    model.logger.dump()
    model.train(1, 8)
    assert model.logger.name_to_value["train/value"] == 8.0


def test_diagnostics_do_not_change_the_gradient():
    parameters = []
    for interval in (1, 10_000):
        model = make_model(SACPOR, diagnostics_interval=interval, augmentation_pad=0)
        np.random.seed(0)
        th.manual_seed(0)
        model.train(1, 8)
        parameters.append(snapshot(model.policy.parameters()))
    assert same(*parameters)


def test_k_needs_a_buffer_that_knows_episodes():
    with pytest.raises(ValueError, match="ReplayBuffer cannot sample the later frames that SACPOR needs"):
        make_model(SACPOR, k=3, replay_buffer_class=ReplayBuffer)
    make_model(SACPOR, k=1, replay_buffer_class=ReplayBuffer).train(2, 8)


@pytest.mark.parametrize(
    "kwargs", [dict(k=3), dict(k=3, random_k=True), dict(n_steps=3), dict(pairing="paper", n_steps=2, k=2)]
)
def test_later_frames_and_n_step_returns_go_together(kwargs):
    make_model(SACPOR, **kwargs).train(2, 8)


@pytest.mark.parametrize("obs_type, policy", [("state", "MlpPolicy"), ("dict", "MultiInputPolicy")])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_vectors_and_dicts(obs_type, policy, n_steps):
    model = SACPOR(
        policy,
        DotEnv(obs_type=obs_type),
        n_steps=n_steps,
        buffer_size=100,
        learning_starts=10,
        policy_kwargs=dict(net_arch=[8]),
    )
    model.learn(25)
    assert model._n_updates == 15


def test_too_small_images_are_refused():
    with pytest.raises(ValueError, match="16x16 pixels are too small for 3x3 convolutions with strides"):
        VisualSAC("CnnPolicy", DotEnv(size=16), buffer_size=10)


def test_networks_start_the_same_with_and_without_objective():
    plain, por = make_model(n_collected=1), make_model(SACPOR, n_collected=1)
    assert same(snapshot(plain.policy.critic.parameters()), por.policy.critic.parameters())
    assert same(snapshot(plain.policy.actor.parameters()), por.policy.actor.parameters())


def test_is_an_sb3_sac():
    assert issubclass(SACPOR, SAC) and issubclass(VisualSAC, SAC)


def test_takes_sb3s_arguments_in_sb3s_order():
    model = SACPOR("CnnPolicy", DotEnv(), 1e-3, 1000, 50, 16, 0.02, 0.9, 2)
    assert (model.learning_rate, model.buffer_size, model.batch_size, model.tau, model.gamma) == (1e-3, 1000, 16, 0.02, 0.9)


@pytest.mark.parametrize(
    ("cls", "tau", "expected"), [(VisualSAC, 0.01, 0.01), (SACDrQ, 0.01, 0.01), (SACPOR, 0.01, 0.05), (SACPOR, 0.5, 1.0)]
)
def test_momentum_encoder_follows_tau_unless_told(cls, tau, expected):
    assert make_model(cls, tau=tau).momentum_tau == pytest.approx(expected)
    assert make_model(cls, tau=tau, encoder_tau=0.3).momentum_tau == 0.3


@pytest.mark.parametrize("policy, obs_type, extractor", [("CnnPolicy", "pixels", POLICY), ("MultiInputPolicy", "dict", {})])
def test_observations_are_preprocessed_as_sb3_does(policy, obs_type, extractor):
    model = VisualSAC(policy, DotEnv(obs_type=obs_type), policy_kwargs=extractor, buffer_size=50, learning_starts=100).learn(
        30
    )
    observations = model.replay_buffer.sample(8).observations
    before = {key: part.clone() for key, part in observations.items()} if obs_type == "dict" else observations.clone()
    ours, theirs = model.policy.preprocess(observations), preprocess_obs(observations, model.observation_space)
    for one, other, given, kept in zip(*map(parts_of, (ours, theirs, observations, before)), strict=True):
        assert one.dtype == th.float32 and th.equal(one, other)
        assert th.equal(given, kept)


def parts_of(observations):
    return list(observations.values()) if isinstance(observations, dict) else [observations]
