"""What settings may wrap around a task."""

import itertools

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv

from softbody_envs import ENV_IDS
from softbody_envs.experts import has_expert, make_expert
from softbody_envs.experts.pace import Pace
from softbody_envs.wrappers import ActionRepeat, Distraction, ProgressReward, ShowQuantity, SuccessReward

ID = "PourWater-v0"


def play(env, action, steps):
    env.reset(options={"variation": 3})
    return [env.step(np.full(env.action_space.shape, action, dtype=np.float32)) for _ in range(steps)]


@pytest.mark.parametrize("env_id", [ID, "StraightenRope-v0"])
def test_an_action_is_repeated_and_its_rewards_add_up(env_id):
    every = play(gym.make(env_id, obs_type="state"), 0.25, 45)
    fifth = play(ActionRepeat(gym.make(env_id, obs_type="state"), repeat=5, scale=0.5), 0.5, 9)
    assert all(np.array_equal(few[0], many[0]) for few, many in zip(fifth, every[4::5], strict=True))
    assert [few[4] for few in fifth] == [many[4] for many in every[4::5]]
    sums = np.array([many[1] for many in every]).reshape(9, 5).sum(axis=1)
    assert [few[1] for few in fifth] == pytest.approx(sums)
    assert sums.any() == (env_id != ID)  # no water flows at this tilt


def test_actions_out_of_range_are_clipped_before_they_are_made_smaller():
    half = play(gym.make(ID, obs_type="state"), 0.5, 1)
    beyond = play(ActionRepeat(gym.make(ID, obs_type="state"), repeat=1, scale=0.5), 7.0, 1)
    assert np.array_equal(half[0][0], beyond[0][0])


def test_the_end_of_an_episode_ends_the_repetition():
    env = ActionRepeat(gym.make(ID, obs_type="state", max_episode_steps=7), repeat=5)
    first, last = play(env, 0.0, 2)
    assert not first[3] and last[3]


def test_wrong_actions_are_refused_as_without_it():
    env = ActionRepeat(gym.make(ID, obs_type="state"), repeat=5, scale=0.5)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="nan"):
        env.step(np.array([np.nan, 0.0, 0.0], dtype=np.float32))
    for action in (0.5, [0.5]):  # which numpy would repeat for each element
        with pytest.raises(ValueError, match="shape"):
            env.step(action)


@pytest.mark.parametrize("arguments", [dict(repeat=0), dict(repeat=1.5), dict(repeat=2, scale=0.0), dict(repeat=2, scale=2.0)])
def test_wrong_arguments_are_refused(arguments):
    with pytest.raises(ValueError, match=list(arguments)[-1]):
        ActionRepeat(gym.make(ID, obs_type="state"), **arguments)


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped")
def test_it_is_a_gymnasium_environment_with_a_spec():
    env = ActionRepeat(gym.make(ID, obs_type="state"), repeat=5, scale=0.5)
    check_env(env, skip_render_check=True)
    again = gym.make(env.spec)
    assert isinstance(again, ActionRepeat) and (again.repeat, again.scale) == (5, 0.5)


@pytest.mark.parametrize("wrap", [ProgressReward, lambda env: ProgressReward(ActionRepeat(env, 2, 0.5))])
def test_the_sum_of_the_progress_is_the_final_performance(wrap):
    env, expert = wrap(gym.make("StraightenRope-v0", obs_type="state")), make_expert("StraightenRope-v0")
    observation, info = env.reset(options={"variation": 3})
    expert.reset()
    rewards, done = [], False
    while not done:
        observation, reward, _, done, info = env.step(expert.act(observation))
        rewards.append(reward)
    assert sum(rewards) == pytest.approx(10.0 * info["normalized_performance"])
    assert abs(info["normalized_performance"]) > 0.1


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped")
@pytest.mark.parametrize("key", ["monotone", "normalized_performance"])
def test_the_true_quantity_stands_beside_the_image(key):
    env = ShowQuantity(ActionRepeat(gym.make("FallingBall-v0", image_size=40), repeat=4), key=key)
    check_env(env, skip_render_check=True)
    again = gym.make(env.spec)
    assert isinstance(again, ShowQuantity) and again.key == key
    observation, info = env.reset(options={"variation": 3})
    seen = [observation["quantity"].item()]
    told = [info[key]]
    for _ in range(3):
        observation, *_, info = env.step(env.action_space.sample())
        seen.append(observation["quantity"].item())
        told.append(info[key])
    assert seen == pytest.approx(told, rel=1e-6) and len(set(seen)) == 4
    assert observation["image"].shape == (40, 40, 3)


