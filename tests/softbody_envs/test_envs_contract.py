"""What holds for every task: the checkers, determinism, vectors of environments, faults of the caller, memory."""

import gc
import json
import pickle
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import psutil
import pytest
import trajectories
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv
from trajectories import actions, digest, make, record

from softbody_envs import ENV_IDS
from softbody_envs.experts import make_expert
from softbody_envs.tasks.falling_ball import FallingBallEnv

INFO_TYPES = {
    "performance": float,
    "normalized_performance": float,
    "is_success": bool,
    "monotone": float,
    "variation": int,
}

for_every_task = pytest.mark.parametrize("env_id", ENV_IDS)


@pytest.fixture
def env(env_id):
    env = make(env_id)
    yield env
    env.close()


@pytest.fixture(scope="module")
def fresh_processes():
    """What two new processes make of every task."""
    command = [sys.executable, trajectories.__file__]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    return [json.loads(process.communicate()[0]) for process in processes]


def equal(a, b):
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    return np.array_equal(a, b)


# -- checkers ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env_id", "obs_type"), [*((env_id, "pixels") for env_id in ENV_IDS), (ENV_IDS[-1], "state"), (ENV_IDS[-1], "dict")]
)
def test_checkers_have_no_complaint(env_id, obs_type, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make(env_id, obs_type=obs_type, image_size=36, render_mode="rgb_array", render_size=36)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
        sb3_check_env(env)
    env.close()


@for_every_task
def test_spaces_and_names_agree(env, env_id):
    observation, _ = env.reset(seed=0)
    assert observation["image"].shape == (trajectories.SIZE, trajectories.SIZE, 3)
    assert observation["image"].dtype == np.uint8
    assert observation["state"].shape == (len(env.unwrapped.state_names),)
    assert len(set(env.unwrapped.state_names)) == len(env.unwrapped.state_names)
    np.testing.assert_array_equal(observation["state"], env.unwrapped.state())
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (env.unwrapped.action_size,), np.float32)


@for_every_task
def test_every_reset_and_step_tells_the_same_things(env, env_id):
    _, info = env.reset(options={"variation": 9})
    assert info["normalized_performance"] == 0.0
    assert not info["is_success"]
    assert info["variation"] == 9
    for action in [None, *actions(env_id, 3)]:
        if action is not None:
            _, reward, terminated, _, info = env.step(action)
            assert type(reward) is float
            assert terminated is False
        assert {key: type(value) for key, value in info.items()} == INFO_TYPES
        assert np.isfinite([float(value) for value in info.values()]).all()


@for_every_task
def test_episode_ends_at_the_horizon_by_truncation_and_every_state_element_varies(env_id):
    env = make(env_id, obs_type="state")
    horizon = env.spec.max_episode_steps
    states = []
    for variation in (0, 1):  # what does not vary within an episode varies between them
        state, _ = env.reset(options={"variation": variation})
        states.append(state)
    expert = _expert(env_id)
    env.action_space.seed(0)
    for step in range(1, horizon + 1):
        action = expert.act(state) if expert and step <= 0.9 * horizon else env.action_space.sample()
        state, _, terminated, truncated, _ = env.step(action)
        states.append(state)
        assert not terminated
        assert truncated == (step == horizon)
    env.close()
    constant = [name for name, spread in zip(env.unwrapped.state_names, np.ptp(states, axis=0), strict=True) if spread == 0]
    assert constant == []


def _expert(env_id):
    try:
        return make_expert(env_id)
    except ValueError:  # the diagnostics have nothing to solve
        return None


# -- determinism -------------------------------------------------------------------------------------------------------


@for_every_task
def test_same_actions_give_the_same_bits_in_fresh_processes_and_after_any_history(env, env_id, fresh_processes):
    first, second = fresh_processes
    assert first[env_id] == second[env_id]
    env.reset(seed=3, options={"variation": 17})
    env.action_space.seed(3)
    for _ in range(7):
        env.step(env.action_space.sample())
    assert digest(record(env, env_id)) == first[env_id]
    assert digest(record(env, env_id)) == first[env_id]


@for_every_task
def test_environments_in_one_process_do_not_disturb_each_other(env_id, fresh_processes):
    env = make(env_id)
    others = [make(other, obs_type="state") for other in ENV_IDS]  # one of the same task among them
    for other in others:
        other.reset(seed=1)
        other.action_space.seed(1)

    resets = iter((True,))  # in the middle of the episode: Bullet has settings that are the whole process's

    def stir():
        again = next(resets, False)
        for other in others:
            if again:
                other.reset(seed=2)
            other.step(other.action_space.sample())

    try:
        assert digest(record(env, env_id, meanwhile=stir)) == fresh_processes[0][env_id]
    finally:
        for each in (env, *others):
            each.close()


