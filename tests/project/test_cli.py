"""python -m sb3_por: evaluate, enjoy and plot, from the shell's point of view."""

import json
import subprocess
import sys
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from stable_baselines3 import SAC

from sb3_por.__main__ import COMMANDS, main
from sb3_por.runs.origin import mark_as_own

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder with a model and two evaluations."""
    folder = tmp_path_factory.mktemp("logs") / "sac" / "Pendulum-v1_3"
    folder.mkdir(parents=True)
    mark_as_own(folder)
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, seed=0).save(folder / "best_model.zip")
    episodes = np.array([[0.1, 0.2], [0.5, 0.6]])
    np.savez(
        folder / "evaluations.npz",
        timesteps=[100, 200],
        results=episodes,
        ep_lengths=np.full((2, 2), 5),
        normalized_performance=episodes,
    )
    return folder


def test_evaluate_from_the_shell_prints_json(run):
    command = [sys.executable, "-m", "sb3_por", "evaluate", "--model", run, "--env", "Pendulum-v1", "-n", "2", "--json"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["n_episodes"] == 2 and result["mean"]["length"] == 200.0
    assert result["mean"]["return"] == pytest.approx(np.mean(result["episodes"]["returns"]))


def test_output_that_nobody_reads_on_is_no_error(tmp_path):
    (tmp_path / "grid.yml").write_text("algos: [sac]\nenvs: [Pendulum-v1]\nseeds: [0, 1, 2]\n")
    command = [sys.executable, "-u", "-m", "sb3_por", "suite", tmp_path / "grid.yml", "--dry-run"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert process.stderr.read() == "" and process.wait() == 141


def test_evaluate_prints_a_line(run, capsys):
    assert main(["evaluate", "--model", str(run / "best_model.zip"), "--env", "Pendulum-v1", "-n", "1"]) == 0
    line, note = capsys.readouterr()
    assert line.startswith("return -") and line.endswith("length 200 (1 episode)\n")
    file = run / "best_model.zip"
    assert note == f"note: {file} does not tell how its environment was wrapped: Pendulum-v1 is made without wrappers\n"


def test_evaluate_knows_the_two_ends_of_the_scale(capsys):
    for model in ("random", "expert"):
        assert main(["evaluate", "--model", model, "--env", "PourWater-v0", "-n", "1"]) == 0
    random, expert = capsys.readouterr().out.splitlines()
    assert "success 0%" in random and "success 100%" in expert


def test_enjoy_writes_a_video_and_says_where(run, tmp_path, capsys):
    path = tmp_path / "new" / "expert.gif"
    arguments = ["--model", "expert", "--env", "PourWater-v0", "-o", str(path), "--size", "48"]
    assert main(["enjoy", *arguments]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(path)
    assert imageio.mimread(path)[0].shape[:2] == (48, 48)


def test_enjoy_says_what_an_environment_needs_to_draw(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pygame", None)
    assert main(["enjoy", "--model", str(run), "--env", "Pendulum-v1", "-o", str(tmp_path / "video.gif")]) == 2
    assert "error: Pendulum-v1 renders no images: pygame is not installed" in capsys.readouterr().err


def test_report_writes_a_page_and_says_where(run, tmp_path, capsys):
    assert main(["report", str(run), "-o", str(tmp_path / "page"), "--no-videos"]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'page' / 'index.html'}\n"
    page = (tmp_path / "page" / "index.html").read_text()
    assert "Pendulum-v1" in page and 'id="videos"' not in page and "its model cannot be shown" not in page


def test_plot_draws_a_run_and_its_table_draws_the_same(run, tmp_path, capsys):
    first, second, csv = tmp_path / "curve.png", tmp_path / "again.png", tmp_path / "scores.csv"
    assert main(["plot", str(run), "-o", str(first), "--csv", str(csv)]) == 0
    assert main(["plot", str(csv), "-o", str(second)]) == 0
    assert capsys.readouterr().out.splitlines() == [str(first), str(second)]
    assert first.read_bytes() == second.read_bytes()


def test_plot_says_what_it_leaves_out(run, tmp_path, capsys):
    csv = tmp_path / "scores.csv"
    rows = ["T,a,1,100,0.1", "T,a,1,200,0.2", "T,a,2,100,"]
    csv.write_text("\n".join(["env,algo,seed,step,normalized_performance", *rows]))
    assert main(["plot", str(csv), "-o", str(tmp_path / "curve.pdf")]) == 0
    assert "note: 1 of 3 evaluations have no normalized_performance" in capsys.readouterr().err


def test_plot_draws_every_figure_into_a_folder(run, tmp_path, capsys):
    assert main(["plot", str(run), "--kind", "all", "-o", str(tmp_path / "figures")]) == 0
    shown = capsys.readouterr()
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert {"iqm.png", "iqm.pdf", "iqm.csv", "tasks.png", "profile.pdf", "aggregates.csv"} <= names
    assert "note: there is one algorithm only (sac): no probability of improvement" in shown.err
    assert main(["plot", str(run), "--step", "150", "-o", str(tmp_path / "numbers.csv")]) == 0
    assert (tmp_path / "numbers.csv").read_text().splitlines()[-1] == "sac,150,0.35,0.35,0.35,1,1,Pendulum-v1"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the following arguments are required: COMMAND"),
        (["evalute"], "invalid choice: 'evalute'"),
        (["train", "--env", "PourWater-v0"], "python train.py --help"),
        (
            ["evaluate", "--model", "RUN", "--env", "pendulum-v1"],
            "unknown environment 'pendulum-v1'; did you mean Pendulum-v1?",
        ),
        (["evaluate", "--model", "RUN", "--env", "PourWater-v0"], "not trained on PourWater-v0"),
        (
            ["evaluate", "--model", "none.zip", "--env", "Pendulum-v1"],
            "there is no model none.zip; give a run's folder such as",
        ),
        (["evaluate", "--model", __file__, "--env", "Pendulum-v1"], "corrupt"),
        (["evaluate", "--model", "RUN", "--env", "Pendulum-v1", "--algo", "tqqc"], "did you mean tqc?"),
        (["evaluate", "--model", "RUN", "--env", "Pendulum-v1", "-n", "0"], "at least 1 episode"),
        (["evaluate", "--model", "expert", "--env", "Pendulum-v1"], "unknown environment with an expert 'Pendulum-v1'"),
        (["evaluate", "--model", "expert", "--env", "FallingBall-v0"], "environment with an expert 'FallingBall-v0'"),
        (["evaluate", "--model", "nothing", "--env", "CartPole-v1"], "has no action that does nothing"),
        (["evaluate", "--model", "RUN", "--env", "no_such_package:E-v0"], "cannot import the package no_such_package"),
        (["evaluate", "--model", "RUN", "--env", "Pendulum-v1", "--seed", "-5"], "--seed: must be a whole number from 0 to"),
        (["plot", "RUN", "-o", "curve.png", "--seed", str(2**32)], "--seed: must be a whole number from 0 to"),
        (["enjoy", "--model", "RUN", "--env", "Pendulum-v1", "-o", "video.gif", "--size", "0"], "at least 1 pixel"),
        (["enjoy", "--model", "RUN", "--env", "Pendulum-v1", "-o", "video.avi"], "must end in .gif or .mp4"),
        (["enjoy", "--model", "RUN", "--env", "Pendulum-v1", "-o", "/proc/video.gif"], "cannot write in /proc"),
        (["plot", "nowhere", "-o", "curve.png"], "there is no folder nowhere"),
        (["report", "nowhere", "-o", "page"], "there is no folder nowhere"),
        (["report", "none.csv", "-o", "page"], "cannot read none.csv"),
        (["plot", "RUN", "-o", "curve.txt"], "must end in .png or .pdf or .svg"),
        (["plot", "RUN", "-o", "curve.png", "--kind", "curves"], "invalid choice: 'curves'"),
        (["plot", "RUN", "-o", "curve.png", "--kind", "ratio"], "no two algorithms that learn from images"),
        (["plot", "RUN", "-o", "curve.png", "--kind", "order"], "no run has logged a POR loss"),
        (["plot", "RUN", "-o", "curve.png", "--kind", "order", "--step", "9"], "--kind order shows all of training"),
        (["plot", "RUN", "-o", "curve.png", "--step", "500"], "no run was evaluated at step 500"),
        (["diagnose", "RUN", "--model", "RUN", "--env", "Pendulum-v1"], "give --model and --env, or folders of runs"),
        (["evaluate", "--model", "RUN", "--env", "Own-v0"], "one of your own needs its module, --env MODULE:Own-v0"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments, message, run, capsys):
    assert main([str(run) if argument == "RUN" else argument for argument in arguments]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    (error,) = [line for line in shown.err.splitlines() if not line.startswith("note: ")]
    assert error.startswith("python -m sb3_por: error: ") and message in error


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_an_example(name, capsys):
    with pytest.raises(SystemExit) as exit:
        main([name, "--help"])
    assert exit.value.code == 0
    assert f"example: python -m sb3_por {name}" in " ".join(capsys.readouterr().out.split())
