"""Rankers: what they learn from videos, their files, their progress as a reward, and the command that makes them."""

import json

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest
from stable_baselines3 import SAC
from toy_envs import DotEnv

from sb3_por import VisualSAC
from sb3_por.__main__ import main
from sb3_por.analysis.ranking import RandomPlay, measure, play_at_random, rank
from sb3_por.common.errors import UserError
from sb3_por.demonstrations.dataset import Demonstrations, RecordedEpisode, write_demonstrations
from sb3_por.evaluation import evaluate
from sb3_por.evaluation.episodes import evaluation_episodes
from sb3_por.evaluation.video import write_video
from sb3_por.ranking import RankedProgress, Ranker, read_videos, train_ranker
from sb3_por.runs.environment import rankers, with_ranker, without_ranker
from sb3_por.training.zoo import main as train

SIZE = 36
QUICK = dict(updates=300, batch_size=16, learning_rate=1e-3, image_size=SIZE)


class Walk(DotEnv):
    """The dot is to be moved from the left side to the right; how far it is, is the performance."""

    def __init__(self, ends_right=False, **kwargs):
        super().__init__(size=SIZE, **kwargs)
        self.ends_right = ends_right

    def reset(self, **kwargs):
        super().reset(**kwargs)
        self.x = 0.1 * self.x
        return self._observe(), self._info()

    def step(self, action):
        observation, _, _, truncated, _ = super().step(action)
        return observation, 0.5, self.ends_right and self.x == 1.0, truncated, self._info()

    def _info(self):
        return {"normalized_performance": self.x, "monotone": round(self.x, 1)}


def videos(n, seed=0, length=16):
    """The dot moves to the right, in one of three rows, and with another speed in each video."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(n):
        frames = np.zeros((length, SIZE, SIZE, 3), np.uint8)
        row = 10 * rng.integers(0, 3)
        for frame, share in zip(frames, np.linspace(0, 1, length) ** rng.uniform(0.7, 1.4), strict=True):
            column = round(share * (SIZE - 6))
            frame[row : row + 6, column : column + 6] = (255, 200, 100)
        made.append(frames)
    return made


@pytest.fixture(scope="module")
def ranker():
    return train_ranker(videos(8), **QUICK)


@pytest.fixture(scope="module")
def file(ranker, tmp_path_factory):
    path = tmp_path_factory.mktemp("ranker") / "walk.npz"
    ranker.save(path)
    return str(path)


@pytest.mark.parametrize("target", ["order", "distance"])
def test_frames_of_other_videos_are_ranked(target):
    ranker = train_ranker(videos(8), target=target, **QUICK)
    new = videos(4, seed=1)
    report = measure(ranker, new, RandomPlay([], {}))
    assert report.any_frames > 0.93 and report.next_frame > 0.7
    backwards = measure(ranker, [video[::-1] for video in new], RandomPlay([], {}))
    assert backwards.any_frames == pytest.approx(1 - report.any_frames)
    if target == "distance":
        assert np.corrcoef(ranker.potential(new[0]), np.linspace(0, 1, 16))[0, 1] > 0.95


def test_the_units_are_those_of_a_video(ranker):
    ends = np.array([ranker.potential(video[[0, -1]]) for video in videos(8)])
    assert ends.mean(axis=0) == pytest.approx([0.0, 1.0], abs=1e-5)


def test_negatives_do_not_rank_high():
    """Frames like the videos' ends, but for a colour that only other behaviour has."""
    negatives = [video[8:] // 2 for video in videos(8, seed=2)]
    with_negatives, without = (train_ranker(videos(8), some, **QUICK) for some in (negatives, ()))
    new = np.concatenate([video[12:] // 2 for video in videos(4, seed=3)])
    assert with_negatives.potential(new).mean() < 0.3 < 0.5 < without.potential(new).mean()


def test_the_same_seed_makes_the_same_ranker_and_touches_no_generator():
    np.random.seed(0)
    first, second, other = (train_ranker(videos(2), **QUICK | {"updates": 60}, seed=seed) for seed in (3, 3, 4))
    frames = videos(1)[0]
    assert np.array_equal(first.potential(frames), second.potential(frames))
    assert not np.array_equal(first.potential(frames), other.potential(frames))
    assert np.random.rand() == pytest.approx(0.5488135039273248)


def test_a_file_keeps_everything_and_holds_no_pickle(ranker, file, monkeypatch):
    monkeypatch.setattr("pickle.load", None)
    monkeypatch.setattr("pickle.loads", None)
    loaded = Ranker.load(file)
    assert loaded.facts == ranker.facts and loaded.facts["n_videos"] == 8
    assert np.array_equal(loaded.potential(videos(1)[0]), ranker.potential(videos(1)[0]))


def test_images_of_any_size_and_number_of_channels_are_ranked(ranker):
    video = videos(1)[0]
    large = video.repeat(3, axis=1).repeat(2, axis=2)
    assert ranker.potential(large) == pytest.approx(ranker.potential(video), abs=1e-6)
    stacked = np.concatenate([np.zeros_like(video), video], axis=3)
    assert np.array_equal(ranker.potential(stacked), ranker.potential(video))
    assert ranker.potential(video[..., :1]).shape == (16,)


def damaged(path, ranker, **changes):
    arrays = {name: tensor.numpy() for name, tensor in ranker.state_dict().items()}
    np.savez(path, **{"facts": np.array(json.dumps({"image_size": SIZE})), **arrays, **changes})


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"facts": np.array({"image_size": SIZE}, dtype=object)}, "allow_pickle"),
        ({"start": np.array([object()])}, "allow_pickle"),
        ({"facts": np.array(json.dumps({"image_size": 10**6}))}, "32 to 256 pixels"),
        ({"facts": np.array(json.dumps({"image_size": 64}))}, "size mismatch"),
        ({"facts": np.array("{}")}, "image_size"),
        ({"facts": np.array("[1]")}, "is not a ranker"),
        ({"start": np.zeros(2**24 + 1)}, "more than 64 MiB"),
    ],
)
def test_what_is_no_ranker_is_refused(changes, message, ranker, tmp_path):
    damaged(tmp_path / "ranker.npz", ranker, **changes)
    with pytest.raises(UserError, match=message):
        Ranker.load(tmp_path / "ranker.npz")


