"""Saving and loading: everything is in the zip, and a loaded model goes on as if it had never stopped."""

import copy
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecTransposeImage
from toy_envs import DotEnv

from sb3_por import SACCURL, SACPOR, VisualSAC

POLICY = dict(net_arch=[16], features_extractor_kwargs=dict(features_dim=8, n_filters=4, strides=(2, 2)))


def make_env(envs=None):
    envs = envs or [DotEnv(size=16, falling=True), DotEnv(size=16, falling=True)]
    return VecTransposeImage(DummyVecEnv([lambda env=env: env for env in envs]))


def make_model(cls, env, policy_kwargs=POLICY, **kwargs):
    return cls(
        "CnnPolicy",
        env,
        policy_kwargs=policy_kwargs,
        buffer_size=200,
        learning_starts=50,
        train_freq=2,
        batch_size=8,
        seed=1,
        device="cpu",
        **kwargs,
    )


def flatten_state(value, prefix=""):
    """Leaves of nested state dicts by name."""
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, (list, tuple)):
        items = enumerate(value)
    else:
        return {prefix: value}
    return {name: leaf for key, part in items for name, leaf in flatten_state(part, f"{prefix}/{key}").items()}


def assert_same_model(model, other):
    states = flatten_state(model.get_parameters()), flatten_state(other.get_parameters())
    assert states[0].keys() == states[1].keys()
    for name, value in states[0].items():
        equal = th.equal(value, states[1][name]) if isinstance(value, th.Tensor) else value == states[1][name]
        assert equal, name


def save_and_load(model, tmp_path):
    """Load the model in a copy of the environments in the state of their episodes, after other work."""
    envs = copy.deepcopy(model.get_env().unwrapped.envs)
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    np.random.seed(77)
    th.manual_seed(77)
    loaded = type(model).load(tmp_path / "model.zip", env=make_env(envs), device="cpu", force_reset=False)
    loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    return loaded


def assert_same_buffer(buffer, other):
    for name in ("actions", "rewards", "dones", "timeouts", "ended", "observations"):
        assert np.array_equal(getattr(buffer, name), getattr(other, name)), name


@pytest.mark.parametrize(
    "cls, kwargs",
    [
        (SACPOR, dict()),
        (SACPOR, dict(k=3, random_k=True, order_head="difference", diagnostics_interval=7)),
        (SACPOR, dict(por_coef="auto_0.3")),
        (SACCURL, dict(aux_lr_ratio=0.5)),
        (VisualSAC, dict(use_sde=True)),
        (VisualSAC, dict(ent_coef=0.1, n_steps=3)),
    ],
    ids=["por", "por-k3", "por-balanced", "curl", "sde", "fixed-temperature"],
)
def test_300_steps_save_load_300_more_equals_600_in_one_go(cls, kwargs, tmp_path):
    in_one_go = make_model(cls, make_env(), **kwargs).learn(600)
    loaded = save_and_load(make_model(cls, make_env(), **kwargs).learn(300), tmp_path)
    loaded.learn(300, reset_num_timesteps=False)
    assert loaded.num_timesteps == in_one_go.num_timesteps == 600
    assert loaded._n_updates == in_one_go._n_updates
    assert_same_model(in_one_go, loaded)
    assert_same_buffer(in_one_go.replay_buffer, loaded.replay_buffer)


def test_loaded_model_continues_its_schedules(tmp_path):
    def learn_twice(between):
        model = between(make_model(SACPOR, make_env(), learning_rate=lambda progress: 1e-3 * progress).learn(60))
        return model.learn(60, reset_num_timesteps=False)

    model, loaded = learn_twice(lambda model: model), learn_twice(lambda model: save_and_load(model, tmp_path))
    assert_same_model(model, loaded)


def test_every_network_and_optimizer_is_in_the_zip(tmp_path):
    model = make_model(SACPOR, make_env()).learn(60)
    model.save(tmp_path / "model.zip")
    names = zipfile.ZipFile(tmp_path / "model.zip").namelist()
    assert {"policy.pth", "actor.optimizer.pth", "critic.optimizer.pth", "ent_coef_optimizer.pth"} <= set(names)
    loaded = SACPOR.load(tmp_path / "model.zip", device="cpu")
    assert_same_model(model, loaded)
    state = loaded.policy.state_dict()
    assert {name.split(".")[0] for name in state} == {"actor", "critic", "critic_target", "objective"}
    # Adam knows every parameter that it trains, the objective's too
    trained = [p for group in loaded.critic.optimizer.param_groups for p in group["params"]]
    assert {id(p) for p in loaded.policy.objective.parameters()} <= {id(p) for p in trained}
    assert all(p in loaded.critic.optimizer.state for p in trained)
    # No second copy of the networks among the pickled attributes
    assert (tmp_path / "model.zip").stat().st_size < 1.5e6


