"""The benchmarks measure what they say: the learner's floor has the passes that it makes, a probe reads what features tell."""

import argparse
import importlib.util
from pathlib import Path

import pandas as pd
import pytest
import torch as th
from torch import nn
from toy_envs import DotEnv

from sb3_por import SACDrQ


def load(name):
    path = Path(__file__).parents[2] / "benchmarks" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"{name}_benchmark", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


balance, encoders, learner, sight, time_to_score = map(load, ("balance", "encoders", "learner", "sight", "time_to_score"))


@pytest.mark.parametrize("name", learner.ALGORITHMS)
def test_the_floor_has_the_passes_of_the_algorithm(name, monkeypatch):
    monkeypatch.setattr(learner, "N_FRAMES", 20)
    model = learner.make_model(name, batch=8, image_size=64, device="cpu", options={})
    passes = {"forward": 0, "back": 0}

    def count(conv, inputs, output):
        passes["forward"] += len(output)
        if output.requires_grad:
            output.register_hook(arrive)

    def arrive(gradient):
        passes["back"] += len(gradient)

    first_layers = {id(module): module for module in model.policy.modules() if isinstance(module, nn.Conv2d)}
    for conv in first_layers.values():
        if conv.in_channels == 3:
            conv.register_forward_hook(count)
    # Not an update of which the actor or the targets make nothing, and none with diagnostics
    model._n_updates = 1
    th.manual_seed(0)
    model.train(1, 8)
    trained, untrained, again = learner.ALGORITHMS[name][2]
    assert (passes["forward"] / 8, passes["back"] / 8) == (trained + untrained, trained + again)


def test_a_probe_reads_what_an_agents_features_tell(tmp_path):
    model = SACDrQ("CnnPolicy", DotEnv(), policy_kwargs=dict(features_extractor_kwargs=dict(n_filters=4)), buffer_size=10)
    model.save(tmp_path / "model.zip")
    th.manual_seed(0)
    frames = th.randint(0, 256, (200, *model.observation_space.shape), dtype=th.uint8)
    with th.no_grad():
        targets = model.critic.encode(frames)[:, :8]
    arguments = argparse.Namespace(updates=300, batch=32)
    told = encoders.probe(tmp_path / "model.zip", (frames, targets), (frames, targets), arguments)
    unrelated = (frames, th.randn(targets.shape) * targets.std(dim=0) + targets.mean(dim=0))
    held_out = (frames, unrelated[1][th.randperm(len(frames))])
    assert told["error_cm"] < 0.5 * encoders.probe(tmp_path / "model.zip", unrelated, held_out, arguments)["error_cm"]


def test_gradients_are_followed_under_each_kind_of_weight(monkeypatch):
    monkeypatch.setattr(balance, "INTERVAL", 20)
    ratios = {}
    for coef in (0.0, 100.0, "auto_0.1"):
        model = balance.make_model(DotEnv(falling=True), coef, seed=0, n_frames=60).learn(60)
        rows = [dict(zip(("update", *balance.METRICS), row, strict=True)) for row in balance.follow(model, 40)]
        assert [row["update"] for row in rows] == [20, 40] and model._n_updates == 40
        ratios[coef] = rows[0]["encoder_grad_norm_por"] / rows[0]["encoder_grad_norm_critic"]
        if coef != "auto_0.1":
            assert {row["por_coef"] for row in rows} == {coef}
    assert ratios[0.0] == 0.0 and ratios[100.0] > 10 * ratios["auto_0.1"] > 0.5


def test_the_time_to_a_score_is_that_of_the_first_evaluation_with_it():
    def run(env, seed, *scores):
        steps, seconds = [100 * i for i in range(1, 4)], [60.0 * i for i in range(1, 4)]
        columns = {"step": steps, "normalized_performance": scores, "wall_clock_s": seconds}
        return pd.DataFrame({"env": env, "algo": "sac_por", "seed": seed, **columns}).sample(frac=1, random_state=0)

    scores = pd.concat(
        [run("PourWater-v0", 0, 0.1, 0.8, 0.2), run("PourWater-v0", 1, 0.1, 0.7, 0.79), run("Own-v0", 0, 1, 1, 1)]
    )
    times = time_to_score.time_to_score(scores).set_index("seed")
    assert times.loc[0, ["env", "wanted", "step", "minutes"]].tolist() == ["PourWater-v0", 0.8, 200, 2]
    assert times.loc[1, ["step", "minutes"]].isna().all() and len(times) == 2


def test_the_ceiling_of_sight_is_that_of_the_settings():
    """The clone sees what the agent sees, plays as often as the agent acts, and is told what the expert would do."""
    arguments = "--env StraightenRope-v0 --rounds 2 --episodes 1 --updates 2 --batch 8 --scenes 2 --frames 2"
    study = sight.Study(sight.parser().parse_args([*arguments.split(), "--env-kwargs", "image_size:48"]))
    row = list(study.run())[-1]
    assert row["size"] == 48 and row["steps"] == 2 * 38 and row["expert"] > 0.9 > row["score"] >= row["worst"]
    assert study.planar_actions == [[0, 1], [4, 5]] and study.clone.encoder.n_positions == 5 * 24
    first, second, later = (study.memory.stack(step) for step in (38, 39, 40))
    assert (first[:3] == first[3:]).all() and (second[:3] == first[:3]).all() and (later[:3] == second[3:]).all()
    assert all((action[[3, 7]] ** 2 == 1).all() for action in study.memory.actions), "the expert's, whoever plays"
