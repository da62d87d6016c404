"""Lower precision and compiled networks: the same algorithm, which gains where there is a GPU for it."""

import functools
import shutil

import numpy as np
import pytest
import torch as th
from toy_envs import DotEnv

from sb3_por import SACCURL, SACMRQ, SACPOR, SACSPR, SACDrQ

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
    frames = model._augmentation(batch.observations)
    exact = model.critic.trunk(frames)
    with model._acceleration.update():
        trunk, features = model.critic.trunk(frames), model.critic_target.features(frames)
        assert model.critic.q_values(model.critic.features(frames), batch.actions)[0].dtype == th.float32
    assert features.dtype == trunk.dtype == th.float32
    # The trunk alone is computed in lower precision, and in updates alone
    assert 0 < (trunk - exact).abs().max() < 0.1 * exact.abs().max()
    assert th.equal(model.critic.trunk(frames), exact)


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


@pytest.mark.parametrize("cls", [SACPOR, SACDrQ, SACCURL, SACSPR, SACMRQ])
def test_what_compiled_networks_return_is_not_used_after_the_update(cls, monkeypatch):
    """CUDA graphs write the next update's results, gradients too, to where those of the last one were."""
    returned, modules = [], []

    def compile_like_a_graph(forward, mode):
        modules.append(forward.__self__)
        return lambda *inputs: returned.append(forward(*inputs)) or returned[-1]

    def begin():
        gradients = [parameter.grad for module in modules for parameter in module.parameters() if parameter.grad is not None]
        for tensor in returned + gradients:
            tensor.data.fill_(np.nan)
        returned.clear()

    plain = train(5, cls=cls, diagnostics_interval=2)
    monkeypatch.setattr(th, "compile", compile_like_a_graph)
    monkeypatch.setattr(th.compiler, "cudagraph_mark_step_begin", begin)
    compiled = train(5, cls=cls, diagnostics_interval=2, compile_mode="reduce-overhead")
    assert len(returned) > 10
    assert difference(plain, compiled) == 0
    metrics = compiled._metrics.take() | compiled.logger.name_to_value
    assert all(np.isfinite(value) for value in metrics.values() if isinstance(value, float))


def test_networks_are_compiled_for_updates_alone(monkeypatch):
    calls = []
    monkeypatch.setattr(th, "compile", lambda forward, mode: lambda *inputs: calls.append(mode) or forward(*inputs))
    model = train(compile_mode="reduce-overhead")
    assert set(calls) == {"reduce-overhead"}
    calls.clear()
    model.predict(DotEnv(falling=True).reset(seed=0)[0])
    assert not calls


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a C++ compiler")
def test_compiled_networks_train_as_others_do_and_save_as_they_do(tmp_path):
    plain, compiled = (train(diagnostics_interval=2, compile_mode=mode) for mode in (None, "default"))
    assert difference(plain, compiled) < 1e-4
    compiled.save(tmp_path / "model")
    assert difference(SACPOR.load(tmp_path / "model"), compiled) == 0
