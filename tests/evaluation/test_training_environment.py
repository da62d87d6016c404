"""A model is evaluated in the environment that it was trained in, from a run's folder, a path or the model alone."""

import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium.envs.classic_control import PendulumEnv
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from sb3_por import SACPOR
from sb3_por.common.errors import UserError, UserNote
from sb3_por.evaluation import evaluate
from sb3_por.evaluation.loading import resolve
from sb3_por.runs.environment import TrainingEnvironment, import_wrappers
from sb3_por.runs.folder import dump_settings, import_names, parse_settings
from sb3_por.training.zoo import main
from sb3_por.visual.made_of import made_of
from softbody_envs.registration import task_class
from softbody_envs.tasks.falling_ball import FallingBallEnv
from softbody_envs.wrappers import ActionRepeat

ROOT = Path(__file__).parents[2]
REPEAT = {"softbody_envs.wrappers.ActionRepeat": {"repeat": 5, "scale": 0.5}}
CLIP = {"gymnasium.wrappers.ClipReward": {"min_reward": -1.0, "max_reward": 0.0}}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of train.py with wrappers; its rewards are clipped, its actions repeated."""
    folder = tmp_path_factory.mktemp("logs")
    settings = [f"env_wrapper:{[CLIP, REPEAT]}", "learning_starts:10", "batch_size:8", "policy:MlpPolicy"]
    flags = ["--algo", "sac", "--env", "Pendulum-v1", "-n", "40", "--eval-freq", "40", "--eval-episodes", "1", "--seed", "1"]
    assert main([*flags, "-f", str(folder), "-params", *settings]) == 0
    return folder / "sac" / "Pendulum-v1_1"


def test_the_same_scores_from_folder_path_and_model(run, tmp_path):
    expected = evaluate(run, "Pendulum-v1", n_episodes=2)
    assert expected.lengths == [200, 200]
    alone = tmp_path / "model.zip"
    alone.write_bytes((run / "best_model.zip").read_bytes())
    for model in (run / "best_model.zip", str(alone), SAC.load(alone)):
        assert evaluate(model, "Pendulum-v1", n_episodes=2) == expected
    with np.load(run / "evaluations.npz") as file:
        assert expected.returns[0] == pytest.approx(file["results"][0, 0])
    bare = evaluate(SAC.load(alone), "Pendulum-v1", n_episodes=2, env_wrapper=lambda env: env)
    assert bare != expected


def test_a_run_of_the_rl_zoo_is_evaluated_in_its_environment(tmp_path):
    conf = tmp_path / "conf.yml"
    settings = {
        "n_timesteps": 40,
        "policy": "MlpPolicy",
        "n_steps": 20,
        "batch_size": 20,
        "normalize": "dict(norm_obs=True, norm_reward=False)",
        "env_wrapper": [{"softbody_envs.wrappers.ActionRepeat": {"repeat": 5, "scale": 0.5}}],
        "frame_stack": 2,
    }
    conf.write_text(yaml.safe_dump({"Pendulum-v1": settings}))
    flags = ["--algo", "ppo", "--env", "Pendulum-v1", "--env-kwargs", "g:1.0", "--seed", "1", "--eval-freq", "-1"]
    command = [sys.executable, "-m", "rl_zoo3.train", *flags, "-conf", str(conf), "-f", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    model = tmp_path / "ppo" / "Pendulum-v1_1" / "Pendulum-v1.zip"
    scores = evaluate(model, "Pendulum-v1", n_episodes=2)
    statistics = model.with_suffix("") / "vecnormalize.pkl"
    repeat = {"env_wrapper": lambda env: ActionRepeat(env, 5, 0.5)}
    given = {"env_kwargs": {"g": 1.0}, "vec_normalize": str(statistics), **repeat}
    assert scores == evaluate(PPO.load(model), "Pendulum-v1", n_episodes=2, **given)
    others = ({"env_kwargs": {"g": 10.0}}, {"env_wrapper": lambda env: env})
    assert all(scores != evaluate(model, "Pendulum-v1", n_episodes=2, **other) for other in others)


def test_a_loaded_model_that_is_saved_again_still_knows_its_environment(run, tmp_path):
    SAC.load(run / "best_model.zip").save(tmp_path / "again.zip")
    made_of = TrainingEnvironment.of_model(SAC.load(tmp_path / "again.zip"))
    assert made_of.env_id == "Pendulum-v1" and made_of.env_wrapper == [CLIP, REPEAT]


def test_another_environment_without_the_wrappers_is_noted(run):
    gym.register("OtherPendulum-v1", gym.spec("Pendulum-v1").entry_point, max_episode_steps=10)
    try:
        for model in (SAC.load(run / "best_model.zip"), run / "best_model.zip"):
            with pytest.warns(UserNote, match=r"OtherPendulum-v1 is made without .* Pendulum-v1 with env_wrapper"):
                evaluate(model, "OtherPendulum-v1", n_episodes=1)
    finally:
        gym.registry.pop("OtherPendulum-v1")


def test_a_model_whose_statistics_are_missing_is_noted():
    model = SAC("MlpPolicy", "Pendulum-v1", buffer_size=10)
    TrainingEnvironment("Pendulum-v1", normalize={"norm_obs": False}).store_in(model)
    assert resolve(model, "Pendulum-v1")[1]["vec_normalize"] is None
    TrainingEnvironment("Pendulum-v1", normalize=True).store_in(model)
    with pytest.warns(UserNote, match="made without what the model was trained in: Pendulum-v1 with normalize True"):
        resolve(model, "Pendulum-v1")


def test_evaluation_of_a_run_with_wrappers_leaves_gymnasium_alone(run):
    script = f"""