@for_every_task
def test_pickled_environment_is_made_anew_with_the_same_arguments(env, env_id, fresh_processes):
    env.reset(seed=0)
    env.step(env.action_space.sample())
    copied = pickle.loads(pickle.dumps(env.unwrapped))
    assert (copied.obs_type, copied.image_size, copied.split) == ("dict", trajectories.SIZE, "train")
    assert copied.observation_space == env.observation_space
    assert digest(record(copied, env_id)) == fresh_processes[0][env_id]
    copied.close()


@for_every_task
def test_index_names_a_variation_whatever_the_seed_and_variations_differ(env, env_id):
    starts = {}
    for variation in (0, 799, 800, 999):
        for seed in (0, 1):
            observation, info = env.reset(seed=seed, options={"variation": variation})
            assert info["variation"] == variation
            assert equal(observation, starts.setdefault(variation, observation))
    assert len({start["state"].tobytes() for start in starts.values()}) == len(starts)


@for_every_task
@pytest.mark.parametrize("variation", [-1, 1000, 1.0, "3", True, None])
def test_unknown_variation_is_refused(env, env_id, variation):
    with pytest.raises(ValueError, match="variation"):
        env.reset(options={"variation": variation})


@for_every_task
def test_unknown_option_is_refused(env, env_id):
    with pytest.raises(ValueError, match="colour"):
        env.reset(options={"colour": 3})
    with pytest.raises(ValueError, match="'a', 1"):
        env.reset(options={1: 2, "a": 3})
    for options in (5, "variation"):
        with pytest.raises(ValueError, match="options must be a dict"):
            env.reset(options=options)


@pytest.mark.parametrize(("split", "low", "high"), [("train", 0, 799), ("eval", 800, 999)])
def test_reset_draws_from_its_split_and_the_seed_decides(split, low, high):
    env = make("FallingBall-v0", obs_type="state", split=split)

    def draw():
        return [env.reset(seed=4 if i == 0 else None)[1]["variation"] for i in range(50)]

    drawn = draw()
    assert low <= min(drawn) and max(drawn) <= high
    assert len(set(drawn)) > 20
    assert draw() == drawn
    env.close()


# -- the caller's faults -----------------------------------------------------------------------------------------------


@for_every_task
def test_bad_actions_are_refused_and_change_nothing(env, env_id):
    size = env.action_space.shape[0]
    undisturbed = make(env_id)
    for each in (env, undisturbed):
        each.reset(seed=0, options={"variation": 2})
    good = actions(env_id, 3)
    bad = {
        "finite": [np.full(size, np.nan), np.r_[np.zeros(size - 1), np.inf], np.r_[-np.inf, np.zeros(size - 1)]],
        "shape": [np.zeros(size + 1), np.zeros((1, size)), np.float32(0.0), np.zeros(0)],
    }
    for action in good:
        for problem, refused in bad.items():
            for wrong in refused:
                with pytest.raises(ValueError, match=problem):
                    env.unwrapped.step(wrong)
        ours, theirs = env.step(action), undisturbed.step(action)
        assert equal(ours[0], theirs[0])
        assert ours[1:] == theirs[1:]
    undisturbed.close()


@for_every_task
def test_actions_out_of_range_are_clipped(env, env_id):
    other = make(env_id)
    size = env.action_space.shape[0]
    signs = np.where(np.arange(size) % 2, -1.0, 1.0)
    for each in (env, other):
        each.reset(seed=0, options={"variation": 2})
    for _ in range(3):
        assert equal(env.step(signs * 1000.0)[0], other.step(signs)[0])
    other.close()


@for_every_task
def test_step_and_render_before_reset_say_so(env_id):
    env = make(env_id, render_mode="rgb_array").unwrapped
    for call in (lambda: env.step(env.action_space.sample()), env.render):
        with pytest.raises(gym.error.ResetNeeded):
            call()


def test_a_renderer_that_fails_is_never_replaced_by_another(monkeypatch):
    def attach(world):
        raise RuntimeError("no driver")

    env = make("FallingBall-v0").unwrapped
    monkeypatch.setattr(env.renderer, "attach", attach)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="no driver"):
            env.reset()


def test_rounding_does_not_decide_on_success(monkeypatch):
    env = make("PourWaterAmount-v0").unwrapped
    env.reset(options={"variation": 0})
    monkeypatch.setattr(env, "normalized_performance", lambda: 1 - 0.1 - 1e-16)
    assert env._info()["is_success"]
    monkeypatch.setattr(env, "normalized_performance", lambda: 0.899)
    assert not env._info()["is_success"]


@pytest.mark.parametrize("argument", ["obs_type", "split", "renderer", "render_mode"])
def test_unknown_argument_is_refused_with_the_choices(argument):
    with pytest.raises(ValueError, match=f"{argument}.*'nonsense'"):
        gym.make(ENV_IDS[0], **{argument: "nonsense"})


# -- arrays and pictures -----------------------------------------------------------------------------------------------


