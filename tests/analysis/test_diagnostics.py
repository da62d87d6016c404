"""Diagnosis and saliency: what they measure is right where the answer is known, and they refuse what has no order."""

import json
import shutil
import subprocess
import sys

import cv2
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from made_runs import write_run
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_por import SACPOR
from sb3_por.__main__ import main
from sb3_por.analysis import diagnostics, fresh_heads
from sb3_por.analysis.controls import PlayedFrames, measure_controls, pairs_within_episodes
from sb3_por.analysis.diagnostics import diagnose, diagnose_runs
from sb3_por.analysis.fresh_heads import judgement, train_head
from sb3_por.analysis.saliency import draw_saliency, overlay, saliency_map
from sb3_por.common.errors import UserError
from sb3_por.evaluation import load_safe
from sb3_por.evaluation.loading import load_model
from sb3_por.objectives.base import EncodedBatch
from sb3_por.objectives.por import PartialOrder


@pytest.fixture(scope="module")
def model():
    env = gym.make("FallingBall-v0", image_size=36)
    model = SACPOR("CnnPolicy", env, buffer_size=200, learning_starts=60, batch_size=16, seed=0)
    return model.learn(80)


@pytest.fixture(scope="module")
def model_file(model, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "model.zip"
    model.save(path)
    return path


def test_an_untrained_classifier_is_at_chance_and_leaks_nothing(model):
    diagnosis = diagnose(model, "FallingBall-v0", n_episodes=1)
    assert diagnosis.leak_loss == pytest.approx(np.log(2), abs=0.02)
    assert diagnosis.loss == pytest.approx(np.log(2), abs=0.1)
    assert 0 <= diagnosis.accuracy <= 1 and 0 <= diagnosis.random_accuracy <= 1
    assert diagnosis.grad_norm_critic > 0 and diagnosis.grad_norm_por > 0
    assert diagnosis.as_dict() == diagnose(model, "FallingBall-v0", n_episodes=1).as_dict()


def test_a_model_in_memory_is_measured_as_from_its_file(tmp_path):
    env = VecNormalize(make_vec_env("Pendulum-v1", seed=0), norm_reward=False)
    model = SACPOR("MlpPolicy", env, buffer_size=200, learning_starts=50, batch_size=8, seed=0).learn(60)
    model.save(tmp_path / "model.zip")
    env.save(str(tmp_path / "statistics.pkl"))
    of_memory, of_file = (
        diagnose(one, "Pendulum-v1", n_episodes=1, vec_normalize=str(tmp_path / "statistics.pkl")).as_dict()
        for one in (model, tmp_path / "model.zip")
    )
    assert of_memory == of_file


def test_a_balanced_weight_that_safe_loading_does_not_read_is_named(tmp_path):
    env = gym.make("FallingBall-v0", image_size=36)
    model = SACPOR("CnnPolicy", env, buffer_size=60, learning_starts=20, batch_size=4, por_coef="auto_0.1", seed=0).learn(25)
    model.save(tmp_path / "model.zip")
    trusted, safe = (load(tmp_path / "model.zip") for load in (load_model, load_safe))
    assert "POR unknown" not in str(diagnose(trusted, "FallingBall-v0", n_episodes=1))
    diagnosis = diagnose(safe, "FallingBall-v0", n_episodes=1)
    assert "POR unknown" in str(diagnosis) and diagnosis.as_dict()["grad_norm_por"] is None


def test_a_potential_that_follows_the_ball_has_correlation_one(model, monkeypatch):
    def row_of_the_ball(observations):
        redness = observations[:, 0].float() - observations[:, 1].float()
        rows = th.arange(redness.shape[1]).float()[None, :, None]
        row = (redness.clamp(min=0) * rows).sum((1, 2)) / redness.clamp(min=0).sum((1, 2)).clamp(min=1)
        return row[:, None].expand(-1, model.policy.objective.features_dim)

    monkeypatch.setattr(model.critic, "encode", row_of_the_ball)
    monkeypatch.setattr(model.policy.objective, "potential", lambda features: features[:, 0])
    diagnosis = diagnose(model, "FallingBall-v0", n_episodes=3)
    assert diagnosis.orders["own"].correlation > 0.99 and diagnosis.orders["clock"].correlation > 0.99
    assert np.isnan(diagnosis.orders["own"].partial_correlation), "the ball falls at every step: time determines its ranks"
    assert np.isnan(diagnosis.orders["own"].equal_time_correlation), "all balls fall alike"
    monkeypatch.setattr(model.policy.objective, "potential", lambda features: -features[:, 0])
    assert diagnose(model, "FallingBall-v0", n_episodes=1).orders["own"].correlation < -0.99


def test_a_model_that_sees_image_and_state_is_diagnosed_too():
    env = gym.make("FallingBall-v0", obs_type="dict", image_size=36)
    model = SACPOR("MultiInputPolicy", env, buffer_size=200, learning_starts=60, batch_size=16, seed=0).learn(70)
    assert -1 <= diagnose(model, "FallingBall-v0", n_episodes=1).orders["own"].correlation <= 1


def test_an_encoder_that_says_the_same_of_all_frames_is_found(model_file):
    model = load_model(model_file)
    sound = diagnose(model, "FallingBall-v0", n_episodes=1).feature_std
    with th.no_grad():
        model.critic.projection.blocks[0][0].weight.zero_()
    assert diagnose(model, "FallingBall-v0", n_episodes=1).feature_std < 1e-6 < 0.01 < sound


def test_fresh_heads_are_measured_beside_the_models_own(model, monkeypatch):
    monkeypatch.setattr(fresh_heads, "N_UPDATES", 100)
    monkeypatch.setattr(diagnostics, "N_HEAD_EPISODES", 2)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    plain, controlled = (diagnose(model, "FallingBall-v0", n_episodes=2, fresh_head=fresh) for fresh in (False, True))
    assert all(th.equal(value, before[name]) for name, value in model.policy.state_dict().items())
    assert list(controlled.orders) == ["own", "clock", "fresh", "untrained", "sham"] == list(diagnostics.ORDERS)
    assert plain.as_dict().items() <= controlled.as_dict().items(), "the controls change nothing else"
    assert len({order.correlation for order in controlled.orders.values()}) == len(controlled.orders)
    assert "fresh head, untrained encoder" in str(controlled) and "clock" in str(plain)


def test_a_fresh_head_learns_what_is_in_the_features_and_no_sham(monkeypatch):
    monkeypatch.setattr(fresh_heads, "N_UPDATES", 300)
    th.manual_seed(0)
    episode, step = np.repeat(np.arange(30), 20), np.tile(np.arange(20), 30)
    frames = PlayedFrames(episode, step, step.astype(float))
    told, untold = th.randn(2, len(frames), 8)
    told[:, 3] = th.as_tensor(step) / 5
    train, test = (PlayedFrames(episode[rows], step[rows], frames.quantity[rows]) for rows in (slice(400), slice(400, None)))

    def accuracy(features, sham=False):
        head = PartialOrder(8, 1, pairing="paper", order_head="difference")
        train_head(head, features[:400], *pairs_within_episodes(train, [1]), sham=sham)
        return measure_controls(test, *judgement(head, features[400:]), k=1).pair_accuracy

    assert accuracy(told) > 0.9
    assert accuracy(untold) == pytest.approx(0.5, abs=0.12)
    assert accuracy(told, sham=True) == pytest.approx(0.5, abs=0.25)


def test_a_head_is_judged_as_in_training(model):
    features = th.randn(40, model.policy.objective.features_dim)
    first, second = np.arange(20), np.arange(20, 40)
    objective = PartialOrder(features.shape[1], 2, pairing="paper")
    logged = objective.loss(EncodedBatch(present=features[:20], future=features[20:]))[1]["accuracy"]
    assert judgement(objective, features)[1](first, second).mean() == pytest.approx(float(logged))


def test_diagnosis_leaves_the_model_as_it_was(model):
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    diagnose(model, "FallingBall-v0", n_episodes=1)
    assert all(th.equal(value, before[name]) for name, value in model.policy.state_dict().items())
    assert all(parameter.grad is None for parameter in model.critic_target.parameters())


def test_saliency_is_where_the_classifier_looks(model, monkeypatch):
    monkeypatch.setattr(model.critic, "encode", lambda frames: frames[:, :, :6, :6].flatten(1)[:, :50] / 255)
    rng = np.random.default_rng(0)
    earlier, later = rng.integers(0, 256, (2, 3, 36, 36), dtype=np.uint8)
    heat = saliency_map(model, earlier, later)
    assert heat.shape == (36, 36) and heat.max() == pytest.approx(1.0)
    assert heat[:6, :6].sum() > 0 and heat[6:, :].sum() == heat[:, 6:].sum() == 0


def test_overlay_shows_the_frame_beside_its_heat():
    frame = np.full((10, 10, 3), 200, np.uint8)
    heat = np.zeros((10, 10), np.float32)
    heat[0, 0] = 1
    picture = overlay(frame, heat, size=40)
    assert picture.shape == (40, 80, 3)
    assert (picture[:, :40] == 200).all() and picture[0, 40].sum() > picture[39, 79].sum()
    assert np.array_equal(overlay(frame[..., :1], heat, size=40), picture)


def test_saliency_of_stacked_grey_frames_shows_the_last(tmp_path, monkeypatch):
    def grey(env):
        return gym.wrappers.GrayscaleObservation(env, keep_dim=True)

    env = VecFrameStack(DummyVecEnv([lambda: grey(gym.make("FallingBall-v0", image_size=36))]), 3)
    model = SACPOR("CnnPolicy", env, buffer_size=50, learning_starts=100)
    shown = []
    monkeypatch.setattr("sb3_por.analysis.saliency.overlay", lambda *args: shown.append(args[0]) or overlay(*args))
    draw_saliency(model, "FallingBall-v0", tmp_path / "map.png", step=5, env_wrapper=grey)
    assert shown[0].shape == (36, 36, 1)


def test_a_model_without_an_order_is_refused():
    with pytest.raises(UserError, match="sac_por"):
        diagnose(SAC("MlpPolicy", "Pendulum-v1"), "Pendulum-v1")


def test_commands_write_json_and_a_picture(model_file, tmp_path):
    command = [sys.executable, "-m", "sb3_por"]
    of_model = ["--model", str(model_file), "--env", "FallingBall-v0"]
    printed = subprocess.run([*command, "diagnose", *of_model, "-n", "1", "--json"], check=True, capture_output=True).stdout
    assert json.loads(printed)["leak_loss"] == pytest.approx(np.log(2), abs=0.02)
    picture = tmp_path / "map.png"
    subprocess.run([*command, "saliency", *of_model, "-o", str(picture), "--step", "5"], check=True, capture_output=True)
    assert cv2.imread(str(picture)).shape == (480, 960, 3)


def test_runs_become_a_table_of_what_their_classifiers_learned(model_file, tmp_path, capsys):
    run = write_run(tmp_path, env="FallingBall-v0", seed=3, label="mine")
    shutil.copy(model_file, run / "FallingBall-v0.zip")
    write_run(tmp_path / "unfinished", env="FallingBall-v0", seed=4)
    other = write_run(tmp_path, algo="sac", env="Pendulum-v1", seed=3)
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10).save(other / "Pendulum-v1.zip")
    table = diagnose_runs([tmp_path], n_episodes=1)
    assert table[["env", "algo", "seed", "step"]].to_numpy().tolist() == [["FallingBall-v0", "mine", 3, 80]]
    expected = diagnose(load_model(run / "FallingBall-v0.zip"), "FallingBall-v0", n_episodes=1)
    assert (table["leak_loss"].item(), table["correlation"].item()) == (expected.leak_loss, expected.orders["own"].correlation)
    assert main(["diagnose", str(tmp_path), "-n", "1", "--csv", str(tmp_path / "table.csv")]) == 0
    assert {"clock_correlation", "partial_correlation", "equal_time_accuracy"} < set(table.columns)
    shown = capsys.readouterr().out
    assert "mine" in shown and max(map(len, shown.splitlines())) <= 80
    second = write_run(tmp_path, env="FallingBall-v0", seed=5, label="other")
    shutil.copy(model_file, second / "FallingBall-v0.zip")
    assert main(["diagnose", str(tmp_path), "-n", "1"]) == 0
    assert capsys.readouterr().out.splitlines()[1].split() == ["algo", "mine", "other"]
    assert (tmp_path / "table.csv").read_text().startswith("env,algo,seed,step,loss,")
    with pytest.raises(UserError, match="none of these runs has ended with a model that learns an order"):
        diagnose_runs([other])
    model = ["--model", str(model_file), "--env", "FallingBall-v0"]
    for arguments in (model[2:], [*model, str(tmp_path)], [*model, "--csv", str(tmp_path / "x.csv")]):
        assert main(["diagnose", *arguments]) == 2 and "give --model and --env, or folders" in capsys.readouterr().err
