"""Variants of a task under an id or a class of one's own: they are recognized, have the same scenes and the same expert."""

import functools
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest

from softbody_envs import ENV_IDS
from softbody_envs.env import SoftbodyEnv
from softbody_envs.experts import EXPERT_IDS, has_expert, make_expert
from softbody_envs.registration import task_class
from softbody_envs.tasks.falling_ball import FallingBallEnv
from softbody_envs.tasks.pour_water import PourWaterEnv
from softbody_envs.tasks.straighten_rope import StraightenRopeEnv


class OwnReward(FallingBallEnv):
    def reward(self):
        return -1.0


class OwnDefaults(StraightenRopeEnv):
    def __init__(self, image_size=36, **kwargs):
        super().__init__(image_size=image_size, **kwargs)


class OwnRewardByWrapper(gym.Wrapper):
    def __init__(self, **kwargs):
        super().__init__(PourWaterEnv(**kwargs))


class NoTask(gym.Env):
    pass


def needs_more(env, **kwargs):
    return env


def needs_a_file(path="missing.txt", **kwargs):
    return open(path)


VARIANTS = {
    "subclass": (OwnReward, FallingBallEnv),
    "subclass with other defaults": (OwnDefaults, StraightenRopeEnv),
    "wrapper": (OwnRewardByWrapper, PourWaterEnv),
    "string": ("softbody_envs.tasks.falling_ball:FallingBallEnv", FallingBallEnv),
    "function": (lambda **kwargs: gym.wrappers.TransformReward(PourWaterEnv(**kwargs), lambda r: 2 * r), PourWaterEnv),
    "partial": (functools.partial(PourWaterEnv, image_size=36), PourWaterEnv),
}
OTHERS = {
    "another environment": NoTask,
    "missing module": "no_such_module:Env",
    "missing class": "softbody_envs.tasks.falling_ball:NoSuchEnv",
    "function that needs arguments": needs_more,
    "function that fails without arguments": needs_a_file,
    "nothing": None,
}


@pytest.fixture
def register():
    """Registers ids for the time of a test."""
    ids = []

    def register(entry_point, env_id="Own-v0", **kwargs):
        vector = {"vector_entry_point": "nowhere:Vector"} if entry_point is None else {}
        gym.register(env_id, entry_point=entry_point, **vector, **kwargs)
        ids.append(env_id)
        return env_id

    yield register
    for env_id in ids:
        del gym.registry[env_id]


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_our_ids_are_tasks_with_scenes_of_their_own(env_id):
    task = task_class(env_id)
    assert issubclass(task, SoftbodyEnv)
    assert "scenes" in vars(task)
    assert [task_class(other).scenes for other in ENV_IDS].count(task.scenes) == 1


@pytest.mark.parametrize(("entry_point", "parent"), VARIANTS.values(), ids=VARIANTS)
def test_a_variant_is_a_task_with_the_scenes_of_its_parent(register, entry_point, parent):
    env_id = register(entry_point, max_episode_steps=20, kwargs={"obs_type": "state"})
    assert issubclass(task_class(env_id), parent)
    own, ours = gym.make(env_id), parent(obs_type="state")
    for variation in (3, 800):
        options = {"variation": variation}
        np.testing.assert_array_equal(own.reset(options=options)[0], ours.reset(options=options)[0])
    own.close()
    ours.close()


def test_a_function_is_called_once_to_find_out_until_its_id_is_registered_again(register):
    calls = []

    def make(**kwargs):
        calls.append(kwargs)
        return FallingBallEnv(**kwargs)

    env_id = register(make, kwargs={"obs_type": "state"})
    for _ in range(3):
        assert task_class(env_id) is FallingBallEnv
        assert task_class(env_id.removesuffix("-v0")) is FallingBallEnv
    assert calls == [{"obs_type": "state"}]
    del gym.registry[env_id]
    gym.register(env_id, NoTask)
    assert task_class(env_id) is None
    assert len(calls) == 1


@pytest.mark.parametrize("entry_point", [needs_more, needs_a_file])
def test_a_function_that_cannot_be_called_is_named_once(register, entry_point):
    env_id = register(entry_point)
    with pytest.warns(UserWarning, match="Own-v0 is not taken for a task .* register it with kwargs= or as a class"):
        assert task_class(env_id) is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert task_class(env_id) is None


@pytest.mark.filterwarnings("ignore:.*is not taken for a task")
@pytest.mark.parametrize("entry_point", OTHERS.values(), ids=OTHERS)
def test_everything_else_is_no_task(register, entry_point):
    env_id = register(entry_point)
    assert task_class(env_id) is None
    assert not has_expert(env_id)


@pytest.mark.parametrize(
    "env_id", ["CartPole-v1", "NoSuchTask-v0", "PourWater-v7", "no_such_module:PourWater-v0", "not an id", ""]
)
def test_ids_of_others_and_unknown_ids_are_no_tasks(env_id):
    assert task_class(env_id) is None


def test_ids_are_understood_as_gymnasium_does(tmp_path, monkeypatch, register):
    assert task_class("PourWater") is PourWaterEnv
    assert task_class("softbody_envs:PourWater-v0") is PourWaterEnv
    code = "import gymnasium\ngymnasium.register('Own/Pour-v3', 'softbody_envs.tasks.pour_water:PourWaterEnv')\n"
    (tmp_path / "registers_own_pour.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    assert task_class("registers_own_pour:Own/Pour-v3") is PourWaterEnv
    del gym.registry["Own/Pour-v3"], sys.modules["registers_own_pour"]


def test_a_variant_has_the_expert_of_its_parent_or_its_own(register):
    assert type(make_expert(register(OwnDefaults, "OwnRope-v0"))) is type(make_expert("StraightenRope-v0"))

    class OwnExpert(OwnDefaults):
        expert = "softbody_envs.experts.pour_water:PourWaterExpert"

    assert type(make_expert(register(OwnExpert, "OwnExpert-v0"))) is type(make_expert("PourWater-v0"))


@pytest.mark.parametrize("env_id", ["FallingBall-v0", "CartPole-v1", "NoSuchTask-v0"])
def test_an_id_without_expert_is_refused_with_those_that_have_one(env_id):
    assert set(ENV_IDS) - set(EXPERT_IDS) == {"FallingBall-v0", "SwingingBall-v0"}
    with pytest.raises(ValueError, match=f"{env_id}.*PourWaterAmount-v0"):
        make_expert(env_id)