def test_loaded_model_predicts_identically(tmp_path):
    env = make_env()
    model = make_model(SACPOR, env).learn(60)
    model.save(tmp_path / "model.zip")
    observations = env.reset()
    expected, _ = model.predict(observations, deterministic=True)
    for loaded in (SACPOR.load(tmp_path / "model.zip"), SACPOR.load(tmp_path / "model.zip", buffer_size=1)):
        assert np.array_equal(loaded.predict(observations, deterministic=True)[0], expected)
        channels_last = observations.transpose(0, 2, 3, 1)
        assert np.array_equal(loaded.predict(channels_last, deterministic=True)[0], expected)


def test_policy_alone_saves_and_loads_with_its_objective(tmp_path):
    policy_kwargs = dict(POLICY, critic_layer_norm=True)
    model = make_model(SACPOR, make_env(), policy_kwargs, order_head="difference").learn(30)
    model.policy.save(tmp_path / "policy.pth")
    loaded = type(model.policy).load(tmp_path / "policy.pth", device="cpu")
    for (name, one), other in zip(model.policy.state_dict().items(), loaded.state_dict().values(), strict=True):
        assert th.equal(one, other), name
    assert loaded.share_features_extractor and loaded.actor.features_extractor is loaded.critic.features_extractor


def test_loading_for_evaluation_leaves_the_generators_to_sb3(tmp_path):
    model = make_model(SACPOR, make_env()).learn(30)
    model.seed = None
    model.save(tmp_path / "model.zip")
    np.random.seed(5)
    expected = np.random.random()
    np.random.seed(5)
    SACPOR.load(tmp_path / "model.zip", device="cpu")
    assert np.random.random() == expected


def test_starting_anew_does_not_take_up_the_saved_generators(tmp_path):
    model = make_model(SACPOR, make_env()).learn(30)
    model.save(tmp_path / "model.zip")
    loaded = SACPOR.load(tmp_path / "model.zip", env=make_env(), device="cpu")
    np.random.seed(5)
    own = np.random.get_state()[1]
    assert not np.array_equal(own, loaded.rng_state["numpy"][1])
    loaded.learn(2)  # draws fewer numbers than the generator has in store
    assert loaded.rng_state is None and np.array_equal(np.random.get_state()[1], own)


def test_set_parameters_restores_and_warm_starts():
    model, other = make_model(SACPOR, make_env()).learn(40), make_model(SACPOR, make_env())
    other.set_parameters(copy.deepcopy(model.get_parameters()))
    assert_same_model(model, other)
    plain = make_model(VisualSAC, make_env()).learn(40)
    other.set_parameters({"policy": plain.policy.state_dict()}, exact_match=False)
    assert all(th.equal(a, b) for a, b in zip(plain.critic.parameters(), other.critic.parameters(), strict=True))


def test_checkpoints_of_a_run_do_not_disturb_it(tmp_path):
    quiet = make_model(SACPOR, make_env()).learn(60)
    callback = CheckpointCallback(10, tmp_path, save_replay_buffer=True)
    saving = make_model(SACPOR, make_env()).learn(60, callback=callback)
    assert_same_model(quiet, saving)


def test_same_seed_same_run():
    assert_same_model(make_model(SACPOR, make_env()).learn(60), make_model(SACPOR, make_env()).learn(60))


def test_a_model_saved_before_it_goes_on_keeps_the_generators_it_was_loaded_with(tmp_path):
    model = make_model(SACPOR, make_env()).learn(60)
    model.save(tmp_path / "model.zip")
    loaded = SACPOR.load(tmp_path / "model.zip", env=make_env())
    th.manual_seed(99)
    loaded.save(tmp_path / "copy.zip")
    copied = SACPOR.load(tmp_path / "copy.zip")
    fresh = SACPOR.load(tmp_path / "model.zip")
    assert np.array_equal(loaded.rng_state["torch"], fresh.rng_state["torch"])
    assert np.array_equal(copied.rng_state["torch"], fresh.rng_state["torch"])


def test_a_second_learn_does_not_end_the_episode_that_it_cuts_off():
    model = make_model(SACPOR, make_env(), optimize_memory_usage=True).learn(20)
    model.learn(20, reset_num_timesteps=False)
    assert not model.replay_buffer.dones[9].any()  # where the first call ended, half-way through an episode


def test_a_seed_given_at_loading_decides_what_follows(tmp_path):
    model = VisualSAC("MlpPolicy", "Pendulum-v1", buffer_size=100, learning_starts=1000, seed=0).learn(10)
    model.save(tmp_path / "model")

    def go_on(**kwargs):
        loaded = VisualSAC.load(tmp_path / "model", env=gym.make("Pendulum-v1"), **kwargs)
        return loaded.learn(10, reset_num_timesteps=False).replay_buffer.actions[:10].tolist()

    assert go_on() == go_on()
    assert go_on(seed=1) == go_on(seed=1)
    assert len({str(go_on()), str(go_on(seed=1)), str(go_on(seed=2))}) == 3
    reseeded = VisualSAC.load(tmp_path / "model", env=gym.make("Pendulum-v1"))
    reseeded.set_random_seed(1)
    assert reseeded.rng_state is None
