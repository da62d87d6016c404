"""Lower precision and compiled networks: the same algorithm, which gains where there is a GPU for it."""

import functools
import shutil

import numpy as np
import pytest
import torch as th
from toy_envs import DotEnv

from sb3_por import SACPOR, SACSPR, SACDrQ

POLICY = dict(net_arch=[16], features_extractor_kwargs=dict(features_dim=8, n_filters=4, strides=(2, 2)))


def train(updates=3, cls=SACPOR, **options):
    """A model after some updates on the same samples."""
    arguments = dict(policy_kwargs=POLICY, buffer_size=200, learning_starts=1000, batch_size=16, seed=0, device="cpu")
    model = cls("CnnPolicy", DotEnv(falling=True), **arguments, **options).learn(60)
    th.manual_seed(0)
    np.random.seed(0)
    model.train(updates, 16)
    return model


def difference(one, other):
    pairs = zip(one.policy.parameters(), other.policy.parameters(), strict=True)
    return max((a - b).abs().max().item() for a, b in pairs)


def test_bfloat16_trains_almost_as_float32_does():
    plain, mixed = train(), train(precision="bfloat16")
    assert all(parameter.dtype == th.float32 for parameter in mixed.policy.parameters())
    # Adam makes steps of the size of the learning rate, 3 of 3e-4
    assert 0 < difference(plain, mixed) < 3e-3


def test_an_unknown_precision_is_named():
    with pytest.raises(ValueError, match="float32, tf32, bfloat16, not 'half'"):
        SACPOR("CnnPolicy", DotEnv(), precision="half")


def test_bfloat16_keeps_q_values_and_targets_exact():
    model = train(precision="bfloat16")
    batch = model.replay_buffer.sample(16)
    views = model._preparation.views(batch)
    assert model.critic.q_values(views.online("obs"), batch.actions)[0].dtype == th.float32
    assert views.momentum("next").dtype == views.trunk("obs").dtype == th.float32
    # The trunk alone is computed in lower precision
    exact = model.critic.trunk(views.frames["obs"])
    assert 0 < (views.trunk("obs") - exact).abs().max() < 0.1 * exact.abs().max()


@pytest.mark.parametrize("cls", [SACPOR, SACDrQ])
def test_bfloat16_trains_the_convolutions_of_every_algorithm(cls):
    model = train(cls=cls, precision="bfloat16")
    assert all(parameter.grad.abs().sum() > 0 for parameter in model.critic.encoder_parameters())


def test_every_network_of_an_update_is_compiled(monkeypatch):
    graphs = []
    compiled = functools.partial(th.compile, backend=lambda graph, _: graphs.append(graph) or graph.forward)
    monkeypatch.setattr(th, "compile", lambda forward, mode: compiled(forward))
    train(cls=SACSPR, compile_mode="default", diagnostics_interval=2)
    # Trunks of critic and target, heads of both, the actor's latent, the objective's model, projector and predictor
    assert len(graphs) >= 2 + 4 + 1 + 3


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a C++ compiler")
def test_compiled_networks_train_as_others_do_and_save_as_they_do(tmp_path):
    plain, compiled = train(), train(compile_mode="default", diagnostics_interval=2)
    assert difference(plain, compiled) < 1e-4
    compiled.save(tmp_path / "model")
    assert difference(SACPOR.load(tmp_path / "model"), compiled) == 0
