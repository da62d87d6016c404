"""What does not belong to a model is refused where it is loaded; an encoder can be taken from another method."""

import copy
import re

import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_envs import DotEnv

from sb3_por import ALGORITHMS, SACCURL, SACPOR, TQCPOR, SACDrQ, VisualSAC, VisualTQC
from sb3_por.common.errors import UserError, UserNote

POLICY = dict(net_arch=[16], features_extractor_kwargs=dict(features_dim=8, n_filters=4, strides=(2, 2)))


def make_model(cls, env=None, **kwargs):
    arguments = dict(policy_kwargs=POLICY, buffer_size=200, learning_starts=10, batch_size=8, seed=0, device="cpu")
    return cls("CnnPolicy", env or DotEnv(size=20), **{**arguments, **kwargs})


@pytest.mark.parametrize("cls", [SACCURL, SACDrQ, VisualSAC, TQCPOR])
def test_a_model_is_refused_by_the_class_of_another_method(cls, tmp_path):
    make_model(SACPOR).save(tmp_path / "por.zip")
    with pytest.raises(ValueError, match=f"{cls.__name__} (has|needs)"):
        cls.load(tmp_path / "por.zip", device="cpu")
    make_model(SACDrQ).save(tmp_path / "drq.zip")
    with pytest.raises(ValueError, match="was trained with no objective"):
        SACPOR.load(tmp_path / "drq.zip", device="cpu")


@pytest.mark.parametrize("cls", [*ALGORITHMS.values(), VisualSAC, VisualTQC])
def test_a_class_of_sb3_predicts_with_a_model_of_ours_and_does_not_train_it(cls, tmp_path):
    model = make_model(cls, learning_starts=10).learn(20)
    model.save(tmp_path / "ours.zip")
    parent = TQC if issubclass(cls, TQC) else SAC
    loaded = parent.load(tmp_path / "ours.zip", env=DotEnv(size=20), device="cpu")
    frames = np.random.default_rng(0).integers(0, 256, (3, *model.observation_space.shape), np.uint8)
    assert np.array_equal(loaded.predict(frames, deterministic=True)[0], model.predict(frames, deterministic=True)[0])
    before = {name: value.clone() for name, value in loaded.policy.state_dict().items()}
    for learning_starts in (0, 5):
        loaded.learning_starts = learning_starts
        with pytest.raises(UserError, match="can predict in a class of Stable-Baselines3, not learn"):
            loaded.learn(20)
    assert all(th.equal(value, before[name]) for name, value in loaded.policy.state_dict().items())
    with pytest.raises(UserError, match="not learn"):
        parent(type(model.policy), DotEnv(size=20), buffer_size=50, learning_starts=5, policy_kwargs=POLICY).learn(10)


def test_a_method_can_start_from_the_encoder_of_another():
    por, drq = make_model(SACPOR, seed=1).learn(40), make_model(SACDrQ, seed=2)
    heads = [parameter.clone() for parameter in drq.critic.head_parameters()]
    drq.load_encoder(por)
    for critic in (drq.critic, drq.critic_target):
        assert all(map(th.equal, critic.encoder_parameters(), por.critic.encoder_parameters()))
    assert all(map(th.equal, heads, drq.critic.head_parameters()))
    drq.learn(40)
    other = make_model(
        VisualSAC, policy_kwargs=dict(net_arch=[8], features_extractor_kwargs=dict(n_filters=8, strides=(2, 2)))
    )
    centered = make_model(
        VisualSAC,
        policy_kwargs=dict(net_arch=[8], features_extractor_kwargs=dict(**POLICY["features_extractor_kwargs"], center=True)),
    )
    for one in (other, centered):
        before = [parameter.clone() for parameter in one.critic.parameters()]
        with pytest.raises(ValueError, match="has another shape"):
            one.load_encoder(por)
        assert all(map(th.equal, before, one.critic.parameters()))


def test_a_model_is_loaded_with_another_kind_of_buffer(tmp_path):
    make_model(SACDrQ, n_steps=3).save(tmp_path / "model.zip")
    model = SACDrQ.load(tmp_path / "model.zip", env=DotEnv(size=20), replay_buffer_class=ReplayBuffer, n_steps=1)
    assert type(model.replay_buffer) is ReplayBuffer
    assert SACDrQ.load(tmp_path / "model.zip", env=DotEnv(size=20)).replay_buffer.n_steps == 3


def test_a_trained_policy_can_be_copied():
    model = make_model(SACPOR).learn(40)
    copied = copy.deepcopy(model.policy)
    assert all(map(th.equal, copied.state_dict().values(), model.policy.state_dict().values()))


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        (dict(n_steps=3), "n_steps of the replay buffer in the file is 1, and this model's is 3"),
        (dict(gamma=0.5), "gamma of the replay buffer in the file is 0.99, and this model's is 0.5"),
        (dict(replay_buffer_class=ReplayBuffer), "kind of the replay buffer in the file is SequenceReplayBuffer"),
        (dict(env=DummyVecEnv([lambda: DotEnv(size=20)] * 2)), "n_envs of the replay buffer in the file is 1"),
        (dict(env=DotEnv(size=24)), "observation_space of the replay buffer in the file is"),
    ],
)
def test_a_buffer_of_another_model_is_refused(kwargs, message, tmp_path):
    make_model(SACPOR, env=DotEnv(size=20)).learn(20).save_replay_buffer(tmp_path / "buffer.pkl")
    model = make_model(SACPOR, **{"env": DotEnv(size=20), **kwargs})
    own = model.replay_buffer
    with pytest.raises(ValueError, match=re.escape(message)):
        model.load_replay_buffer(tmp_path / "buffer.pkl")
    assert model.replay_buffer is own


def test_a_buffer_of_another_size_is_noted(tmp_path):
    make_model(SACPOR, buffer_size=50).learn(20).save_replay_buffer(tmp_path / "buffer.pkl")
    model = make_model(SACPOR)
    with pytest.warns(UserNote, match="the replay buffer in the file holds 50 transitions, and buffer_size 200 has no effect"):
        model.load_replay_buffer(tmp_path / "buffer.pkl")


@pytest.mark.parametrize("dropped", [-1, 25])
def test_a_number_of_quantiles_that_leaves_none_is_refused(dropped):
    with pytest.raises(ValueError, match="top_quantiles_to_drop_per_net must be at least 0 and below the 25 quantiles"):
        TQCPOR("MlpPolicy", "Pendulum-v1", buffer_size=10, top_quantiles_to_drop_per_net=dropped)
