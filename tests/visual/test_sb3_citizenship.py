"""What Stable-Baselines3's own tests ask of SAC, asked of the visual algorithms."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.callbacks import CallbackList, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv, FakeImageEnv, IdentityEnvBox
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize, VecTransposeImage
from stable_baselines3.her import HerReplayBuffer
from torch import nn
from toy_envs import DotEnv

from sb3_por import SACCURL, SACPOR, VisualSAC, VisualTQC

CLASSES = [VisualSAC, SACPOR, VisualTQC]
SMALL = dict(net_arch=[8])


def make_model(cls, policy="MlpPolicy", env="Pendulum-v1", **kwargs):
    defaults = dict(policy_kwargs=SMALL, buffer_size=500, learning_starts=10, batch_size=16, seed=0)
    return cls(policy, env, **{**defaults, **kwargs})


@pytest.mark.parametrize("cls", CLASSES)
@pytest.mark.parametrize(
    "kwargs",
    [
        dict(ent_coef="auto"),
        dict(ent_coef=0.01),
        dict(ent_coef="auto_0.01"),
        dict(policy_kwargs=dict(net_arch=[8], n_critics=1)),
        dict(policy_kwargs=dict(net_arch=[8], n_critics=3)),
        dict(policy_kwargs=dict(net_arch=[])),
        dict(policy_kwargs=dict(net_arch=dict(qf=[8], pi=[8, 4]))),
        dict(policy_kwargs=dict(optimizer_class=th.optim.AdamW, optimizer_kwargs=dict(weight_decay=0.1), net_arch=[8])),
        dict(policy_kwargs=dict(share_features_extractor=False, net_arch=[8])),
        dict(action_noise=NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))),
        dict(train_freq=4, gradient_steps=-1),
        dict(train_freq=(1, "episode")),
        dict(gradient_steps=0),
        dict(use_sde=True, sde_sample_freq=4, use_sde_at_warmup=True),
        dict(use_sde=True, policy_kwargs=dict(net_arch=[8], log_std_init=-2, use_expln=True)),
        dict(learning_rate=lambda progress: 1e-3 * progress),
    ],
    ids=lambda kwargs: "-".join(kwargs),
)
def test_runs_with_every_option_of_sac(cls, kwargs):
    model = make_model(cls, **kwargs).learn(30)
    assert all(bool(th.isfinite(parameter).all()) for parameter in model.policy.parameters())


def test_wrong_train_freq_is_refused():
    with pytest.raises(ValueError):
        make_model(VisualSAC, train_freq=(1, "update"))


@pytest.mark.parametrize("cls", CLASSES)
def test_several_environments_and_n_steps(cls):
    model = make_model(cls, env=make_vec_env("Pendulum-v1", n_envs=2), n_steps=3, gamma=0.98, train_freq=2)
    assert isinstance(model.replay_buffer, NStepReplayBuffer)
    assert (model.replay_buffer.n_steps, model.replay_buffer.gamma) == (3, 0.98)
    model.learn(40)


def test_an_objective_that_needs_no_later_frame_takes_any_buffer_and_any_returns():
    model = make_model(
        SACCURL, replay_buffer_class=NStepReplayBuffer, replay_buffer_kwargs=dict(n_steps=3, gamma=0.99), n_steps=3
    )
    model.learn(20)
    with pytest.raises(ValueError, match="cannot sample the later frames that SACPOR needs"):
        make_model(SACPOR, replay_buffer_class=NStepReplayBuffer, replay_buffer_kwargs=dict(n_steps=3, gamma=0.99), n_steps=3)


def test_the_first_q_network_can_be_asked_alone():
    model = make_model(VisualSAC)
    obs, actions = th.randn(4, 3), th.randn(4, 1)
    assert th.equal(model.critic.q1_forward(obs, actions), model.critic(obs, actions)[0])


@pytest.mark.parametrize("share", [True, False])
def test_target_network_and_learning_rate(share):
    """As in SB3's test_features_extractor_target_net."""
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False)
    policy_kwargs = dict(features_extractor_kwargs=dict(features_dim=8), share_features_extractor=share)
    model = make_model(VisualSAC, "CnnPolicy", env, learning_rate=1e-3, policy_kwargs=policy_kwargs, learning_starts=100)
    assert (model.actor.features_extractor is model.critic.features_extractor) == share

    def params(network):
        return [parameter.detach().clone() for parameter in network.parameters()]

    def equal(before, network):
        return [th.equal(old, new) for old, new in zip(before, network.parameters(), strict=True)]

    assert all(equal(params(model.critic), model.critic_target))
    model.learn(20)
    critic, target = params(model.critic), params(model.critic_target)
    model.tau = 0.0
    model.train(1, 16)
    assert all(equal(target, model.critic_target)) and not any(equal(critic, model.critic))
    critic = params(model.critic)
    model.lr_schedule, model.tau = lambda _: 0.0, 0.01
    model.train(1, 16)
    assert all(equal(critic, model.critic)) and not any(equal(target, model.critic_target))


