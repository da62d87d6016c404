"""Environments and statistics of strangers' models: rebuilt from plain values, or refused by name."""

import json
import os
import pickle
import shutil
import sys

import gymnasium as gym
import numpy as np
import pytest
import yaml
from hostile_files import Touch, rewrite, small
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from toy_envs import DotEnv

from sb3_por.common import plain
from sb3_por.common.errors import UserError
from sb3_por.evaluation import evaluate, load_safe, plain_files
from sb3_por.evaluation.environment import make_evaluation_env
from sb3_por.evaluation.loading import resolve
from sb3_por.evaluation.plain_files import save_plain
from sb3_por.runs.environment import TrainingEnvironment


def test_stacked_frames_of_a_model_of_sb3_are_found_in_its_settings(tmp_path):
    env = VecFrameStack(DummyVecEnv([lambda: gym.make("Pendulum-v1")]), 2)
    model = SAC("MlpPolicy", env, buffer_size=10, **small())
    model.save(tmp_path / "model.zip")
    (tmp_path / "Pendulum-v1").mkdir()
    (tmp_path / "Pendulum-v1" / "config.yml").write_text("frame_stack: 2")
    loaded, environment = resolve(tmp_path / "model.zip", "Pendulum-v1", safe=True)
    assert evaluate(loaded, "Pendulum-v1", 1, **environment) == evaluate(model, "Pendulum-v1", 1)
    (tmp_path / "Pendulum-v1" / "config.yml").write_text("frame_stack: 1000000000")
    with pytest.raises(UserError, match="frame_stack is refused: 1000000000 is no number from 1 to 64"):
        resolve(tmp_path / "model.zip", "Pendulum-v1", safe=True)


EVIL_WRAPPER = {"timeit.timeit": {"setup": "open('executed', 'w')", "number": 1}}


@pytest.mark.parametrize(
    "environment, message",
    [
        (dict(env_wrapper=EVIL_WRAPPER), "the wrapper 'timeit.timeit' is refused"),
        (dict(env_wrapper=["softbody_envs.wrappers.ActionRepeat", EVIL_WRAPPER]), "the wrapper 'timeit.timeit' is refused"),
        (dict(vec_env_wrapper="os.system"), "the wrapper 'os.system' is refused"),
        (dict(env_wrapper=[[["x"]]]), "the wrapper"),
        (dict(env_wrapper={"gymnasium.wrappers.ClipReward": {"min_reward": os.system}}), "is refused"),
        (dict(env_kwargs={"obs_type": SAC}), "env_kwargs: obs_type is refused"),
        (dict(env_kwargs={"g": {1: SAC}}), "env_kwargs: g is refused"),
        (dict(env_kwargs={"g": {SAC: 1}}), "env_kwargs: g is refused"),
    ],
)
@pytest.mark.parametrize("place", ["model", "folder"])
def test_what_the_environment_would_run_is_refused(place, environment, message, sac_zip, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    holder = SAC.load(sac_zip)
    if place == "model":
        TrainingEnvironment("Pendulum-v1", **environment).store_in(holder)
        rewrite(sac_zip, tmp_path / "model.zip", data={"training_environment": holder.training_environment})
    else:
        shutil.copy(sac_zip, tmp_path / "model.zip")
        (tmp_path / "Pendulum-v1").mkdir()
        TrainingEnvironment("Pendulum-v1", **environment).store_in(holder)
        (tmp_path / "Pendulum-v1" / "config.yml").write_text(holder.training_environment)
    with pytest.raises(UserError, match=message):
        resolve("model.zip", "Pendulum-v1", safe=True)
    if place == "model":
        with pytest.raises(UserError, match=message):
            load_safe("model.zip", "Pendulum-v1")
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("name", ["env_wrapper", "env_kwargs", "vec_env_wrapper", "normalize", "frame_stack", "gym_packages"])
def test_few_lines_of_settings_that_are_a_great_many_values_are_refused(name, sac_zip, tmp_path):
    levels = [f"l{i}: &l{i} [*l{i - 1}, *l{i - 1}]" for i in range(1, 40)]
    clip = "{gymnasium.wrappers.ClipReward: {min_reward: *l39}}"
    value = {"env_wrapper": clip, "env_kwargs": "{x: *l39}", "vec_env_wrapper": "[*l39]"}.get(name, "*l39")
    settings = "\n".join(["l0: &l0 [1]", *levels, f"{name}: {value}"])
    shutil.copy(sac_zip, tmp_path / "model.zip")
    (tmp_path / "Pendulum-v1").mkdir()
    (tmp_path / "Pendulum-v1" / ("args.yml" if name == "gym_packages" else "config.yml")).write_text(settings)
    env_id = "Evil-v0" if name == "gym_packages" else "Pendulum-v1"
    with pytest.raises(UserError) as error:
        resolve(tmp_path / "model.zip", env_id, safe=True)
    assert len(str(error.value)) < 1500


def test_packages_that_a_folder_names_are_not_imported(sac_zip, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    (tmp_path / "evil_package.py").write_text("open('executed', 'w')")
    shutil.copy(sac_zip, tmp_path / "model.zip")
    (tmp_path / "Pendulum-v1").mkdir()
    (tmp_path / "Pendulum-v1" / "args.yml").write_text(yaml.safe_dump({"gym_packages": ["evil_package"]}))
    resolve("model.zip", "Pendulum-v1", safe=True)
    with pytest.raises(UserError, match=r"does not import the packages of the run, \['evil_package'\]"):
        resolve("model.zip", "Evil-v0", safe=True)
    assert not (tmp_path / "executed").exists()


@pytest.fixture
def normalized():
    env = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]), clip_obs=3.0)
    model = SAC("MlpPolicy", env, buffer_size=200, learning_starts=1000, **small()).learn(100)
    TrainingEnvironment("Pendulum-v1", normalize=True).store_in(model)
    return model, env


