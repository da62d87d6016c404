"""Recording, and datasets that others have written."""

import functools
import sys
import types
from contextlib import nullcontext
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import SAC
from toy_envs import DotEnv

import softbody_envs  # noqa: F401  (registers its ids)
from sb3_por import SACPOR, VisualSAC
from sb3_por.__main__ import main
from sb3_por.common.errors import UserError, UserNote
from sb3_por.demonstrations.dataset import Demonstrations, RecordedEpisode, write_demonstrations
from sb3_por.runs.environment import TrainingEnvironment
from sb3_por.training.record import Recorder, record, settings_environment
from softbody_envs.experts.pour_water import PourWaterExpert
from softbody_envs.variations import SPLITS
from softbody_envs.wrappers import ActionRepeat, ProgressReward

minari = pytest.importorskip("minari", reason="pip install 'sb3-por[demos]'")


@pytest.fixture(scope="module")
def poured(tmp_path_factory):
    """Two episodes of the expert as the settings make them, and what was printed."""
    path = tmp_path_factory.mktemp("recorded") / "demos"
    return path, record("expert", "PourWater-v0", path, 2)


def test_the_expert_is_recorded_in_the_environment_of_the_settings(poured):
    path, evaluation = poured
    assert np.mean(evaluation.normalized_performance) > 0.8
    assert all(variation in SPLITS["train"] for variation in evaluation.variations) and len(set(evaluation.variations)) == 2
    dataset = minari.MinariDataset(path)
    assert dataset.total_episodes == 2 and dataset.observation_space.shape == (64, 64, 3)
    env = dataset.recover_environment()
    assert isinstance(env, ProgressReward) and isinstance(env.env, ActionRepeat)
    assert (env.env.repeat, env.env.scale) == (5, 0.7)
    for episode, variation, score in zip(dataset, evaluation.variations, evaluation.normalized_performance, strict=True):
        assert len(episode.actions) == 20 and episode.truncations.tolist() == [False] * 19 + [True]
        # The whole progress, times 10, is the score
        assert not episode.terminations.any() and np.sum(episode.rewards) == pytest.approx(10 * score, abs=1e-5)
        observation, _ = env.reset(options={"variation": variation})
        for t, action in enumerate(episode.actions):
            assert np.array_equal(episode.observations[t], observation), "stored without loss"
            observation = env.step(action)[0]
        assert np.array_equal(episode.observations[-1], observation)
    env.close()


def test_a_recording_is_learned_from_in_the_same_environment(poured):
    env = ProgressReward(ActionRepeat(gym.make("PourWater-v0", image_size=64), 5, 0.7))
    model = SACPOR("CnnPolicy", env, buffer_size=50, demos=str(poured[0]), learning_starts=3, batch_size=4).learn(4)
    assert model.demo_buffer.size() == 40 and model.demo_buffer.timeouts.sum() == 2


def test_record_from_the_shell(tmp_path, capsys):
    path = tmp_path / "new" / "demos"
    flags = ["--model", "expert", "--env", "StraightenRope-v0", "-n", "1", "-o", str(path)]
    assert main(["record", *flags, "--algo", "sac_drq", "--env-kwargs", "obs_type:dict", "image_size:32"]) == 0
    line, where = capsys.readouterr().out.splitlines()
    assert "success 100%" in line and "length 38 (1 episode)" in line and where == str(path)
    (episode,) = Demonstrations(path).episodes()
    assert episode.observations["image"].shape == (39, 32, 32, 3) and episode.observations["state"].shape[0] == 39
    assert main(["record", *flags]) == 2
    assert "exists; give a new folder" in capsys.readouterr().err