class BatchNormExtractor(BaseFeaturesExtractor):
    """Flatten, batch norm, dropout."""

    def __init__(self, space):
        super().__init__(space, int(np.prod(space.shape)))
        self.net = nn.Sequential(nn.Flatten(), nn.BatchNorm1d(self.features_dim), nn.Dropout(0.5))

    def forward(self, observations):
        return self.net(observations)


@pytest.mark.parametrize("cls", [VisualSAC, VisualTQC])
def test_batch_norm_statistics_reach_the_target(cls):
    model = make_model(cls, tau=0.0, policy_kwargs=dict(net_arch=[8], features_extractor_class=BatchNormExtractor))
    before = model.critic.features_extractor.net[1].running_mean.clone()
    observation = model.observation_space.sample()
    first, second = (model.predict(observation, deterministic=True)[0] for _ in range(2))
    assert np.array_equal(first, second)
    model.learn(30)
    online, target = (network.features_extractor.net[1] for network in (model.critic, model.critic_target))
    assert not th.allclose(before, online.running_mean)
    assert th.equal(online.running_mean, target.running_mean) and th.equal(online.running_var, target.running_var)
    assert not th.equal(online.bias, target.bias)


def test_any_features_extractor_of_sb3_can_be_the_trunk():
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=3, discrete=False)
    kwargs = dict(features_extractor_class=NatureCNN, features_extractor_kwargs=dict(features_dim=16), net_arch=[8])
    model = make_model(VisualSAC, "CnnPolicy", env, policy_kwargs=kwargs).learn(20)
    assert model.actor.features_extractor is model.critic.features_extractor


@pytest.mark.parametrize("normalize_images", [True, False])
def test_float_images_need_normalize_images_false(normalize_images):
    image_env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, channel_first=True, discrete=False)
    env = VecNormalize(DummyVecEnv([lambda: image_env]))
    kwargs = dict(policy_kwargs=dict(normalize_images=normalize_images, net_arch=[8]))
    if normalize_images:
        with pytest.raises(AssertionError, match="normalize_images=False"):
            make_model(VisualSAC, "CnnPolicy", env, **kwargs)
    else:
        make_model(SACPOR, "CnnPolicy", env, **kwargs).learn(20)


@pytest.mark.parametrize("cls", CLASSES)
@pytest.mark.parametrize("obs_type, policy", [("state", "MlpPolicy"), ("dict", "MultiInputPolicy")])
def test_vec_normalize(cls, obs_type, policy):
    keys = ["state"] if obs_type == "dict" else None
    # Transposed inside: SB3 keeps the original observations of VecNormalize as they come
    venv = DummyVecEnv([lambda: DotEnv(obs_type=obs_type)])
    env = VecNormalize(VecTransposeImage(venv) if obs_type == "dict" else venv, norm_obs_keys=keys)
    make_model(cls, policy, env).learn(25)


def test_frame_stacks():
    env = VecFrameStack(DummyVecEnv([DotEnv]), 3)
    model = make_model(SACPOR, "CnnPolicy", env, policy_kwargs=SMALL).learn(25)
    assert model.observation_space.shape == (9, 32, 32)
    env = VecFrameStack(DummyVecEnv([lambda: DotEnv(obs_type="dict")]), 2)
    make_model(SACPOR, "MultiInputPolicy", env, policy_kwargs=SMALL).learn(25)


