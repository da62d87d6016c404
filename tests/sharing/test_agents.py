"""Agents for others: exported from a run, found by task, loaded without running anything, and scored as published."""

import json
import re
import resource
import subprocess
import sys
import zipfile
from pathlib import Path

import imageio.v2 as imageio
import pytest

from sb3_por import SACPOR
from sb3_por.__main__ import main
from sb3_por.common.errors import UserError
from sb3_por.evaluation import evaluate, load_safe
from sb3_por.runs.folder import read_settings, write_settings
from sb3_por.runs.provenance import current_machine
from sb3_por.sharing import agents
from sb3_por.sharing.agents import find_agent, read_agents, read_evaluation
from sb3_por.sharing.export import export_run, without_paths
from sb3_por.training.zoo import main as train

ROOT = Path(__file__).parents[2]
TINY = ["--env-kwargs", "image_size:36", "-n", "30", "--eval-freq", "30", "--eval-episodes", "1", "--seed", "3"]
PARAMS = [
    "learning_starts:10",
    "buffer_size:60",
    "batch_size:8",
    "policy_kwargs:dict(net_arch=[8],features_extractor_kwargs=dict(n_filters=2,strides=[4,2]))",
]


def make_run(folder, algo, env, *more):
    arguments = ["--algo", algo, "--env", env, *TINY, *more, "-f", str(folder), "-params", *PARAMS]
    assert train(arguments) == 0
    return folder / algo / f"{env}_1"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short training of pouring; ten control steps an action, which the model's file must tell."""
    return make_run(tmp_path_factory.mktemp("logs"), "sac_por", "PourWater-v0")


@pytest.fixture(scope="module")
def folder(run, tmp_path_factory):
    """The run exported with three episodes, and a second agent of the task that is worse."""
    folder = tmp_path_factory.mktemp("agents")
    agent = export_run(run, folder, n_episodes=3)
    worse = json.loads(agent.model.with_suffix(".json").read_text())
    worse["algo"] = "worse"
    worse["evaluation"]["episodes"]["normalized_performance"] = [-9.0] * 3
    (folder / "worse-PourWater-v0.json").write_text(json.dumps(worse))
    (folder / "worse-PourWater-v0.zip").write_bytes(agent.model.read_bytes())
    return folder


@pytest.fixture
def pretrained(folder, monkeypatch):
    monkeypatch.setattr(agents, "PRETRAINED", folder)


def test_an_exported_agent_is_small_and_holds_no_pickled_code(folder):
    with zipfile.ZipFile(folder / "sac_por-PourWater-v0.zip") as archive:
        assert archive.namelist() == ["data", "policy.pth", "_stable_baselines3_version"]
        assert b"serialized" not in archive.read("data")
    assert type(load_safe(folder / "sac_por-PourWater-v0.zip")).__name__ == "SACPOR"


def test_sb3s_way_to_load_it_names_the_one_that_can(folder):
    file = find_agent("PourWater-v0", folder=folder).model
    with pytest.raises(UserError, match=re.escape(f"{file} was exported without pickled code: load it with sb3_por.eval")):
        SACPOR.load(file)


def test_an_exported_agent_tells_what_it_was(run, folder):
    facts = json.loads((folder / "sac_por-PourWater-v0.json").read_text())
    assert facts["class"] == "SACPOR" and facts["seed"] == 3 and facts["steps"] == 30
    assert facts["command"].startswith("python train.py ")
    assert facts["settings"]["env_wrapper"] == [{"softbody_envs.wrappers.ActionRepeat": {"repeat": 10, "scale": 0.7}}]
    assert facts["evaluation"]["n_episodes"] == 3 and facts["evaluation"]["episodes"]["variations"] == [800, 801, 802]
    assert str(run.parents[1]) not in json.dumps(facts)


def test_the_published_scores_are_repeated_bit_for_bit(run, folder):
    agent = find_agent("PourWater-v0", "sac_por", folder)
    assert evaluate(agent.model, "PourWater-v0", 3) == read_evaluation(agent.facts["evaluation"], 3)
    assert evaluate(run, "PourWater-v0", 3) == read_evaluation(agent.facts["evaluation"], 3)


def test_the_best_agent_of_a_task_is_found(folder):
    assert find_agent("PourWater-v0", folder=folder).facts["algo"] == "sac_por"
    assert find_agent("PourWater-v0", "worse", folder).evaluation.score == -9.0
    with pytest.raises(UserError, match=r"unknown agent of PourWater-v0 'wors'; did you mean worse\?"):
        find_agent("PourWater-v0", "wors", folder)
    with pytest.raises(UserError, match="no trained agent of FoldCloth-v0 comes with the package"):
        find_agent("FoldCloth-v0", folder=folder)


