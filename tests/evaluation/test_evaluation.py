"""Evaluation plays the same held-out episodes for every model; models load from any sound file; videos show the episodes."""

import json
import zipfile

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC
from sb3_contrib.common.wrappers import TimeFeatureWrapper
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize
from toy_envs import DotEnv

from sb3_por import VisualSAC, VisualTQC
from sb3_por.common.errors import UserError, UserNote
from sb3_por.evaluation.episodes import Episode, Evaluation, FixedEpisodes, evaluation_episodes, run_episodes
from sb3_por.evaluation.evaluate import evaluate
from sb3_por.evaluation.loading import load_model, trained_in
from sb3_por.evaluation.reference_policies import ExpertModel, IdleModel, RandomModel
from sb3_por.evaluation.safe_loading import load_safe
from sb3_por.evaluation.video import record_video, write_video
from softbody_envs.wrappers import ActionRepeat

EPISODE_STEPS = 7


class SeenVariations(gym.Wrapper):
    """Notes the variation and seed of every reset."""

    def __init__(self, env):
        super().__init__(env)
        self.seen = []

    def reset(self, *, seed=None, options=None):
        self.seen.append((seed, (options or {}).get("variation")))
        return self.env.reset(seed=seed, options=options)


def short_pendulum():
    return gym.make("Pendulum-v1", max_episode_steps=EPISODE_STEPS)


@pytest.fixture(scope="module")
def pendulum_model():
    return SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, seed=3)


@pytest.fixture(scope="module")
def pendulum_zip(pendulum_model, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "pendulum.zip"
    pendulum_model.save(path)
    return path


def test_episodes_are_held_out_variations_in_a_fixed_order():
    episodes = evaluation_episodes("PourWater-v0", 203, seed=5)
    assert episodes[:2] == [Episode(0, 5, 800), Episode(1, 6, 801)]
    assert episodes[199].variation == 999 and episodes[200].variation == 800
    assert evaluation_episodes("Pendulum-v1", 1) == [Episode(0, 0, None)]


@pytest.mark.parametrize("n_envs", [1, 2, 3])
def test_any_number_of_environments_plays_the_same_episodes(n_envs, pendulum_model):
    env = make_vec_env(short_pendulum, n_envs=n_envs, wrapper_class=FixedEpisodes)
    episodes = [Episode(k, 40 + k, None) for k in range(4)]
    first, second = (run_episodes(pendulum_model, env, episodes) for _ in range(2))
    assert first.returns == second.returns
    assert first.lengths == [EPISODE_STEPS] * 4
    for k, expected in enumerate(first.returns):
        single = make_vec_env(short_pendulum, wrapper_class=FixedEpisodes)
        assert run_episodes(pendulum_model, single, [episodes[k]]).returns == [pytest.approx(expected)]


def test_evaluation_resets_with_its_own_seed_and_variation():
    seen = SeenVariations(gym.make("PourWater-v0", obs_type="state", split="eval"))
    env = FixedEpisodes(seen)
    env.play([Episode(0, 10, 803), Episode(1, 11, 901)])
    infos = [env.reset(seed=99)[1] for _ in range(3)]
    assert seen.seen == [(10, 803), (11, 901), (10, 803)]
    assert [info["variation"] for info in infos] == [803, 901, 803]
    env.close()


def test_evaluation_leaves_the_global_generators_alone(pendulum_model):
    np.random.seed(1)
    th.manual_seed(1)
    evaluate(pendulum_model, "Pendulum-v1", n_episodes=1)
    drawn = np.random.rand(), th.rand(1).item()
    np.random.seed(1)
    th.manual_seed(1)
    assert drawn == (np.random.rand(), th.rand(1).item())


@pytest.mark.parametrize("obs_type", ["pixels", "dict", "state"])
def test_observations_are_those_the_model_was_trained_on(obs_type):
    policy = {"pixels": "CnnPolicy", "dict": "MultiInputPolicy", "state": "MlpPolicy"}[obs_type]
    env = gym.make("PourWater-v0", obs_type=obs_type, image_size=40)
    evaluation = evaluate(SAC(policy, env, buffer_size=10), "PourWater-v0", n_episodes=1)
    assert evaluation.variations == [800] and evaluation.lengths == [100]
    assert 0.0 <= evaluation.normalized_performance[0] <= 1.0


def test_stacked_frames_and_normalised_observations_are_restored(tmp_path):
    env = VecFrameStack(VecNormalize(make_vec_env("Pendulum-v1")), 3)
    model = PPO("MlpPolicy", env)
    env.venv.obs_rms.mean[:] = 5.0
    (tmp_path / "Pendulum-v1").mkdir()
    env.venv.save(str(tmp_path / "Pendulum-v1" / "vecnormalize.pkl"))
    model.save(tmp_path / "best_model.zip")
    with pytest.warns(UserNote, match="Pendulum-v1 is made without wrappers"):
        environment = trained_in(tmp_path, "Pendulum-v1")
    plain = evaluate(model, "Pendulum-v1", n_episodes=1)
    normalised = evaluate(model, "Pendulum-v1", n_episodes=1, **environment)
    assert plain.returns != normalised.returns
    nothing = dict.fromkeys(("env_kwargs", "vec_normalize", "env_wrapper", "vec_env_wrapper"))
    with pytest.warns(UserNote, match="does not tell how its environment was wrapped: PourWater-v0 is made without"):
        assert trained_in(tmp_path, "PourWater-v0") == nothing


def test_a_run_is_evaluated_in_the_environment_that_it_was_trained_in_but_on_whole_episodes(tmp_path):
    model = SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, seed=0)
    model.save(tmp_path / "best_model.zip")
    (tmp_path / "Pendulum-v1").mkdir()
    (tmp_path / "Pendulum-v1" / "config.yml").write_text("env_kwargs: {g: 1.0, max_episode_steps: 7}\n")
    environment = trained_in(tmp_path, "Pendulum-v1")
    assert environment["env_kwargs"] == {"g": 1.0} and environment["env_wrapper"] is None
    light = evaluate(model, "Pendulum-v1", n_episodes=1, **environment)
    assert light.lengths == [200]
    assert light.returns != evaluate(model, "Pendulum-v1", n_episodes=1).returns