def test_the_true_quantity_needs_an_image():
    with pytest.raises(ValueError, match="observes images"):
        ShowQuantity(gym.make(ID, obs_type="state"))


def test_success_alone_is_rewarded():
    env = SuccessReward(gym.make("FallingBall-v0", image_size=40), scale=3.0)
    env.reset(seed=0)
    done, rewards, successes = False, [], []
    while not done:
        _, reward, _, done, info = env.step(env.action_space.sample())
        rewards.append(reward)
        successes.append(info["is_success"])
    assert rewards == [3.0 * success for success in successes] and set(successes) == {False, True}
    with pytest.raises(ValueError, match="scale"):
        SuccessReward(env, scale=0.0)


def pictures(steps=9, **kwargs):
    """Images of a scene in which nothing moves but the distraction."""
    env = Distraction(gym.make(ID, image_size=40), **kwargs)
    first = env.reset(options={"variation": 3})[0]
    return [first, *(env.step(np.zeros(3, np.float32))[0] for _ in range(steps))]


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped")
@pytest.mark.parametrize("motion", ["swing", "drift"])
def test_a_distraction_is_a_part_of_the_scene(motion):
    env = Distraction(gym.make("FallingBall-v0", image_size=40), motion=motion, jitter=2)
    check_env(env, skip_render_check=True)
    assert gym.make(env.spec).motion == motion
    one, other = (pictures(motion=motion, jitter=2, strength=0.5) for _ in range(2))
    assert all(map(np.array_equal, one, other))
    assert not np.array_equal(one[0], one[1])
    undistracted = gym.make(ID, image_size=40).reset(options={"variation": 3})[0]
    assert np.array_equal(pictures(motion=motion, strength=0.0)[0], undistracted)
    assert not np.array_equal(pictures(motion=motion, strength=0.0, jitter=2)[0], undistracted)


def test_a_swing_comes_back_and_a_drift_moves_on():
    swing, drift = (pictures(motion=motion, strength=1.0) for motion in ("swing", "drift"))
    assert np.array_equal(swing[0], swing[Distraction.period])
    assert not np.array_equal(drift[0], drift[Distraction.period])
    for before, after in itertools.pairwise(drift):
        assert np.array_equal(np.roll(before, Distraction.speed, axis=1), after)


@pytest.mark.parametrize(
    "arguments", [dict(motion="jump"), dict(motion="swing", strength=2.0), dict(motion="drift", jitter=-1)]
)
def test_wrong_distractions_are_refused(arguments):
    with pytest.raises(ValueError, match=list(arguments)[-1]):
        Distraction(gym.make(ID, image_size=40), **arguments)
    images = gym.make(ID, image_size=40)
    grey = gym.wrappers.GrayscaleObservation(images, keep_dim=True)
    oblong = gym.wrappers.ResizeObservation(images, (40, 60))
    floats = gym.wrappers.TransformObservation(images, lambda o: o / 255, gym.spaces.Box(0.0, 1.0, (40, 40, 3), np.float32))
    for env in (gym.make(ID, obs_type="state"), gym.make("FrozenLake-v1"), grey, oblong, floats):
        with pytest.raises(ValueError, match="square RGB images of uint8"):
            Distraction(env, motion="swing")


