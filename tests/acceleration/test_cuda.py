"""On a GPU, passed over where there is none; what can be told without one is in ``test_device.py``."""

import numpy as np
import pytest
import torch as th
from toy_envs import DotEnv

from sb3_por import SACCURL, SACMRQ, SACPOR, SACSPR, TQCPOR, SACDrQ, VisualSAC

pytestmark = pytest.mark.skipif(not th.cuda.is_available(), reason="there is no GPU")


def train(cls=SACPOR, **options):
    """A model after two episodes; the second one is learned from."""
    arguments = dict(buffer_size=50, learning_starts=20, batch_size=8, diagnostics_interval=3, seed=0, device="cuda")
    model = cls("CnnPolicy", DotEnv(size=36, falling=True), **arguments, **options)
    before = parameters(model)
    model.learn(40)
    assert not np.array_equal(parameters(model), before) and np.isfinite(parameters(model)).all()
    return model


def parameters(model):
    return np.concatenate([parameter.detach().cpu().numpy().ravel() for parameter in model.policy.parameters()])


@pytest.mark.parametrize("storage", ["auto", "cpu"])
@pytest.mark.parametrize("cls", [VisualSAC, SACPOR, SACDrQ, SACCURL, SACSPR, SACMRQ, TQCPOR])
def test_no_update_waits_for_the_gpu(cls, storage):
    model = train(cls, replay_buffer_kwargs=dict(storage=storage))
    assert model.replay_buffer._frames[""].ring.device.type == ("cuda" if storage == "auto" else "cpu")
    th.cuda.set_sync_debug_mode("error")
    try:
        model.train(3, 8)
    finally:
        th.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize("precision", ["tf32", "bfloat16"])
def test_lower_precision_trains(precision):
    train(precision=precision)


@pytest.mark.parametrize("cls", [SACPOR, SACDrQ, SACCURL, SACSPR, SACMRQ])
def test_cuda_graphs_train(cls):
    train(cls, compile_mode="reduce-overhead")


def test_a_model_and_its_buffer_come_back_without_the_gpu(tmp_path):
    model = train()
    observation = DotEnv(size=36).reset(seed=0)[0].transpose(2, 0, 1)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = SACPOR.load(tmp_path / "model", device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    actions = [one.predict(observation, deterministic=True)[0] for one in (model, loaded)]
    np.testing.assert_allclose(*actions, atol=1e-3)
    np.random.seed(0)
    frames = model.replay_buffer.sample(20).observations
    np.random.seed(0)
    assert th.equal(loaded.replay_buffer.sample(20).observations, frames.cpu())