def test_a_run_is_evaluated_inside_the_wrappers_that_it_was_trained_in(tmp_path):
    clipped = "gymnasium.wrappers.ClipReward: {min_reward: -2000000.0, max_reward: -1000000.0}"
    wrappers = f"env_wrapper:\n- sb3_contrib.common.wrappers.TimeFeatureWrapper\n- {clipped}\n"
    (tmp_path / "FallingBall-v0").mkdir()
    (tmp_path / "FallingBall-v0" / "config.yml").write_text(wrappers)
    model = SAC("MlpPolicy", TimeFeatureWrapper(gym.make("FallingBall-v0", obs_type="state")), buffer_size=10, seed=0)
    model.save(tmp_path / "best_model.zip")
    environment = trained_in(tmp_path, "FallingBall-v0")
    evaluation = evaluate(model, "FallingBall-v0", n_episodes=1, **environment)
    assert evaluation.returns[0] > -1e4  # the environment's own rewards, as in training
    recorded = record_video(model, "FallingBall-v0", tmp_path / "video.gif", size=32, **environment)
    assert recorded.returns == evaluation.returns
    with pytest.raises(UserError, match="was not trained on FallingBall-v0"):
        evaluate(model, "FallingBall-v0", n_episodes=1)
    (tmp_path / "FallingBall-v0" / "config.yml").write_text("env_wrapper: no_such_package.Wrapper\n")
    with pytest.raises(UserError, match="cannot import the wrapper no_such_package"):
        trained_in(tmp_path, "FallingBall-v0")


def test_expert_is_the_ceiling_and_random_the_floor():
    expert = evaluate(ExpertModel("PourWater-v0"), "PourWater-v0", n_episodes=1)
    random = evaluate(RandomModel("PourWater-v0"), "PourWater-v0", n_episodes=1)
    assert expert.score > 0.7 > 0.3 > random.score
    assert expert.successes == [1.0]


@pytest.fixture
def dots(monkeypatch):
    """Ids of environments with images, channels last, alone and beside a vector."""
    ids = []
    for obs_type in ("pixels", "dict"):
        gym.register(f"Dots-{obs_type}-v0", DotEnv, kwargs={"size": 20, "obs_type": obs_type})
        ids.append(f"Dots-{obs_type}-v0")
    yield ids
    for name in ids:
        gym.registry.pop(name)