@for_every_task
def test_no_array_is_shared(env, env_id):
    observation, _ = env.reset(options={"variation": 4})
    for action in actions(env_id, 3):
        kept = {key: value.copy() for key, value in observation.items()}
        following, *_ = env.step(action)
        assert equal(observation, kept)
        for key in observation:
            assert not np.shares_memory(observation[key], following[key])
        before = env.unwrapped.state()
        for value in (following["state"], env.unwrapped.state()):
            value[:] = 7.0
        following["image"][:] = 0
        np.testing.assert_array_equal(env.unwrapped.state(), before)
        observation = following


@for_every_task
def test_images_have_the_size_asked_for_and_show_what_moves(env_id):
    env = gym.make(env_id, image_size=84, render_mode="rgb_array", render_size=100)
    first, _ = env.reset(options={"variation": 4})
    assert first.shape == (84, 84, 3)
    assert env.render().shape == (100, 100, 3)
    last = first
    for action in actions(env_id, 6):
        last, *_ = env.step(action)
    assert (first != last).any(axis=2).sum() >= 10
    env.close()


@for_every_task
def test_render_mode_none_warns_and_gives_nothing(env, env_id):
    env.reset()
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.unwrapped.render() is None


@for_every_task
def test_closed_environment_can_be_used_again(env, env_id, fresh_processes):
    env.reset()
    env.close()
    env.close()
    assert digest(record(env, env_id)) == fresh_processes[0][env_id]


# -- many environments -------------------------------------------------------------------------------------------------


def _play_vector(vector, env_id, n):
    """States of SB3 worker 0, played as ``_play_alone`` does."""
    vector.seed(11)
    states = [vector.reset()[0]]
    for action in actions(env_id, 4):
        states.append(vector.step(np.stack([action] * n))[0][0])
    vector.close()
    return np.array(states)


def _play_alone(env_id):
    env = gym.make(env_id, obs_type="state")
    states = [env.reset(seed=11)[0]]
    states += [env.step(action)[0] for action in actions(env_id, 4)]
    env.close()
    return np.array(states)


@pytest.mark.parametrize(("env_id", "start_method"), [("FoldCloth-v0", "spawn"), ("StraightenRope-v0", "forkserver")])
def test_subproc_vec_env_plays_as_one_process_does(env_id, start_method):
    _check_subproc(env_id, start_method)


@pytest.mark.slow
@pytest.mark.parametrize("start_method", ["spawn", "forkserver"])
@for_every_task
def test_subproc_vec_env_plays_every_task(env_id, start_method):
    _check_subproc(env_id, start_method)


def _check_subproc(env_id, start_method):
    vector = make_vec_env(
        f"softbody_envs:{env_id}",  # a worker has not imported the package yet
        n_envs=2,
        vec_env_cls=SubprocVecEnv,
        vec_env_kwargs={"start_method": start_method},
        env_kwargs={"obs_type": "state"},
    )
    np.testing.assert_array_equal(_play_vector(vector, env_id, 2), _play_alone(env_id))


@for_every_task
def test_async_vector_env_plays_as_one_process_does(env_id):
    vector = gym.make_vec(env_id, num_envs=2, vectorization_mode="async", obs_type="state")
    states = [vector.reset(seed=11)[0][0]]
    states += [vector.step(np.stack([action] * 2))[0][0] for action in actions(env_id, 4)]
    vector.close()
    np.testing.assert_array_equal(states, _play_alone(env_id))


# -- memory ------------------------------------------------------------------------------------------------------------


def _growth(env_id, warmup, n, options=None):
    """Resident memory that ``n`` resets with a step and an image each add after some to warm up, MB."""
    env = make(env_id)
    env.action_space.seed(0)
    process = psutil.Process()
    for i in range(warmup + n):
        if i == warmup:
            gc.collect()
            before = process.memory_info().rss
        env.reset(seed=i, options=options)
        env.step(env.action_space.sample())
    gc.collect()
    after = process.memory_info().rss
    env.close()
    return (after - before) / 1e6


@for_every_task
def test_memory_does_not_grow_with_resets(env_id):
    assert _growth(env_id, warmup=10, n=20) < 5


@pytest.mark.slow
@for_every_task
def test_memory_does_not_grow_with_many_resets(env_id):
    """Bullet kept 5.7 kB of each scene of pouring: 2.8 MB here. A cloth's heap settles at 1.9 MB more."""
    growth = _growth(env_id, warmup=100, n=500, options={"variation": 3})
    print(env_id, f"{growth:.1f} MB")
    assert growth < 2.4


def test_a_scene_that_starts_solved_is_refused():
    class Solved(FallingBallEnv):
        best_performance = 0.0

        def performance(self):
            return 0.0

    with pytest.raises(
        ValueError, match=r"variation 7 starts solved.* performance\(\) is 0 at reset, and best_performance is 0"
    ):
        Solved().reset(options={"variation": 7})