def test_other_files_are_refused(tmp_path):
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(UserError, match="is not a ranker"):
        Ranker.load(tmp_path / "text.npz")
    with pytest.raises(UserError, match="there is no ranker"):
        Ranker.load(tmp_path / "none.npz")


def play(env, actions):
    env.reset(seed=0)
    return [env.step(np.array([action], np.float32)) for action in actions]


@pytest.mark.parametrize("obs_type", ["pixels", "dict"])
def test_progress_adds_up_to_the_change_of_the_potential(obs_type, file):
    env = RankedProgress(Walk(obs_type=obs_type), file, scale=5.0)
    before = env.reset(seed=0)[1]["potential"]
    steps = play(env, [1.0] * 6)
    gained = sum(reward for _, reward, *_ in steps) - 6 * 0.5
    assert gained == pytest.approx(5.0 * (steps[-1][4]["potential"] - before), abs=1e-5) and gained > 1.0
    back = play(env, [1.0] * 6 + [-1.0] * 6)
    assert sum(reward for _, reward, *_ in back) - 12 * 0.5 < 0.3 * gained, "the way back costs what the way there earned"


@pytest.mark.parametrize("terminates", [False, True])
def test_shaping_telescopes_with_the_discount(terminates, file):
    env = RankedProgress(Walk(ends_right=terminates, horizon=12), file, scale=2.0, gamma=0.9)
    before = env.reset(seed=0)[1]["potential"]
    steps = play(env, [1.0] * 12)[: 10 if terminates else 12]
    assert steps[-1][2] == terminates
    shaped = sum(0.9**t * (reward - 0.5) for t, (_, reward, *_) in enumerate(steps))
    last = 0.0 if terminates else 0.9 ** len(steps) * steps[-1][4]["potential"]
    assert shaped == pytest.approx(2.0 * (last - before), abs=1e-5)


def test_pictures_are_rendered_where_none_is_observed(file):
    class Rendered(Walk):
        render_mode = "rgb_array"

        def render(self):
            self.obs_type, kept = "pixels", self.obs_type
            image = self._observe()
            self.obs_type = kept
            return image

    seen, rendered = RankedProgress(Walk(), file), RankedProgress(Rendered(obs_type="state"), file)
    assert [step[1] for step in play(seen, [1.0] * 3)] == [step[1] for step in play(rendered, [1.0] * 3)]
    with pytest.raises(UserError, match="a ranker needs an image"):
        RankedProgress(Walk(obs_type="state"), file)


