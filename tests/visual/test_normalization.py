"""Images inside ``VecNormalize`` reach the replay buffer as the policy sees them, or are refused before anything runs."""

import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize, VecTransposeImage
from toy_envs import DotEnv

from sb3_por import SACPOR
from sb3_por.visual.replay_buffer import SequenceReplayBuffer

POLICY = dict(net_arch=[8], features_extractor_kwargs=dict(n_filters=4, strides=(2, 2)))


def envs(obs_type="pixels"):
    return DummyVecEnv([lambda: DotEnv(size=20, obs_type=obs_type), lambda: DotEnv(size=20, obs_type=obs_type)])


def make(env, policy="CnnPolicy"):
    arguments = dict(policy_kwargs=POLICY, buffer_size=200, learning_starts=10, batch_size=8, seed=0, device="cpu")
    return SACPOR(policy, env, **arguments)


def images(model):
    observations = model.replay_buffer.observations
    observations = observations["image"] if isinstance(observations, dict) else observations
    return observations[: model.replay_buffer.pos].copy()


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: VecNormalize(env, norm_obs=False),
        lambda env: VecNormalize(VecTransposeImage(env), norm_obs=False),
        lambda env: VecNormalize(VecFrameStack(env, 2), norm_obs=False),
    ],
)
def test_rewards_are_normalized_and_images_are_the_same(wrap):
    normalized, stacked = wrap(envs()), wrap(envs()).venv
    frames = [images(make(env).learn(60)) for env in (normalized, stacked)]
    # Actions differ once rewards do: the random ones of the beginning are the same
    assert frames[0].shape == frames[1].shape and np.array_equal(frames[0][:5], frames[1][:5])
    assert normalized.ret_rms.count > 50


def test_vectors_beside_images_are_normalized():
    env = VecNormalize(envs("dict"), norm_obs_keys=["state"])
    model = make(env, "MultiInputPolicy").learn(60)
    plain = make(envs("dict"), "MultiInputPolicy").learn(8)
    assert np.array_equal(images(model)[:4], images(plain)[:4])
    assert env.obs_rms["state"].count > 50
    sample = model.sample(50).observations["state"].cpu().numpy()
    raw = model.replay_buffer.observations["state"][: model.replay_buffer.pos]
    assert abs(raw.mean()) > 2 * abs(sample.mean()) or abs(raw.std() - 1) > abs(sample.std() - 1)


@pytest.mark.parametrize("kwargs", [dict(), dict(norm_obs_keys=["image"])])
def test_images_with_channels_last_must_not_be_normalized(kwargs):
    obs_type, policy = ("dict", "MultiInputPolicy") if kwargs else ("pixels", "CnnPolicy")
    with pytest.raises(ValueError, match=r"norm_obs=False, norm_obs_keys without the images"):
        make(VecNormalize(envs(obs_type), **kwargs), policy)


@pytest.mark.parametrize("wrap", [VecTransposeImage, lambda env: VecFrameStack(env, 3)])
def test_other_wrappers_belong_inside(wrap):
    with pytest.raises(ValueError, match="put VecNormalize around the other wrappers"):
        make(wrap(VecNormalize(envs(), norm_obs=False)))


@pytest.mark.parametrize(
    "frames",
    [
        np.zeros((2, 20, 20, 3), np.uint8),  # channels last
        np.zeros((1, 3, 20, 20), np.uint8),  # one environment
        np.zeros((2, 3, 20, 20), np.float32),  # normalized
    ],
)
def test_a_buffer_refuses_what_does_not_fit(frames):
    model = make(envs())
    buffer, step = model.replay_buffer, (np.zeros((2, 1), np.float32), np.zeros(2), np.zeros(2), [{}, {}])
    assert isinstance(buffer, SequenceReplayBuffer)
    with pytest.raises(ValueError, match="does not fit into a replay buffer for 2 environments"):
        buffer.add(frames, frames, *step)
    assert buffer.size() == 0