def test_evaluate_pretrained_prints_what_was_published(pretrained, capsys):
    assert main(["evaluate", "--env", "PourWater-v0", "--pretrained", "-n", "2"]) == 0
    measured, published = capsys.readouterr().out.splitlines()
    assert published == f"published: {measured}" and measured.endswith("(2 episodes)")
    assert main(["evaluate", "--env", "PourWater-v0", "--pretrained", "--algo", "worse", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["n_episodes"] == 3 and shown["published"]["mean"]["normalized_performance"] == -9.0
    assert shown["episodes"]["returns"] == shown["published"]["episodes"]["returns"]


def test_enjoy_pretrained_makes_a_video(pretrained, tmp_path, capsys):
    path = tmp_path / "pour.gif"
    assert main(["enjoy", "--env", "PourWater-v0", "--pretrained", "-o", str(path), "--size", "40"]) == 0
    assert imageio.mimread(path)[0].shape[:2] == (40, 40)
    assert main(["enjoy", "--env", "PourWater-v0", "--pretrained", "--model", "x", "-o", str(path)]) == 2
    assert "not allowed with argument" in capsys.readouterr().err


def test_an_exported_agent_is_diagnosed_without_the_gradients_of_its_q_networks(pretrained, capsys):
    assert main(["diagnose", "--env", "PourWater-v0", "--pretrained", "-n", "1", "--json"]) == 0
    diagnosis = json.loads(capsys.readouterr().out)
    assert diagnosis["grad_norm_critic"] is None and diagnosis["grad_norm_por"] is None
    assert 0 <= diagnosis["accuracy"] <= 1 and diagnosis["feature_std"] > 0


@pytest.mark.parametrize("algo, normalize", [("sac", True), ("tqc", False), ("ppo", True)])
def test_models_of_sb3_with_statistics_can_be_exported(algo, normalize, tmp_path, capsys):
    flags = ["--algo", algo, "--env", "Pendulum-v1", "-n", "200", "--eval-freq", "100", "--eval-episodes", "1"]
    params = [f"normalize:{normalize}", "n_envs:1"] + (["n_steps:50", "batch_size:25"] if algo == "ppo" else [])
    assert train([*flags, "-f", str(tmp_path / "logs"), "-params", *params]) == 0
    run = tmp_path / "logs" / algo / "Pendulum-v1_1"
    assert main(["export", str(run), "-o", str(tmp_path / "agents"), "-n", "2", "--last"]) == 0
    exported = tmp_path / "agents" / f"{algo}-Pendulum-v1.zip"
    assert capsys.readouterr().out.splitlines()[-1] == str(exported)
    with zipfile.ZipFile(exported) as archive:
        assert ("vecnormalize.json" in archive.namelist()) == normalize
    assert evaluate(exported, "Pendulum-v1", 2) == evaluate(run / "Pendulum-v1.zip", "Pendulum-v1", 2)


def test_what_cannot_be_loaded_safely_is_not_exported(run, tmp_path, capsys):
    settings = run / "PourWater-v0" / "config.yml"
    kept = read_settings(settings)
    try:
        write_settings(settings, kept | {"env_wrapper": "gymnasium.wrappers.RecordEpisodeStatistics"})
        assert main(["export", str(run), "-o", str(tmp_path / "agents"), "-n", "1"]) == 2
    finally:
        write_settings(settings, kept)
    assert "the wrapper 'gymnasium.wrappers.RecordEpisodeStatistics' is refused" in capsys.readouterr().err
    assert list((tmp_path / "agents").iterdir()) == []
    assert main(["export", str(tmp_path), "-o", str(tmp_path / "agents")]) == 2
    assert "is no folder of a run" in capsys.readouterr().err


@pytest.mark.parametrize(
    "typed, published",
    [
        ("/home/u/.venv/bin/python train.py --algo sac_por --env PourWater-v0", "--algo sac_por --env PourWater-v0"),
        ("/home/u/python -m sb3_por.zoo --algo sac -f /data/logs --env 'X-v0'", "--algo sac --env X-v0"),
        ("sb3-por-train --conf-file /home/u/mine.yml --env X-v0", "--conf-file mine.yml --env X-v0"),
        ("python train.py --conf-file=/home/u/mine.yml --storage mysql://host/db", "--conf-file=mine.yml --storage mysql:db"),
        ("python train.py -params 'k:1", """-params ''"'"'k:1'"""),
        ('python /home/u/code/train.py -params "k:[1, 2]"', "-params 'k:[1, 2]'"),
    ],
)
def test_a_published_command_names_no_folder(typed, published):
    assert without_paths(typed) == f"python train.py {published}"


def test_agents_of_the_package_are_small_and_score_what_they_publish():
    shipped = read_agents(agents.PRETRAINED)
    sizes = [agent.model.stat().st_size for agent in shipped]
    assert all(size <= 2**20 for size in sizes) and sum(sizes) <= 6 * 2**20
    for agent in shipped:
        env_id = agent.facts["env"]
        assert agent.model.name == f"{agents.agent_name(agent.facts['algo'], env_id)}.zip"
        again, published = evaluate(agent.model, env_id, 3), read_evaluation(agent.facts["evaluation"], 3)
        # Another processor rounds otherwise, which a simulation of contacts amplifies.
        tolerance = 1e-6 if agent.facts["machine"] == current_machine() else 0.1
        assert again.score == pytest.approx(published.score, abs=tolerance)


def test_a_video_of_a_new_process_takes_less_than_20_seconds_of_a_core(folder, tmp_path):
    script = (
        "import sys; from pathlib import Path; from sb3_por.sharing import agents; "
        f"agents.PRETRAINED = Path({str(folder)!r}); from sb3_por.__main__ import main; sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", script, "enjoy", "--env", "PourWater-v0", "--pretrained", "-o", str(tmp_path / "v.gif")]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, cwd=ROOT, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 20
    assert (tmp_path / "v.gif").stat().st_size > 0


def test_an_agent_goes_by_its_algorithm_too(folder):
    facts = json.loads((folder / "sac_por-PourWater-v0.json").read_text())
    assert find_agent("PourWater-v0", "sac_por", folder).facts == facts
    assert find_agent("PourWater-v0", "worse", folder).facts["class"] == facts["class"] == "SACPOR"
    assert find_agent("FoldCloth-v0", "sac_drq").facts["algo"] == "plain"
