"""Experts play through the wrappers of the settings: they know how far an action carries, and whether hands can open."""

import gymnasium as gym
import numpy as np
import pytest

import softbody_envs
from softbody_envs.experts import make_expert
from softbody_envs.experts.pace import FULL_SPEED, Pace
from softbody_envs.experts.pour_water import PourWaterAmountExpert
from softbody_envs.wrappers import ActionRepeat, ProgressReward

#: Id, repeat and scale of ``ActionRepeat``, arguments of the environment, and the lowest mean score
PACES = [
    ("PourWater-v0", 10, 0.7, {}, 0.85),
    ("FoldCloth-v0", 10, 0.3, {"keep_hold": True}, 0.95),
    ("FoldCloth-v0", 5, 0.5, {}, 0.95),
    ("DropFoldCloth-v0", 1, 1.0, {"keep_hold": True, "max_episode_steps": 50}, 0.9),
    ("StraightenRope-v0", 3, 0.5, {}, 0.9),
    ("StraightenRope-v0", 2, 0.6, {"keep_hold": True}, 0.6),  # in a heap other parts than the ends are nearer
]


def play(env, expert, variation):
    """Normalized performance at the end of an episode."""
    env.reset(options={"variation": variation})
    truncated = False
    while not truncated:
        _, _, _, truncated, info = env.step(expert.act(env.unwrapped.state()).astype(np.float32))
    return info["normalized_performance"]


@pytest.mark.parametrize("variations", [(0, 400), pytest.param(range(0, 800, 40), marks=pytest.mark.slow)], ids=["2", "20"])
@pytest.mark.parametrize("env_id, repeat, scale, kwargs, lowest", PACES)
def test_experts_act_well_through_repeated_actions(env_id, repeat, scale, kwargs, lowest, variations):
    env = ActionRepeat(gym.make(env_id, obs_type="state", **kwargs), repeat, scale)
    expert, scores = make_expert(env_id, Pace.of(env)), []
    for variation in variations:
        expert.reset()
        scores.append(play(env, expert, variation))
    env.close()
    assert np.mean(scores) >= lowest, scores


@pytest.mark.parametrize(
    "env_id, kwargs", [("PourWater-v0", {}), ("StraightenRope-v0", {}), ("StraightenRope-v0", {"keep_hold": True})]
)
def test_an_expert_that_is_imitated_from_images_has_no_memory(env_id, kwargs):
    """Who sees what it sees, but not what it has done, can do the same."""
    env = gym.make(env_id, obs_type="state", **kwargs)
    state, _ = env.reset(options={"variation": 3})
    expert = make_expert(env_id, Pace.of(env))
    for _ in range(12):
        action = expert.act(state)
        np.testing.assert_array_equal(action, make_expert(env_id, Pace.of(env)).act(state))
        state, *_ = env.step(action.astype(np.float32))
    env.close()


def test_a_pace_is_read_off_the_wrappers():
    env = gym.make("FoldCloth-v0", keep_hold=True)
    assert Pace.of(env) == Pace(keep_hold=True)
    wrapped = ActionRepeat(ProgressReward(ActionRepeat(env, 5, 0.5)), 2, 0.8)
    assert Pace.of(wrapped) == Pace(10, 0.4, keep_hold=True) and Pace.of(wrapped).stride == 4.0
    assert Pace.of(gym.make("PourWater-v0")) == FULL_SPEED
    assert Pace(10).actions(28) == 3 and Pace(10).actions(28, at_least=5) == 5


def test_another_attempt_pours_more_after_too_little_and_less_after_too_much():
    env = ActionRepeat(gym.make("PourWaterAmount-v0", obs_type="state"), 10, 0.7)
    expert = PourWaterAmountExpert(Pace.of(env))
    assert expert.attempts > 1 and PourWaterAmountExpert().attempts == 1
    expert.reset()
    scores, aims = [], [expert._aim]
    for _ in range(expert.attempts):
        scores.append(play(env, expert, 5))
        poured_too_little = expert._left < expert._goal
        expert.retry()
        aims.append(expert._aim)
        assert (aims[-1] > aims[-2]) == poured_too_little
    env.close()
    assert max(scores) > 0.85 and max(scores) > min(scores)
    expert.reset()
    assert expert._aim == aims[0]


def test_every_expert_takes_a_pace():
    for env_id in softbody_envs.experts.EXPERT_IDS:
        assert type(make_expert(env_id, Pace(3, 0.5))) is type(make_expert(env_id))
