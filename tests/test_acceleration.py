"""Lower precision and compiled networks: the same algorithm, which gains where there is a GPU for it."""

import shutil

import numpy as np
import pytest
import torch as th
from toy_envs import DotEnv

from sb3_por import SACPOR

POLICY = dict(net_arch=[16], features_extractor_kwargs=dict(features_dim=8, n_filters=4, strides=(2, 2)))


def train(updates=3, **options):
    """A model after some updates on the same samples."""
    arguments = dict(policy_kwargs=POLICY, buffer_size=200, learning_starts=1000, batch_size=16, seed=0, device="cpu")
    model = SACPOR("CnnPolicy", DotEnv(falling=True), **arguments, **options).learn(60)
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


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a C++ compiler")
def test_compiled_networks_train_as_others_do_and_save_as_they_do(tmp_path):
    plain, compiled = train(), train(compile_mode="default")
    assert difference(plain, compiled) < 1e-4
    compiled.save(tmp_path / "model")
    assert difference(SACPOR.load(tmp_path / "model"), compiled) == 0