import sys, gymnasium
before = gymnasium.wrappers.TimeLimit, gymnasium.envs.registration.load_env_creator("gymnasium.wrappers:TimeLimit")
from sb3_por.evaluation import evaluate
assert evaluate({str(run)!r}, "Pendulum-v1", n_episodes=1).lengths == [200]
assert gymnasium.wrappers.TimeLimit is before[0] and gymnasium.wrappers.common.TimeLimit is before[1]
assert not any(name.partition(".")[0] == "rl_zoo3" for name in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_stacked_dict_observations_are_restored():
    env = VecFrameStack(make_vec_env("FallingBall-v0", env_kwargs={"obs_type": "dict", "image_size": 36}), 3)
    model = SAC("MultiInputPolicy", env, buffer_size=10)
    assert evaluate(model, "FallingBall-v0", n_episodes=1).lengths == [50]


@pytest.mark.parametrize(
    "spec",
    [
        "softbody_envs.wrappers.ActionRepeat",
        {"softbody_envs.wrappers.ActionRepeat": {"repeat": 2}},
        {ActionRepeat: {"repeat": 2}},
        ["gymnasium.wrappers.TimeAwareObservation", {"softbody_envs.wrappers.ActionRepeat": {"repeat": 2}}],
    ],
)
def test_wrappers_are_named_as_in_the_zoo(spec):
    arguments = {} if spec != "softbody_envs.wrappers.ActionRepeat" else {"repeat": 2}
    wrap = import_wrappers({spec: arguments} if arguments else spec)
    env = wrap(gym.make("Pendulum-v1"))
    assert isinstance(env, ActionRepeat) and env.repeat == 2
    assert isinstance(env.env, gym.wrappers.TimeAwareObservation) == isinstance(spec, list)


@pytest.mark.parametrize("spec", ["no_such.Wrapper", "gymnasium.wrappers.NoSuch", "nothing", {"a": {}, "b": {}}, 3])
def test_what_is_no_wrapper_is_said(spec):
    with pytest.raises(UserError, match="cannot import the wrapper"):
        import_wrappers(spec)


def test_settings_keep_tuples_and_classes():
    settings = {
        "shape": (36, 36),
        "dtype": np.float32,
        "nested": [{"gymnasium.wrappers.ResizeObservation": {"shape": (4, 4)}}],
    }
    assert import_names(parse_settings(dump_settings(settings))) == settings
    assert parse_settings("a: !!python/name:no_such.thing ''") == {"a": "no_such.thing"}
    with pytest.raises(ValueError, match="could not determine a constructor"):
        parse_settings("a: !!python/object/apply:os.getcwd []")


class OwnBall(FallingBallEnv):
    """The task with another reward, as users write it."""

    def reward(self):
        return 0.5


def test_a_users_own_task_is_scored_on_held_out_scenes():
    gym.register("OwnBall-v0", OwnBall, max_episode_steps=20)
    gym.register("SmallBall-v0", gym.spec("FallingBall-v0").entry_point, kwargs={"image_size": 36}, max_episode_steps=20)
    try:
        for env_id in ("OwnBall-v0", "SmallBall-v0"):
            model = SAC("CnnPolicy", gym.make(env_id, image_size=36), buffer_size=10)
            evaluation = evaluate(model, env_id, n_episodes=2)
            assert evaluation.variations == [800, 801] and evaluation.lengths == [20, 20]
        assert task_class("OwnBall-v0") is OwnBall and task_class("Pendulum-v1") is None
    finally:
        gym.registry.pop("OwnBall-v0")
        gym.registry.pop("SmallBall-v0")


class Unrecorded(gym.ActionWrapper):
    """A wrapper that does not tell its arguments."""

    def __init__(self, env, factor):
        super().__init__(env)
        self.factor = factor

    def action(self, action):
        return self.factor * action


def scores(model, **given):
    """Returns in two episodes; fails if something is left out with a note."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", ".*made without", UserNote)
        return evaluate(model, "Pendulum-v1", n_episodes=2, **given).returns


@pytest.mark.parametrize("cls", [SACPOR, SAC])
def test_a_model_trained_from_python_is_evaluated_inside_its_wrappers(cls, tmp_path):
    env = gym.make("Pendulum-v1", g=1.0, max_episode_steps=7, render_mode="rgb_array")
    env = gym.wrappers.RecordEpisodeStatistics(gym.wrappers.TimeLimit(ActionRepeat(env, 5, 0.5), 6))
    env = gym.wrappers.ClipReward(env, -5.0, 0.0)
    model = cls("MlpPolicy", env, buffer_size=100, learning_starts=1000, seed=0).learn(10)

    def wrap(inner):
        return gym.wrappers.ClipReward(ActionRepeat(inner, 5, 0.5), -5.0, 0.0)

    same = {"env_kwargs": {"g": 1.0}, "env_wrapper": wrap}
    assert scores(model) == scores(model, **same) and len(scores(model)) == 2
    assert scores(model) != scores(model, env_wrapper=lambda inner: inner)
    assert scores(model) != scores(model, env_kwargs={"g": 10.0})
    if cls is SACPOR:  # SB3's own classes do not save it
        assert model.environment_made_of["env_wrapper"] == [
            {"softbody_envs.wrappers.ActionRepeat": {"repeat": 5, "scale": 0.5}},
            {"gymnasium.wrappers.ClipReward": {"min_reward": -5.0, "max_reward": 0.0}},
        ]
        model.save(tmp_path / "model.zip")
        assert scores(tmp_path / "model.zip") == scores(SACPOR.load(tmp_path / "model.zip")) == scores(model)
        env = gym.make("Pendulum-v1")
        SACPOR.load(tmp_path / "model.zip", env=env).save(tmp_path / "again.zip")  # has not learned there
        assert scores(tmp_path / "again.zip") == scores(model)


def test_arguments_that_are_tuples_stay_tuples(tmp_path):
    """``ResizeObservation`` refuses a list."""
    env = gym.wrappers.ResizeObservation(gym.make("FallingBall-v0", obs_type="pixels", image_size=48), (40, 44))
    model = SACPOR("CnnPolicy", env, buffer_size=100, learning_starts=1000).learn(5)
    model.save(tmp_path / "model.zip")
    with warnings.catch_warnings():
        warnings.filterwarnings("error", ".*made without", UserNote)
        returns = [evaluate(given, "FallingBall-v0", n_episodes=2).returns for given in (model, tmp_path / "model.zip")]
    assert returns[0] == returns[1]


@pytest.mark.parametrize(
    ("wrap", "name"),
    [
        (lambda env: Unrecorded(env, 0.5), "Unrecorded"),
        (lambda env: gym.wrappers.TransformAction(env, lambda action: action, env.action_space), "TransformAction"),
    ],
)
def test_a_wrapper_that_cannot_be_made_again_is_noted(wrap, name, tmp_path):
    env = ActionRepeat(wrap(gym.make("Pendulum-v1")), 2)
    model = SACPOR("MlpPolicy", env, buffer_size=100, learning_starts=1000).learn(5)
    model.save(tmp_path / "model.zip")
    for given in (model, tmp_path / "model.zip"):
        with pytest.warns(UserNote, match=f"made without what the model was trained in: .*unknown .*{name}"):
            evaluate(given, "Pendulum-v1", n_episodes=1)
    scores(model, env_wrapper=lambda inner: ActionRepeat(wrap(inner), 2))


def test_the_statistics_of_a_model_trained_from_python_are_asked_for(tmp_path):
    env = VecNormalize(make_vec_env("Pendulum-v1"))
    model = SACPOR("MlpPolicy", env, buffer_size=100, learning_starts=1000).learn(5)
    model.save(tmp_path / "model.zip")
    env.save(str(tmp_path / "statistics.pkl"))
    with pytest.warns(UserNote, match="Pendulum-v1 with normalize {'norm_obs': True"):
        evaluate(tmp_path / "model.zip", "Pendulum-v1", n_episodes=1)
    for given in (model, tmp_path / "model.zip"):
        scores(given, vec_normalize=str(tmp_path / "statistics.pkl"))


def test_an_episode_that_a_wrapper_ends_is_scored(tmp_path):
    """``Monitor`` is inside of the wrappers, and does not count it."""
    limit = {"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 3}}
    settings = [f"env_wrapper:{[REPEAT, limit]}", "learning_starts:10", "batch_size:8", "policy:MlpPolicy"]
    flags = ["--algo", "sac", "--env", "Pendulum-v1", "-n", "12", "--eval-freq", "12", "--eval-episodes", "2", "--seed", "1"]
    assert main([*flags, "-f", str(tmp_path), "-params", *settings]) == 0
    run = tmp_path / "sac" / "Pendulum-v1_1"
    evaluation = evaluate(run, "Pendulum-v1", n_episodes=2)
    assert evaluation.lengths == [15, 15]
    with np.load(run / "evaluations.npz") as file:
        assert file["ep_lengths"].tolist() == [[15, 15]]
        assert file["results"][0] == pytest.approx(evaluation.returns)


def test_what_a_factory_wraps_is_not_wrapped_twice():
    gym.register("Factory-v0", lambda **kwargs: ActionRepeat(PendulumEnv(**kwargs), 2), max_episode_steps=30)
    try:
        model = SACPOR("MlpPolicy", gym.make("Factory-v0", g=1.0), buffer_size=100, learning_starts=1000).learn(5)
        assert made_of(model.env)["env_wrapper"] == []
        assert evaluate(model, "Factory-v0", n_episodes=1).lengths == [30]
    finally:
        gym.registry.pop("Factory-v0")