def test_a_relative_folder_will_do(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    episode = RecordedEpisode(np.zeros((3, 2)), np.zeros((2, 1)), np.ones(2), terminated=False)
    write_demonstrations("demos", [episode], gym.spaces.Box(-1, 1, (2,)), gym.spaces.Box(-1, 1, (1,)))
    assert [len(one.rewards) for one in Demonstrations("demos").episodes()] == [2]


def test_a_trained_model_is_recorded_in_its_environment(tmp_path, capsys):
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, seed=0).save(tmp_path / "model.zip")
    flags = ["--model", str(tmp_path / "model.zip"), "--env", "Pendulum-v1", "-n", "2", "-o", str(tmp_path / "demos")]
    assert main(["record", *flags]) == 0
    first, second = Demonstrations(tmp_path / "demos").episodes()
    assert first.observations.shape == (201, 3) and not np.array_equal(first.observations, second.observations)
    model = SAC.load(tmp_path / "model.zip")
    predicted = model.predict(first.observations[:-1], deterministic=True)[0]
    assert np.allclose(predicted, first.actions, atol=1e-6)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--model", "expert", "--env", "Pendulum-v1"], "no expert for 'Pendulum-v1'"),
        (["--model", "expert", "--env", "FoldClot-v0"], "did you mean FoldCloth-v0?"),
        (["--model", "nothing.zip", "--env", "Pendulum-v1"], "there is no model nothing.zip"),
        (["--model", "expert", "--env", "PourWater-v0", "-n", "0"], "at least 1 episode"),
        (["--model", "expert", "--env", "PourWater-v0", "--disturbed", "1"], "the probability of a disturbance must be"),
        (["--model", "expert", "--env", "PourWater-v0", "--disturbed", "nan"], "the probability of a disturbance must be"),
        (["--model", "expert", "--env", "PourWater-v0", "--env-kwargs", "image_size:-1"], "cannot make PourWater-v0"),
        (["--model", "expert", "--env", "PourWater-v0", "-conf", "none.yml"], "cannot read none.yml"),
        (["--model", "expert", "--env", "PourWater-v0", "--ranker", "none.npz"], "there is no ranker none.npz"),
        (["--model", "RUN", "--env", "Pendulum-v1", "--env-kwargs", "g:9.0"], "give --algo, too"),
    ],
)
def test_what_cannot_be_recorded_is_said_in_one_line(arguments, message, tmp_path, capsys):
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10).save(tmp_path / "model.zip")
    arguments = [str(tmp_path / "model.zip") if argument == "RUN" else argument for argument in arguments]
    assert main(["record", *arguments, "-o", str(tmp_path / "demos")]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (tmp_path / "demos").exists()


class Line(gym.Env):
    """A step up, a step down, and the end."""

    observation_space, action_space = spaces.Box(-9, 9, (1,)), spaces.Box(-1, 1, (1,))

    def __init__(self, name=str):
        self.name = name

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 2
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.left -= 1
        return np.ones(1, np.float32), 0.0, self.left == 0, False, {}


@pytest.mark.parametrize(
    "entry_point, kwargs, known",
    [(Line, {}, True), (Line, {"name": len}, False), (functools.partial(Line), {}, False)],
    ids=["class", "function as argument", "partial"],
)
def test_an_environment_registered_by_its_class_is_recorded(entry_point, kwargs, known, tmp_path):
    """Gymnasium cannot write such a specification; by then all episodes have been played."""
    gym.register("Line-v0", entry_point, kwargs=kwargs, max_episode_steps=5)
    try:
        model = SAC("MlpPolicy", gym.make("Line-v0"), buffer_size=10, seed=0)
        with nullcontext() if known else pytest.warns(UserNote, match="do not tell how to make Line-v0"):
            record(model, "Line-v0", tmp_path / "demos", 2, made_of=TrainingEnvironment("Line-v0"))
        demonstrations = Demonstrations(tmp_path / "demos")
        assert len(demonstrations) == 2 and (demonstrations.spec is not None) == known
        if known:
            assert isinstance(gym.make(demonstrations.spec).unwrapped, Line)
    finally:
        del gym.registry["Line-v0"]


def tree_map(function, tree, *others):
    """``jax.tree_util.tree_map`` for dicts and leaves, which is all that Minari's collector needs of it."""
    if isinstance(tree, dict):
        return {key: tree_map(function, value, *(other[key] for other in others)) for key, value in tree.items()}
    return function(tree, *others)


@pytest.fixture
def collected(tmp_path, monkeypatch):
    """A dataset that Minari's own collector has written, in Minari's own folder."""
    tree_util = types.ModuleType("jax.tree_util")
    tree_util.tree_map = tree_map
    monkeypatch.setitem(sys.modules, "jax", types.ModuleType("jax"))
    monkeypatch.setitem(sys.modules, "jax.tree_util", tree_util)
    sys.modules["jax"].tree_util = tree_util
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    env = minari.DataCollector(DotEnv(size=32, horizon=7))
    env.action_space.seed(0)
    for seed in range(3):
        env.reset(seed=seed)
        for _ in range(7 if seed < 2 else 4):  # the last one is cut off
            env.step(env.action_space.sample())
    env.create_dataset("dots/random-v0", author="a", author_email="b", code_permalink="c", algorithm_name="d", description="e")
    return tmp_path / "dots" / "random-v0"


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_dataset_of_minaris_collector_is_learned_from(collected):
    model = VisualSAC("CnnPolicy", DotEnv(size=32, horizon=7), buffer_size=50, learning_starts=3, batch_size=4)
    for path in (collected, collected / "data"):
        model.load_demos(path)
        assert model.demo_buffer.size() == 18
        assert np.flatnonzero(model.demo_buffer.timeouts[:, 0]).tolist() == [6, 13, 17]
    env = DotEnv(size=32, horizon=7)
    stored = model.demo_buffer.observations[0, 0].transpose(1, 2, 0).astype(int)
    assert np.abs(stored - env.reset(seed=0)[0]).mean() < 10, "the collector compresses images with loss"
    model.learn(5)


def change(path, name, value=None):
    """Replace an array of the first episode, or remove it."""
    import h5py

    with h5py.File(path / "main_data.hdf5", "a") as file:
        del file["episode_0"][name]
        if value is not None:
            file["episode_0"][name] = value


@pytest.mark.parametrize(
    "damage, message",
    [
        (lambda path: change(path, "actions"), "cannot read episode 0"),
        (lambda path: change(path, "actions", np.zeros((3, 1))), r"actions of shape \(3, 1\)"),
        (lambda path: change(path, "rewards", np.full(4, np.nan)), "not finite"),
        (lambda path: change(path, "observations", np.array(["text"] * 5, dtype=object)), "neither an array of numbers nor"),
        (lambda path: change(path, "observations", np.zeros((4, 3))), "4 steps need 5 observations"),
        (lambda path: (path / "main_data.hdf5").unlink(), "cannot read the Minari dataset"),
        (lambda path: (path / "main_data.hdf5").write_bytes(b"no HDF5"), "cannot read episode 0"),
        (lambda path: (path / "metadata.json").write_text("{"), "cannot read the Minari dataset"),
        (lambda path: (path / "metadata.json").unlink(), "no metadata.json of a Minari dataset"),
    ],
)
def test_a_damaged_dataset_is_refused(damage, message, tmp_path):
    env, path = gym.make("Pendulum-v1"), tmp_path / "demos"
    episode = RecordedEpisode(np.zeros((5, 3), np.float32), np.zeros((4, 1), np.float32), np.zeros(4), False)
    write_demonstrations(path, [episode], env.observation_space, env.action_space)
    damage(path)
    with pytest.raises(UserError, match=message):
        VisualSAC("MlpPolicy", env, buffer_size=10).load_demos(path)


def test_a_failed_recording_leaves_nothing(tmp_path):
    def episodes():
        yield RecordedEpisode(np.zeros((2, 3), np.float32), np.zeros((1, 1), np.float32), np.zeros(1), False)
        raise RuntimeError("killed here")

    env = gym.make("Pendulum-v1")
    with pytest.raises(RuntimeError, match="killed here"):
        write_demonstrations(tmp_path / "demos", episodes(), env.observation_space, env.action_space)
    assert not list(Path(tmp_path).iterdir())
    write_demonstrations(tmp_path / "none", [], env.observation_space, env.action_space)
    with pytest.raises(UserError, match="has no episodes"):
        Demonstrations(tmp_path / "none")


def test_without_minari_there_is_a_line_on_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(UserError, match=r"pip install 'sb3-por\[demos\]'"):
        Demonstrations(tmp_path)


def test_an_expert_with_several_plans_tries_a_scene_until_it_succeeds(tmp_path, monkeypatch):
    class Unsteady:
        """Pours nothing at the first attempt, well at the second, and has a third."""

        attempts = 3

        def __init__(self, pace):
            self.inner = PourWaterExpert(pace)
            self.plans = []

        def reset(self):
            self.plans.append(1)

        def retry(self):
            self.plans.append(self.plans[-1] + 1)

        def act(self, state):
            return self.inner.act(state) * (self.plans[-1] == 2)

    made = []
    monkeypatch.setattr("sb3_por.training.record.make_expert", lambda _, pace: made.append(Unsteady(pace)) or made[-1])
    made_of = TrainingEnvironment(
        "PourWater-v0", {"obs_type": "state"}, {"softbody_envs.wrappers.ActionRepeat": {"repeat": 10}}
    )
    evaluation = record("expert", "PourWater-v0", tmp_path / "demos", 2, made_of=made_of)
    assert made[0].plans == [plan for success in evaluation.successes for plan in ([1, 2] if success else [1, 2, 3])]
    assert 1.0 in evaluation.successes and min(evaluation.normalized_performance) > 0.5
    episodes = list(Demonstrations(tmp_path / "demos").episodes())
    assert len(episodes) == 2 and all((episode.actions != 0).any() for episode in episodes)


def test_observations_are_copied():
    """Gymnasium allows an environment to return the same array at every step."""

    class Counting(gym.Env):
        observation_space, action_space = gym.spaces.Box(0, 9, (1,)), gym.spaces.Box(-1, 1, (1,))

        def reset(self, *, seed=None, options=None):
            self.count = np.zeros(1, np.float32)
            return self.count, {}

        def step(self, action):
            self.count += 1
            return self.count, 0.0, self.count[0] == 4, False, {}

    recorder = Recorder(Counting())
    recorder.reset()
    while not recorder.episodes:
        recorder.step(np.zeros(1))
    assert recorder.episodes[0].observations[:, 0].tolist() == [0, 1, 2, 3, 4]


class Integrator(gym.Env):
    """Sums actions for 200 steps; the reward is the number of steps so far."""

    observation_space, action_space = spaces.Box(-500, 500, (1,), np.float64), spaces.Box(-2, 2, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.moves = []
        return np.zeros(1), {}

    def step(self, action):
        self.moves.append(float(action[0]))
        return np.array([sum(self.moves)]), float(len(self.moves)), False, len(self.moves) == 200, {}


def played_with_disturbances(seed):
    """The episodes, the moves of the environment, and the sum of the rewards of one who always plays 1."""
    recorder = Recorder(Integrator(), disturbed=0.1)
    recorder.reset(seed=seed)
    done, total = False, 0.0
    while not done:
        _, reward, _, done, _ = recorder.step(np.ones(1))
        total += reward
    return recorder.episodes, recorder.unwrapped.moves, total


def test_disturbances_are_random_actions_that_are_not_recorded():
    episodes, moves, total = played_with_disturbances(seed=3)
    assert len(episodes) > 5 and total == 200 * 201 / 2
    places = np.concatenate([[0.0], np.cumsum(moves)])
    at, gaps = 0, []
    for episode in episodes:
        begin = int(np.flatnonzero(np.isclose(places[at:], episode.observations[0, 0]))[0]) + at
        gaps.append(moves[at:begin])
        at = begin + len(episode.rewards)
        assert (episode.actions == 1.0).all() and not episode.terminated
        np.testing.assert_array_equal(episode.observations[:, 0], [sum(moves[:i]) for i in range(begin, at + 1)])
        np.testing.assert_array_equal(episode.rewards, np.arange(begin, at) + 1.0)
    assert gaps[0] == [] and len({gap[0] for gap in gaps[1:]}) == len(episodes) - 1
    assert all(len(set(gap)) == 1 and 3 <= len(gap) <= 8 for gap in gaps[1:])


def test_disturbances_follow_from_the_seed():
    first, again, other = (played_with_disturbances(seed)[1] for seed in (3, 3, 4))
    assert first == again and first != other


def test_a_disturbed_expert_makes_good_what_happened(tmp_path, capsys):
    flags = ["--model", "expert", "--env", "StraightenRope-v0", "--env-kwargs", "obs_type:state", "-n", "2"]
    assert main(["record", *flags, "--disturbed", "0.1", "-o", str(tmp_path / "demos")]) == 0
    assert "(2 episodes)" in capsys.readouterr().out
    episodes = list(Demonstrations(tmp_path / "demos").episodes())
    assert len(episodes) > 4 and sum(len(one.rewards) for one in episodes) < 2 * 38


def test_changes_are_those_of_training():
    kwargs = {"env_kwargs": {"renderer": "tiny"}}
    env_kwargs = settings_environment("sac_por", "PourWater-v0", changes=kwargs, env_kwargs={"split": "all"}).env_kwargs
    assert env_kwargs["obs_type"] == "pixels" and env_kwargs["renderer"] == "tiny" and env_kwargs["split"] == "all"
    with pytest.raises(UserError, match="unknown setting of sac_por 'frame_stak'; did you mean frame_stack"):
        settings_environment("sac_por", "PourWater-v0", changes={"frame_stak": 3})


def test_demonstrations_one_level_below_are_named(poured):
    path, _ = poured
    with pytest.raises(UserError, match=f"did you mean {path}"):
        Demonstrations(path.parent)