def test_the_picture_of_a_failed_simulation_is_not_ranked(file):
    class Fails(Walk):
        def step(self, action):
            observation, reward, _, _, info = super().step(action)
            return np.zeros_like(observation), reward, False, True, info | {"sim_error": "tore"}

    env = RankedProgress(Fails(), file)
    before = env.reset(seed=0)[1]["potential"]
    _, reward, _, _, info = env.step(np.array([1.0], np.float32))
    assert reward == 0.5 and info["potential"] == before
    played = play_at_random(Fails(), evaluation_episodes("FallingBall-v0", 2), image_size=SIZE)
    assert [len(video) for video in played.videos] == [1, 1]


@pytest.mark.parametrize("arguments", [dict(scale=0.0), dict(scale=float("nan")), dict(gamma=0.0), dict(gamma=1.1)])
def test_wrong_arguments_are_refused(arguments, file):
    with pytest.raises(TypeError, match=f"{next(iter(arguments))} must be float"):
        RankedProgress(Walk(), file, **dict.fromkeys(arguments, "x"))
    with pytest.raises(ValueError, match=next(iter(arguments))):
        RankedProgress(Walk(), file, **arguments)


def test_videos_are_read_from_a_folder(tmp_path):
    made = videos(1)[0]
    np.savez(tmp_path / "a.npz", frames=made)
    write_video(tmp_path / "b.gif", list(made), fps=10)
    write_video(tmp_path / "c.mp4", list(made.repeat(2, axis=1).repeat(2, axis=2)), fps=10)
    (tmp_path / "notes.txt").write_text("not a video")
    exact, gif, mp4 = read_videos(tmp_path, image_size=SIZE)
    assert np.array_equal(exact, made) and gif.shape == made.shape == mp4.shape
    for lossy in (gif, mp4):
        assert np.abs(lossy.astype(int) - made).mean() < 8


@pytest.mark.parametrize(
    "content, message",
    [
        ({}, "there are no videos in"),
        ({"a.mp4": b"no video"}, "cannot read the video .*a.mp4"),
        ({"a.npz": videos(1)[0].astype(float)}, "frames are uint8"),
        ({"a.npz": videos(1)[0][:1]}, "has 1 frame"),
    ],
)
def test_videos_that_cannot_be_read_are_named(content, message, tmp_path):
    for name, value in content.items():
        (tmp_path / name).write_bytes(value) if isinstance(value, bytes) else np.savez(tmp_path / name, frames=value)
    with pytest.raises(UserError, match=message):
        read_videos(tmp_path)


def test_the_reason_is_the_end_of_what_ffmpeg_says(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"no video")
    with pytest.raises(UserError, match=r"Invalid data|moov atom") as error:
        read_videos(tmp_path)
    assert len(str(error.value)) < 300 + len(str(tmp_path))


@pytest.mark.parametrize(
    "wrong, message",
    [
        (lambda video: video / 255.0, r"frames are uint8 of .* not float64"),
        (lambda video: video[..., 0], "frames are uint8 of"),
        (lambda video: video[:, :0], "frames are uint8 of"),
        (lambda video: video.transpose(0, 3, 1, 2), "the channels of frames come last"),
    ],
)
def test_what_are_no_frames_is_refused_everywhere(wrong, message, ranker, tmp_path):
    frames = wrong(videos(1)[0])
    np.savez(tmp_path / "a.npz", frames=frames)
    for use in (ranker.potential, lambda frames: train_ranker([frames]), lambda _: read_videos(tmp_path)):
        with pytest.raises(UserError, match=message):
            use(frames)


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
@pytest.mark.parametrize("still", [False, True])
def test_videos_that_end_as_they_begin_teach_nothing(seed, still):
    one = videos(1)[0]
    loop = one[:1].repeat(9, axis=0) if still else np.concatenate([one, one[::-1]])
    with pytest.raises(UserError, match=r"does not rise along the videos.* cut them where the task is done"):
        train_ranker([loop] * 3, **{**QUICK, "updates": 5}, seed=seed)


def test_an_npz_holds_frames_alone(tmp_path):
    np.savez(tmp_path / "a.npz", frames=videos(1)[0], actions=np.zeros(3))
    with pytest.raises(UserError, match=r"an \.npz holds one array, of frames; this one has frames, actions"):
        read_videos(tmp_path)


