"""Training while the environments step: the same number of updates, in a fixed order, reproducibly."""

import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper, VecTransposeImage
from toy_envs import DotEnv

from sb3_por import SACPOR

POLICY = dict(net_arch=[8], features_extractor_kwargs=dict(features_dim=8, n_filters=4, strides=(2, 2)))


def make_model(env, **kwargs):
    defaults = dict(policy_kwargs=POLICY, buffer_size=100, learning_starts=8, batch_size=8, seed=0, device="cpu")
    return SACPOR("CnnPolicy", env, **{**defaults, **kwargs})


def make_env(cls=DummyVecEnv, n_envs=2):
    return VecTransposeImage(cls([lambda: DotEnv(size=16)] * n_envs))


class Recorder(VecEnvWrapper):
    """Writes down when actions are sent and results are fetched."""

    def __init__(self, venv, events):
        super().__init__(venv)
        self.events = events

    def reset(self):
        return self.venv.reset()

    def step_async(self, actions):
        self.events.append("send")
        self.venv.step_async(actions)

    def step_wait(self):
        self.events.append("fetch")
        return self.venv.step_wait()


def record(**kwargs):
    events = []
    model = make_model(Recorder(make_env(), events), **kwargs)
    update = model._update
    model._update = lambda batch_size: events.append("update") or update(batch_size)
    model.learn(20)
    return model, events


def test_updates_are_made_between_sending_and_fetching():
    model, events = record(overlap=True, gradient_steps=2)
    assert events[:15] == ["send", "fetch"] * 5 + ["send", "update", "update", "fetch", "send"]
    for i, event in enumerate(events[:-2]):
        if event == "update":
            assert events[i - 1] in ("send", "update") and events[i + 1] in ("fetch", "update")
    # Those of the last rollout are not lost
    assert events[-2:] == ["update", "update"] and model._updates_due == 0


@pytest.mark.parametrize("kwargs", [dict(), dict(train_freq=3, gradient_steps=-1), dict(use_sde=True)])
def test_as_many_updates_as_without_overlap(kwargs):
    overlapped, events = record(overlap=True, **kwargs)
    plain, plain_events = record(overlap=False, **kwargs)
    assert overlapped._n_updates == plain._n_updates > 0
    assert events.count("update") == plain_events.count("update")


@pytest.mark.parametrize("cls", [DummyVecEnv, SubprocVecEnv])
def test_overlapped_runs_are_reproducible(cls):
    parameters = []
    for _ in range(2):
        env = make_env(cls)
        model = make_model(env, overlap=True).learn(30)
        env.close()
        parameters.append(th.cat([parameter.flatten() for parameter in model.policy.parameters()]))
    assert th.equal(*parameters)


def test_each_environment_keeps_a_noise_of_its_own():
    model = make_model(make_env(n_envs=3), use_sde=True, overlap=True, train_freq=4, learning_starts=0)
    seen = []
    model.learn(48, lambda local_variables, _: seen.append(len(model.actor.action_dist.exploration_matrices)) or True)
    assert set(seen) == {3}


def test_train_called_directly_trains_at_once():
    model = make_model(make_env(), overlap=True).learn(20)
    n_updates = model._n_updates
    model.train(3, 8)
    assert model._n_updates == n_updates + 3