def test_an_episode_does_not_inherit_the_performance_of_the_last_one():
    env = ProgressReward(gym.make("StraightenRope-v0", obs_type="state"), scale=1.0)
    for variation in (1, 2):
        _, before = env.reset(options={"variation": variation})
        _, reward, _, _, after = env.step(np.ones(env.action_space.shape, np.float32))
        assert reward == pytest.approx(after["normalized_performance"] - before["normalized_performance"])


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan")])
def test_a_scale_that_is_not_positive_is_refused(scale):
    with pytest.raises(ValueError, match="scale must be above 0"):
        ProgressReward(gym.make(ID, obs_type="state"), scale)


@pytest.mark.parametrize("repeat", [1, 5])
def test_a_video_of_repeated_actions_lasts_as_long_as_the_episode(tmp_path, repeat):
    env = gym.make("FallingBall-v0", obs_type="state", render_mode="rgb_array", render_size=32)
    env = gym.wrappers.RecordVideo(ActionRepeat(env, repeat=repeat), str(tmp_path / "videos"))
    env.reset(seed=0)
    while not env.step(env.action_space.sample())[3]:
        pass
    env.close()
    (video,) = tmp_path.glob("videos/*.mp4")
    properties = iio.immeta(video)
    assert properties["fps"] == pytest.approx(12.5 / repeat, rel=0.01)
    assert properties["duration"] == pytest.approx(50 * 0.08, abs=2 * 0.08 * repeat)


def test_recorders_of_vector_environments_see_the_same_rate():
    env = DummyVecEnv([lambda: ActionRepeat(gym.make(ID, obs_type="state", render_mode="rgb_array"), repeat=5)])
    assert env.metadata["render_fps"] == pytest.approx(2.5)
    assert gym.make(ID).metadata["render_fps"] == pytest.approx(12.5)
    env.close()


@pytest.mark.parametrize("env_id", [env_id for env_id in ENV_IDS if has_expert(env_id)])
def test_a_success_is_rewarded_while_it_lasts_in_every_task(env_id):
    env = SuccessReward(ActionRepeat(gym.make(env_id, obs_type="state"), 5), threshold=0.5)
    expert = make_expert(env_id, Pace.of(env))
    observation, _ = env.reset(seed=0, options={"variation": 3})
    expert.reset()
    rewards, done = [], False
    while not done:
        observation, reward, _, done, info = env.step(expert.act(observation))
        rewards.append(reward)
        assert reward == (1.0 if info["normalized_performance"] >= 0.5 else 0.0)
    assert set(rewards) == {0.0, 1.0}


@pytest.mark.parametrize("threshold", [0.0, -0.5, float("nan")])
def test_a_threshold_that_the_reset_passes_is_refused(threshold):
    with pytest.raises(ValueError, match="threshold must be above 0"):
        SuccessReward(gym.make(ID, obs_type="state"), threshold=threshold)


@pytest.mark.parametrize(
    "wrap, key",
    [
        (ProgressReward, "normalized_performance"),
        (SuccessReward, "is_success"),
        (lambda env: SuccessReward(env, threshold=0.5), "normalized_performance"),
        (ShowQuantity, "monotone"),
        (lambda env: Distraction(env, motion="drift"), "variation"),
    ],
)
def test_what_an_environment_does_not_report_is_named(wrap, key):
    class Silent(gym.Env):
        observation_space = gym.spaces.Box(0, 255, (36, 36, 3), np.uint8)
        action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

        def reset(self, *, seed=None, options=None):
            return np.zeros((36, 36, 3), np.uint8), {}

        def step(self, action):
            return np.zeros((36, 36, 3), np.uint8), 0.0, False, False, {}

    env = wrap(Silent())
    with pytest.raises(gym.error.Error, match=f"needs info\\['{key}'\\], which .*Silent.* does not report"):
        env.reset()
        env.step(np.zeros(1, np.float32))