def test_videos_are_read_from_demonstrations(tmp_path):
    pytest.importorskip("minari", reason="pip install 'sb3-por[demos]'")
    env = Walk()
    made = videos(2)
    episodes = [RecordedEpisode(video, np.zeros((15, 1), np.float32), np.zeros(15), terminated=False) for video in made]
    write_demonstrations(tmp_path / "demos", episodes, env.observation_space, env.action_space)
    read = read_videos(tmp_path / "demos", image_size=SIZE)
    assert len(read) == 2 and all(np.array_equal(one, other) for one, other in zip(read, made, strict=True))
    states = DotEnv(obs_type="state")
    episode = RecordedEpisode(np.zeros((2, 2), np.float32), np.zeros((1, 1), np.float32), np.zeros(1), terminated=False)
    write_demonstrations(tmp_path / "states", [episode], states.observation_space, states.action_space)
    with pytest.raises(UserError, match="no single image"):
        read_videos(tmp_path / "states")


class Told(Ranker):
    """Knows what the test says."""

    def __init__(self, potential):
        super().__init__(SIZE)
        self.potential = potential


def test_the_report_tells_physics_from_time():
    played = play_at_random(Walk(), evaluation_episodes("", 6), SIZE)
    quantity = {video.tobytes(): values for video, values in zip(played.videos, played.quantities["monotone"], strict=True)}
    knows_all = measure(Told(lambda video: quantity[video.tobytes()]), [], played).agreement["monotone"]
    knows_time = measure(Told(lambda video: np.arange(len(video))), [], played).agreement["monotone"]
    assert knows_all.at_ends == pytest.approx(1) and knows_all.within == pytest.approx(1)
    assert knows_time.at_ends == 0 and knows_time.within == pytest.approx(knows_time.clock_within)
    assert set(played.quantities) == {"normalized_performance", "monotone"}


def test_rank_writes_a_ranker_and_its_picture(tmp_path):
    report = rank(videos(6), tmp_path / "new" / "walk.npz", Walk, "", n_random=3, updates=100, image_size=SIZE)
    assert report.any_frames > 0.8 and set(report.agreement) == {"normalized_performance", "monotone"}
    picture = imageio.imread(tmp_path / "new" / "walk.png")
    assert picture.shape[0] > 300 and picture.std() > 20
    facts = Ranker.load(tmp_path / "new" / "walk.npz").facts
    assert (facts["n_videos"], facts["n_held_out"], facts["n_negatives"]) == (5, 1, 3 * 21)
    assert facts["report"]["any_frames"] == report.any_frames


@pytest.fixture
def walk_id():
    gym.register("Walk-v0", Walk)
    yield "Walk-v0"
    del gym.registry["Walk-v0"]


def test_from_videos_to_a_trained_agent_by_commands(walk_id, tmp_path, capsys):
    folder = tmp_path / "videos"
    folder.mkdir()
    for i, video in enumerate(videos(3)):
        np.savez(folder / f"{i}.npz", frames=video)
    path, logs = tmp_path / "walk.npz", tmp_path / "logs"
    small = ["--updates", "60", "--random-episodes", "2", "--image-size", str(SIZE)]
    assert main(["rank", str(folder), "--env", walk_id, "-o", str(path), *small]) == 0
    assert "rank correlation with normalized_performance" in capsys.readouterr().out and path.with_suffix(".png").is_file()
    flags = ["--algo", "sac_drq", "--env", walk_id, "-n", "30", "--eval-freq", "20", "--eval-episodes", "1", "-f", str(logs)]
    params = ["learning_starts:15", "buffer_size:50", "batch_size:4"]
    assert train([*flags, "--ranker", str(path), "--ranker-kwargs", "scale:3.0", "gamma:0.9", "-params", *params]) == 0
    run = logs / "sac_drq" / "Walk-v0_1"
    model = VisualSAC.load(run / "best_model.zip")
    assert "RankedProgress" in model.training_environment and "gamma: 0.9" in model.training_environment
    path.unlink()  # not needed to play
    evaluation = evaluate(run, walk_id, n_episodes=1)
    assert evaluation.returns == [pytest.approx(0.5 * 20)], "the task's own score"
    assert evaluate(run, walk_id, n_episodes=1).normalized_performance == evaluation.normalized_performance