def test_statistics_have_a_plain_form(normalized, tmp_path):
    model, env = normalized
    save_plain(model, tmp_path / "plain.zip", plain_files.describe_statistics(env))
    env.save(str(tmp_path / "vecnormalize.pkl"))
    expected = evaluate(model, "Pendulum-v1", 1, vec_normalize=str(tmp_path / "vecnormalize.pkl"))
    assert evaluate(tmp_path / "plain.zip", "Pendulum-v1", 1) == expected
    assert evaluate(model, "Pendulum-v1", 1, vec_normalize=str(tmp_path / "plain.zip")) == expected


def test_statistics_of_dict_observations_have_a_plain_form(tmp_path):
    env = VecNormalize(DummyVecEnv([lambda: DotEnv(size=20, obs_type="dict")]), norm_obs_keys=["state"])
    env.reset()
    for _ in range(5):
        env.step(env.action_space.sample()[None])
    env.training = env.norm_reward = False
    again = plain_files.normalize(env.venv, json.loads(json.dumps(plain_files.describe_statistics(env))))
    observations = {key: space.sample()[None] for key, space in env.venv.observation_space.spaces.items()}
    for key, value in env.normalize_obs(observations).items():
        assert np.array_equal(again.normalize_obs(observations)[key], value)


def test_pickled_statistics_are_refused_by_name(normalized, tmp_path, marker):
    model, _ = normalized
    setattr(model, plain.ATTRIBUTE, plain.describe(model))
    model.save(tmp_path / "model.zip")
    (tmp_path / "Pendulum-v1").mkdir()
    (tmp_path / "Pendulum-v1" / "vecnormalize.pkl").write_bytes(pickle.dumps(Touch(marker)))
    with pytest.raises(UserError, match=r"vecnormalize.pkl is a pickle, which safe loading does not read"):
        resolve(tmp_path / "model.zip", "Pendulum-v1", safe=True)
    assert not marker.exists()


@pytest.mark.parametrize(
    "described", [{}, {"norm_obs": True}, {"norm_obs": True, "norm_obs_keys": 3, "clip_obs": "x", "epsilon": 0}]
)
def test_statistics_that_are_none_are_refused(described, normalized, tmp_path):
    model, env = normalized
    save_plain(model, tmp_path / "plain.zip", plain_files.describe_statistics(env))
    rewrite(tmp_path / "plain.zip", tmp_path / "hostile.zip", {"vecnormalize.json": json.dumps(described)})
    with pytest.raises(UserError, match="these are no statistics of VecNormalize"):
        make_evaluation_env(model, "Pendulum-v1", vec_normalize=str(tmp_path / "hostile.zip"))
