"""A balanced weight (``por_coef="auto_0.1"``) keeps POR's gradient at the encoder at a ratio to the critic's."""

import math

import pytest
import torch as th
from toy_envs import DotEnv

from sb3_por import SACCURL, SACPOR, TQCPOR
from sb3_por.visual.balance import INTERVAL, SMOOTHING, EncoderGradients, GradientBalance, gradient_ratio

POLICY = dict(net_arch=[16], features_extractor_kwargs=dict(features_dim=8, n_filters=4, strides=(2, 2)))
CPU = th.device("cpu")


def make_model(cls=SACPOR, **kwargs):
    defaults = dict(policy_kwargs=POLICY, buffer_size=200, learning_starts=1000, batch_size=8, seed=0, device="cpu")
    return cls("CnnPolicy", DotEnv(falling=True), **{**defaults, **kwargs}).learn(60)


def gradients(critic, objective):
    return EncoderGradients(th.tensor(critic), th.tensor(objective))


@pytest.mark.parametrize(("coef", "ratio"), [("auto", 0.1), ("auto_0.3", 0.3), ("auto_2", 2.0), (100.0, None), (0.0, None)])
def test_the_grammar_is_that_of_the_temperature(coef, ratio):
    assert gradient_ratio(coef, "por_coef") == ratio


@pytest.mark.parametrize("cls", [SACPOR, TQCPOR])
def test_the_gradients_of_the_first_update_have_the_ratio(cls):
    model = make_model(cls, por_coef="auto_0.25", diagnostics_interval=1)
    model.train(1, 8)
    logged = {name.removeprefix("train/"): value for name, value in model.logger.name_to_value.items()}
    ratio = logged["encoder_grad_norm_por"] / logged["encoder_grad_norm_critic"]
    assert ratio == pytest.approx(0.25, rel=1e-5)
    assert logged["por_coef"] > 0 and -1 <= logged["encoder_grad_cosine"] <= 1


def mean_ratio(**kwargs):
    """Ratio of the mean norms of the two gradients over 100 updates."""
    model = make_model(diagnostics_interval=2, learning_rate=1e-3, **kwargs)
    model.train(100, 8)
    logged = model.logger.name_to_value
    return logged["train/encoder_grad_norm_por"] / logged["train/encoder_grad_norm_critic"]


def test_the_ratio_is_the_same_for_all_scales_of_rewards():
    """A fixed weight must be chosen for each."""
    assert all(0.05 < mean_ratio(por_coef="auto_0.1", reward_scale=scale) < 0.2 for scale in (1.0, 100.0))
    assert mean_ratio(por_coef=1.0, reward_scale=1.0) > 10 * mean_ratio(por_coef=1.0, reward_scale=100.0)


def test_the_weight_is_the_one_that_the_encoder_is_trained_with():
    """Adam's moving average of the first gradient is a tenth of the gradient of L_RL + lambda L_POR."""
    model = make_model(por_coef="auto_0.5")
    seen = []
    encoder_gradients = model.encoder_gradients
    model.encoder_gradients = lambda losses: seen.append(encoder_gradients(losses)) or seen[-1]
    model.train(1, 8)
    critic, objective = seen[0]
    weight = 0.5 * critic.norm() / objective.norm()
    trained = th.cat([model.critic.optimizer.state[p]["exp_avg"].flatten() for p in model.critic.encoder_parameters()])
    th.testing.assert_close(trained, 0.1 * (critic + weight * objective), rtol=1e-4, atol=1e-7)


def test_gradients_are_measured_now_and_averaged():
    model = make_model(por_coef="auto_0.1")
    counts = []
    encoder_gradients = model.encoder_gradients
    model.encoder_gradients = lambda losses: counts.append(model._n_updates) or encoder_gradients(losses)
    model.train(INTERVAL, 8)
    model.train(INTERVAL + 1, 8)
    assert counts == [1, 1 + INTERVAL, 1 + 2 * INTERVAL]


def test_norms_are_averaged_not_their_quotients():
    balance = GradientBalance(0.1, CPU)
    assert math.isnan(balance.weight)
    balance.measure(gradients([3.0, 4.0], [0.0, 2.0]))
    assert balance.weight == pytest.approx(0.1 * 5 / 2)
    balance.measure(gradients([0.0, 0.0], [0.0, 12.0]))
    assert balance.weight == pytest.approx(0.1 * 5 * (1 - SMOOTHING) / (2 * (1 - SMOOTHING) + 12))


def test_a_norm_that_overflows_does_not_spoil_the_averages():
    balance = GradientBalance(0.1, CPU)
    balance.measure(gradients([3.0], [2.0]))
    for broken in (th.inf, th.nan):
        balance.measure(gradients([broken], [2.0]))
        balance.measure(gradients([3.0], [broken]))
    assert balance.weight == pytest.approx(0.1 * 3 / 2)
    balance.measure(gradients([3.0], [2.0]))
    assert balance.weight == pytest.approx(0.1 * 3 / 2)


def test_an_objective_without_a_gradient_has_no_weight():
    balance = GradientBalance(0.1, CPU)
    balance.measure(gradients([1.0], [0.0]))
    assert balance.weight == 0.0


@pytest.mark.parametrize(
    ("critic", "objective", "cosine"),
    [([1.0, 0.0], [3.0, 0.0], 1.0), ([1.0, 0.0], [-2.0, 0.0], -1.0), ([1.0, 0.0], [0.0, 5.0], 0.0), ([1.0], [0.0], 0.0)],
)
def test_the_cosine_tells_whether_the_losses_agree(critic, objective, cosine):
    assert gradients(critic, objective).cosine().item() == pytest.approx(cosine)


def test_a_loaded_model_may_change_the_weight(tmp_path):
    model = make_model(por_coef="auto_0.1")
    model.train(15, 8)
    model.save(tmp_path / "balanced.zip")
    loaded = SACPOR.load(tmp_path / "balanced.zip", device="cpu")
    assert th.equal(loaded.objective_weight, model.objective_weight)
    assert SACPOR.load(tmp_path / "balanced.zip", device="cpu", por_coef=2.0).objective_weight == 2.0
    make_model(por_coef=2.0).save(tmp_path / "fixed.zip")
    assert SACPOR.load(tmp_path / "fixed.zip", device="cpu", por_coef="auto_0.1")._balance.norms.isnan().all()


def test_an_objective_with_an_optimizer_of_its_own_has_nothing_to_balance():
    class Balanced(SACCURL):
        objective_coef = "auto_0.1"

    with pytest.raises(ValueError, match="objective_coef cannot balance gradients"):
        Balanced("CnnPolicy", DotEnv(), policy_kwargs=POLICY, buffer_size=10)


def test_a_fixed_weight_may_become_a_balanced_one(tmp_path):
    """Whatever the number of updates so far."""
    model = make_model(por_coef=0.1)
    model.train(5, 8)
    model.save(tmp_path / "model.zip")
    loaded = SACPOR.load(tmp_path / "model.zip", env=model.env, por_coef="auto_0.1")
    loaded.learn(1)
    loaded.train(1, 8)
    assert loaded.logger.name_to_value["train/por_coef"] > 0