@pytest.mark.parametrize("cls", CLASSES)
def test_her(cls):
    env = BitFlippingEnv(n_bits=4, continuous=True)
    kwargs = dict(replay_buffer_class=HerReplayBuffer, replay_buffer_kwargs=dict(n_sampled_goal=2))
    make_model(cls, "MultiInputPolicy", env, **kwargs).learn(30)


@pytest.mark.parametrize(
    "space", [gym.spaces.Discrete(4), gym.spaces.MultiDiscrete([3, 2]), gym.spaces.MultiBinary(3)], ids=type
)
def test_discrete_observations(space):
    env = gym.make("Pendulum-v1")
    env = gym.wrappers.TransformObservation(env, lambda _: space.sample(), space)
    make_model(SACPOR, env=env, policy_kwargs=SMALL).learn(20)


def test_float64_actions():
    env = gym.wrappers.RescaleAction(gym.make("Pendulum-v1"), np.float64(-1), np.float64(1))
    env.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
    make_model(VisualSAC, env=env).learn(20)


@pytest.mark.parametrize("cls", CLASSES)
def test_same_seed_same_policy(cls):
    parameters = [th.cat([p.flatten() for p in make_model(cls).learn(40).policy.parameters()]) for _ in range(2)]
    assert th.equal(*parameters)


def test_callbacks(tmp_path):
    env = DummyVecEnv([lambda: gym.wrappers.TimeLimit(gym.make("Pendulum-v1"), 20)])
    callbacks = [
        CheckpointCallback(20, tmp_path, save_replay_buffer=True),
        EvalCallback(env, eval_freq=20, n_eval_episodes=1, warn=False, best_model_save_path=str(tmp_path)),
    ]
    make_model(SACPOR, tensorboard_log=str(tmp_path)).learn(40, callback=CallbackList(callbacks), progress_bar=True)
    assert (tmp_path / "SACPOR_1").is_dir()
    assert (tmp_path / "best_model.zip").exists() and (tmp_path / "rl_model_40_steps.zip").exists()
    model = SACPOR.load(tmp_path / "rl_model_40_steps.zip", env=env)
    model.load_replay_buffer(tmp_path / "rl_model_replay_buffer_40_steps.pkl")
    model.learn(20, reset_num_timesteps=False)


def test_set_env_and_another_number_of_environments(tmp_path):
    model = make_model(SACPOR).learn(20)
    model.set_env(make_vec_env("Pendulum-v1"))
    model.learn(20)
    model.save(tmp_path / "model.zip")
    SACPOR.load(tmp_path / "model.zip", env=make_vec_env("Pendulum-v1", n_envs=2)).learn(20)


def test_excluded_and_replaced_attributes(tmp_path):
    make_model(SACPOR, verbose=2).save(tmp_path / "model.zip", exclude=["verbose"])
    loaded = SACPOR.load(tmp_path / "model.zip", custom_objects=dict(learning_rate=2e-5))
    assert loaded.verbose != 2 and loaded.learning_rate == 2e-5


def test_dict_of_vectors_equals_the_flat_vector():
    actions = []
    for policy, wrap in (("MultiInputPolicy", True), ("MlpPolicy", False)):
        env = DotEnv(obs_type="state")
        if wrap:
            space = gym.spaces.Dict({"vec": env.observation_space})
            env = gym.wrappers.TransformObservation(env, lambda obs: {"vec": obs}, space)
        model = make_model(SACPOR, policy, env).learn(40)
        observation = np.array([0.3, -0.2], np.float32)
        actions.append(model.predict({"vec": observation} if wrap else observation, deterministic=True)[0])
    assert np.allclose(*actions)


@pytest.mark.parametrize("cls", [VisualSAC, SACPOR])
def test_learns_the_identity(cls):
    env = IdentityEnvBox(eps=0.5)
    kwargs = dict(policy_kwargs=dict(net_arch=[64, 64]), learning_starts=100, batch_size=128, learning_rate=1e-3, gamma=0.95)
    model = make_model(cls, env=env, **kwargs).learn(400)
    assert evaluate_policy(model, env, 20, warn=False)[0] > 85