@pytest.mark.parametrize("policy", [RandomModel, IdleModel])
def test_reference_policies_play_environments_with_images(policy, dots):
    for name in dots:
        assert evaluate(policy(name), name, 1).lengths == [20]


def test_doing_nothing_in_a_range_without_an_end_is_0():
    class Unbounded(DotEnv):
        def __init__(self):
            super().__init__(size=20, obs_type="state")
            self.action_space = spaces.Box(np.array([-np.inf, 1.0, -1.0]), np.array([np.inf, np.inf, 3.0]), dtype=np.float64)

    gym.register("Unbounded-v0", Unbounded)
    try:
        assert IdleModel("Unbounded-v0").predict(np.zeros((1, 2)))[0].tolist() == [[0.0, 1.0, 1.0]]
    finally:
        gym.registry.pop("Unbounded-v0")


@pytest.mark.parametrize("frame", ["raises", None, np.zeros((8, 8, 3))])
def test_an_environment_that_renders_no_images_is_named(frame, tmp_path):
    class Blind(DotEnv):
        metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

        def __init__(self, render_mode=None):
            super().__init__(size=20, obs_type="state")
            self.render_mode = render_mode

        def render(self):
            if isinstance(frame, str):
                raise NotImplementedError
            return frame

    gym.register("Blind-v0", Blind)
    try:
        with pytest.raises(UserError, match="Blind-v0 renders no images"):
            record_video(RandomModel("Blind-v0"), "Blind-v0", tmp_path / "video.gif")
    finally:
        gym.registry.pop("Blind-v0")


def test_models_without_an_objective_are_loaded_by_their_class(tmp_path):
    for cls in (VisualSAC, VisualTQC):
        model = cls("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs=dict(net_arch=[8]))
        model.save(tmp_path / "model.zip")
        for load in (load_model, load_safe):
            loaded = load(tmp_path / "model.zip")
            assert all(map(th.equal, loaded.policy.state_dict().values(), model.policy.state_dict().values()))
        assert type(loaded) is cls


def test_damaged_statistics_are_one_line(tmp_path, pendulum_model):
    (tmp_path / "statistics.pkl").write_bytes(b"no pickle")
    with pytest.raises(UserError, match="cannot read the statistics of observations"):
        evaluate(pendulum_model, "Pendulum-v1", 1, vec_normalize=str(tmp_path / "statistics.pkl"))


def test_models_that_have_diverged_and_actions_that_are_not_finite_are_refused():
    model = SAC("MlpPolicy", "Pendulum-v1", buffer_size=10)
    with th.no_grad():
        model.actor.mu.bias.fill_(float("nan"))
    with pytest.raises(UserError, match="diverged"):
        evaluate(model, "Pendulum-v1", n_episodes=1)
    env = FixedEpisodes(short_pendulum())
    env.reset()
    with pytest.raises(UserError, match="not finite"):
        env.step(np.array([np.inf]))


def test_a_model_of_another_environment_is_refused(pendulum_model):
    with pytest.raises(UserError, match=r"not trained on PourWater-v0"):
        evaluate(pendulum_model, "PourWater-v0", n_episodes=1)
    with pytest.raises(UserError, match="at least 1 episode"):
        evaluate(pendulum_model, "Pendulum-v1", n_episodes=0)


def test_json_holds_no_nan_and_score_falls_back_to_the_return():
    nan = float("nan")
    evaluation = Evaluation([nan, nan], [-1.0, -3.0], [nan, nan], [7, 7], [None, None])
    assert evaluation.score == -2.0
    text = json.dumps(evaluation.as_dict(), allow_nan=False)
    assert json.loads(text)["mean"] == {"normalized_performance": None, "return": -2.0, "success": None, "length": 7.0}
    assert str(evaluation) == "return -2.000 ± 1.000, length 7 (2 episodes)"
    assert Evaluation([0.9, nan], [-3.0, -5.0], [nan, nan], [7, 7], [None, None]).score == 0.9, "not the returns"


def test_algorithm_is_found_from_the_file(pendulum_zip, tmp_path, pendulum_model):
    loaded = load_model(pendulum_zip)
    assert type(loaded) is SAC and loaded.replay_buffer.buffer_size == 1
    observation = np.array([0.1, 0.2, 0.3], dtype=np.float32)
    assert np.array_equal(
        loaded.predict(observation, deterministic=True)[0], pendulum_model.predict(observation, deterministic=True)[0]
    )
    for cls in (A2C, PPO, TD3, TQC):
        cls("MlpPolicy", "Pendulum-v1").save(tmp_path / "model.zip")
        assert type(load_model(tmp_path / "model.zip")) is cls


def test_a_model_with_n_step_returns_is_loaded_without_a_warning(tmp_path, recwarn):
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, n_steps=3).save(tmp_path / "model.zip")
    assert load_model(tmp_path / "model.zip").n_steps == 3
    assert not [warning for warning in recwarn if "n_steps" in str(warning.message)]