def test_a_model_trained_in_python_is_scored_by_the_task(walk_id, file):
    env = RankedProgress(gym.make(walk_id), file)
    model = SAC("CnnPolicy", env, buffer_size=30, learning_starts=15, batch_size=4, policy_kwargs=dict(net_arch=[8])).learn(20)
    assert evaluate(model, walk_id, n_episodes=1, env_wrapper=lambda env: env).returns == [pytest.approx(0.5 * 20)]
    small = dict(features_extractor_kwargs=dict(strides=(2, 2)), net_arch=[8])
    ours = VisualSAC("CnnPolicy", env, buffer_size=30, learning_starts=15, batch_size=4, policy_kwargs=small).learn(20)
    assert ours.environment_made_of["env_wrapper"][0]["sb3_por.ranking.progress.RankedProgress"]["ranker"] == file
    assert evaluate(ours, walk_id, n_episodes=1).returns == [pytest.approx(0.5 * 20)]


def test_the_wrapper_is_known_by_its_short_path_too():
    spec = [{"sb3_por.ranking.RankedProgress": {"ranker": "a.npz"}}, {"gymnasium.wrappers.ClipReward": {"max_reward": 1}}]
    assert rankers(spec) == ["a.npz"] and without_ranker(spec) == spec[1:]
    assert len(with_ranker(spec, "b.npz", {})) == 2
    assert without_ranker("sb3_por.ranking.RankedProgress") == []


def test_a_model_that_observes_no_images_is_refused_before_it_plays(capsys):
    flags = ["--model", "expert", "--env", "PourWater-v0", "-n", "2", "-o", "r.npz", "--env-kwargs", "obs_type:state"]
    assert main(["rank", *flags]) == 2
    told = capsys.readouterr()
    assert "there is no single image in" in told.err and "videos:" not in told.out


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--model", "expert", "-o", "r.npz"], "give --env, too"),
        (["VIDEOS", "-o", "r.zip"], "r.zip must end in .npz"),
        (["VIDEOS", "-o", "r.npz"], "there are no videos in"),
        (["VIDEOS", "-o", "r.npz", "--env", "Walc-v0"], "did you mean Walk-v0?"),
        (["VIDEOS", "-o", "r.npz", "--updates", "0"], "--updates must be at least 1, got 0"),
        (["--model", "expert", "--env", "Walk-v0", "-o", "r.npz", "--image-size", "31"], "32 to 256 pixels a side, not 31"),
        (["nowhere", "-o", "r.npz"], "there is no folder nowhere"),
    ],
)
def test_what_cannot_be_ranked_is_said_in_one_line(arguments, message, walk_id, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "VIDEOS").mkdir()
    assert main(["rank", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_demonstrations_can_have_the_rankers_rewards(walk_id, file, tmp_path, capsys):
    model = SAC("CnnPolicy", gym.make(walk_id), buffer_size=10, policy_kwargs=dict(net_arch=[8]), seed=0)
    model.save(tmp_path / "model.zip")
    flags = ["record", "--model", str(tmp_path / "model.zip"), "--env", walk_id, "-n", "1", "-o"]
    ranked = ["--ranker", file, "--ranker-kwargs", "scale:3.0"]
    assert main([*flags, str(tmp_path / "none"), *ranked]) == 2
    assert "give --algo, too" in capsys.readouterr().err and not (tmp_path / "none").exists()
    assert main([*flags, str(tmp_path / "plain"), "--algo", "sac_drq"]) == 0
    assert main([*flags, str(tmp_path / "ranked"), "--algo", "sac_drq", *ranked]) == 0
    plain, ranked_ = (next(Demonstrations(tmp_path / name).episodes()) for name in ("plain", "ranked"))
    potential = Ranker.load(file).potential(plain.observations)
    assert np.array_equal(ranked_.actions, plain.actions)
    assert np.allclose(ranked_.rewards - plain.rewards, 3.0 * np.diff(potential), atol=1e-5)


@pytest.mark.parametrize(
    "flags, message",
    [
        (["--ranker", "none.npz"], "there is no ranker none.npz"),
        (["--ranker-kwargs", "scale:1.0"], "give --ranker, too"),
    ],
)
def test_training_needs_a_ranker_that_is_there(flags, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert train(["--algo", "sac_drq", "--env", "PourWater-v0", *flags]) == 2
    assert message in capsys.readouterr().err and not list(tmp_path.iterdir())