def test_files_that_are_no_models_are_refused(pendulum_zip, tmp_path):
    whole = pendulum_zip.read_bytes()
    (tmp_path / "text.zip").write_text("no zip")
    (tmp_path / "cut.zip").write_bytes(whole[: len(whole) // 2])
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF
    (tmp_path / "flipped.zip").write_bytes(bytes(flipped))
    with zipfile.ZipFile(tmp_path / "foreign.zip", "w") as archive:
        archive.writestr("a.txt", "hello")
    with zipfile.ZipFile(tmp_path / "list.zip", "w") as archive:
        archive.writestr("data", "[]")
    with zipfile.ZipFile(tmp_path / "deflated.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", json.dumps(list(range(5000))))
    deflated = bytearray((tmp_path / "deflated.zip").read_bytes())
    deflated[40:60] = b"\xff" * 20  # what zlib itself refuses
    (tmp_path / "deflated.zip").write_bytes(bytes(deflated))
    for name, message in {
        "missing": "there is no model",
        "text": "corrupt",
        "cut": "corrupt",
        "flipped": "corrupt",
        "foreign": "not saved by Stable-Baselines3",
        "list": "not saved by Stable-Baselines3",
        "deflated": "corrupt",
    }.items():
        with pytest.raises(UserError, match=message) as error:
            load_model(tmp_path / f"{name}.zip")
        assert "\n" not in str(error.value)


def test_a_named_algorithm_must_be_known_and_must_be_the_models(pendulum_zip):
    with pytest.raises(UserError, match=r"unknown algorithm 'sacc'; did you mean sac\?"):
        load_model(pendulum_zip, algo="sacc")
    for other in ("ppo", "tqc", "crossq", "sac_drq"):  # SB3's TQC loads and plays it
        with pytest.raises(UserError, match=f"not a model of {other}"):
            load_model(pendulum_zip, algo=other)


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_a_video_has_a_frame_for_the_reset_and_each_step(suffix, tmp_path):
    path = tmp_path / f"video.{suffix}"
    evaluation = record_video(ExpertModel("PourWater-v0"), "PourWater-v0", path, size=64)
    frames = imageio.mimread(path, memtest=False)
    # A GIF joins frames that are alike, such as those of water at rest.
    assert 20 < len(frames) <= 101 and frames[0].shape[:2] == (64, 64)
    assert evaluation.lengths == [100]
    assert not np.array_equal(frames[0][..., :3], frames[-1][..., :3])


def test_a_video_shows_the_steps_that_a_wrapper_makes_of_one(tmp_path):
    path = tmp_path / "video.mp4"
    recorded = record_video(
        ExpertModel("PourWater-v0"), "PourWater-v0", path, size=64, env_wrapper=lambda env: ActionRepeat(env, repeat=10)
    )
    assert len(imageio.mimread(path, memtest=False)) == 101 and recorded.lengths == [100]
    assert imageio.get_reader(path).get_meta_data()["fps"] == gym.make("PourWater-v0").metadata["render_fps"]


def test_videos_of_odd_size_and_unknown_format(tmp_path):
    frames = [np.full((31, 33, 3), value, dtype=np.uint8) for value in (0, 250)]
    write_video(tmp_path / "odd.mp4", frames, fps=5)
    assert len(imageio.mimread(tmp_path / "odd.mp4")) == 2
    with pytest.raises(UserError, match=r"must end in \.gif or \.mp4"):
        write_video(tmp_path / "video.avi", frames, fps=5)
    assert [path.name for path in tmp_path.iterdir()] == ["odd.mp4"]


def test_spaces_without_a_shape_are_evaluated():
    env = gym.make("CartPole-v1")
    assert isinstance(env.action_space, spaces.Discrete)
    assert evaluate(PPO("MlpPolicy", env), "CartPole-v1", n_episodes=2).lengths[0] > 0
