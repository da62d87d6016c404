"""Scores are read whole or refused; curves show the interquartile mean with reproducible intervals."""

import time

import numpy as np
import pandas as pd
import pytest
import yaml

from sb3_por.errors import UserError
from sb3_por.plots import draw_curves, iqm, learning_curves, plot
from sb3_por.scores import COLUMNS, read_csv, read_run, read_scores, write_csv

STEPS = [100, 200, 300]


def write_run(folder, algo="sac_por", env="PourWater-v0", seed=1, performance=(0.1, 0.2, 0.4), steps=STEPS, settings=True):
    """A run folder as train.py leaves it, two episodes an evaluation."""
    run = folder / algo / f"{env}_{seed}"
    (run / env).mkdir(parents=True)
    if settings:
        (run / env / "args.yml").write_text(yaml.safe_dump({"algo": algo, "env": env, "seed": seed, "commit": "abc"}))
    episodes = np.array(performance)[:, None] + np.array([-0.05, 0.05])
    np.savez(
        run / "evaluations.npz",
        timesteps=steps,
        results=episodes * 100,
        ep_lengths=np.full(episodes.shape, 100),
        successes=episodes > 0.3,
        normalized_performance=episodes,
        wall_clock_s=np.array(steps) / 10,
    )
    return run


def table(algo, env, seed, performance, steps=STEPS):
    return pd.DataFrame(
        {"env": env, "algo": algo, "seed": seed, "step": steps, "normalized_performance": performance, "commit": ""},
        columns=COLUMNS,
    )


def test_a_run_becomes_rows(tmp_path):
    rows = read_run(write_run(tmp_path, seed=7))
    assert list(rows.columns) == COLUMNS
    assert rows["step"].tolist() == STEPS and set(rows["seed"]) == {7} and set(rows["commit"]) == {"abc"}
    assert rows["normalized_performance"].tolist() == pytest.approx([0.1, 0.2, 0.4])
    assert rows["return"].tolist() == pytest.approx([10.0, 20.0, 40.0])
    assert rows["success"].tolist() == [0.0, 0.0, 1.0]
    assert rows["wall_clock_s"].tolist() == [10.0, 20.0, 30.0]


def test_runs_are_found_at_any_depth_and_named_by_their_path_where_settings_lack(tmp_path):
    write_run(tmp_path / "deep" / "er", algo="sac", seed=3, settings=False)
    write_run(tmp_path, algo="sac_por", seed=1)
    scores = read_scores([tmp_path])
    assert scores[["env", "algo", "seed"]].drop_duplicates().values.tolist() == [
        ["PourWater-v0", "sac", 3],
        ["PourWater-v0", "sac_por", 1],
    ]


def test_evaluations_of_sb3_itself_have_no_normalized_performance(tmp_path):
    run = tmp_path / "ppo" / "Pendulum-v1_2"
    run.mkdir(parents=True)
    np.savez(run / "evaluations.npz", timesteps=[10], results=[[-1.0, -3.0]], ep_lengths=[[5, 5]])
    scores = read_scores([run])
    assert scores["return"].tolist() == [-2.0] and scores["normalized_performance"].isna().all()
    with pytest.raises(UserError, match=r"no normalized_performance is recorded; there is return \(--metric\)"):
        plot(scores, tmp_path / "curve.png")
    plot(scores, tmp_path / "curve.png", metric="return")


def test_a_table_written_and_read_is_the_same_table(tmp_path):
    write_run(tmp_path, seed=1)
    write_run(tmp_path, algo="sac", seed=2, performance=(0.0, np.nan, 1 / 3))
    scores = read_scores([tmp_path])
    write_csv(scores, tmp_path / "scores.csv")
    assert (tmp_path / "scores.csv").read_text().splitlines()[0] == ",".join(COLUMNS)
    pd.testing.assert_frame_equal(read_csv(tmp_path / "scores.csv"), scores)
    pd.testing.assert_frame_equal(read_scores([tmp_path / "scores.csv"]), scores)


def test_bad_scores_are_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "evaluations.npz").write_bytes(b"PK nonsense")
    (tmp_path / "column.csv").write_text("env,algo\na,b\n")
    (tmp_path / "words.csv").write_text("env,algo,seed,step\na,b,one,2\n")
    write_run(tmp_path / "once", seed=1)
    write_run(tmp_path / "twice", seed=1)
    for paths, message in {
        ("nowhere",): "there is no folder",
        ("empty",): "no run under",
        ("broken",): "cannot read",
        ("column.csv",): "has no column seed, step",
        ("words.csv",): "column seed must hold integers",
        ("missing.csv",): "cannot read",
        ("once", "twice"): "two runs of sac_por on PourWater-v0 with seed 1",
    }.items():
        with pytest.raises(UserError, match=message) as error:
            read_scores([tmp_path / path for path in paths])
        assert "\n" not in str(error.value)


def test_iqm_is_the_mean_of_the_middle_half():
    rng = np.random.default_rng(0)
    scores = rng.normal(size=(4, 2, 3))
    for i in range(3):
        ordered = sorted(scores[:, :, i].ravel())
        assert iqm(scores)[i] == pytest.approx(np.mean(ordered[2:6]))


def test_curve_and_interval_of_several_seeds():
    rng = np.random.default_rng(0)
    scores = pd.concat([table("a", "T", seed, rng.uniform(size=3)) for seed in range(8)])
    curves, notes = learning_curves(scores)
    curve = curves["a"]
    assert curve.steps.tolist() == STEPS and curve.n_seeds == 8 and curve.envs == ("T",) and not notes
    matrix = scores["normalized_performance"].to_numpy(float).reshape(8, 1, 3)
    assert curve.iqm == pytest.approx(iqm(matrix))
    assert (curve.low < curve.iqm).all() and (curve.iqm < curve.high).all()
    # An own bootstrap of the same statistic has the same interval, up to sampling.
    drawn = np.array([iqm(matrix[rng.integers(8, size=8)]) for _ in range(4000)])
    assert curve.low == pytest.approx(np.percentile(drawn, 2.5, axis=0), abs=0.03)
    assert curve.high == pytest.approx(np.percentile(drawn, 97.5, axis=0), abs=0.03)


def test_intervals_are_reproducible_and_leave_numpys_generator_alone():
    rng = np.random.default_rng(1)
    scores = pd.concat([table("a", "T", seed, rng.uniform(size=3)) for seed in range(12)])
    np.random.seed(5)
    before = np.random.get_state()[1].copy()
    first, again, other = (learning_curves(scores, seed=seed)[0]["a"] for seed in (0, 0, 1))
    assert np.array_equal(first.low, again.low) and not np.array_equal(first.low, other.low)
    assert np.array_equal(before, np.random.get_state()[1])


def test_unequal_lengths_missing_seeds_and_nan_are_handled_and_said():
    scores = pd.concat(
        [
            table("a", "T", 1, [0.1, 0.2, 0.3]),
            table("a", "T", 2, [0.1, 0.2, 0.3, 0.4], steps=[*STEPS, 400]),
            table("a", "T", 3, [0.2, np.nan, 0.4]),
            table("a", "U", 1, [0.5, 0.5, 0.5]),
            table("a", "U", 2, [0.5, 0.5, 0.5]),
        ]
    )
    curves, notes = learning_curves(scores)
    assert curves["a"].steps.tolist() == STEPS and curves["a"].n_seeds == 2 and curves["a"].envs == ("T", "U")
    assert curves["a"].iqm == pytest.approx([0.3, 0.35, 0.4])
    text = "\n".join(notes)
    assert "1 of 16 evaluations have no normalized_performance" in text
    assert "3 seeds on T but 2 elsewhere" in text
    assert "ends with the shortest, at step 300" in text


def test_evaluations_at_different_steps_are_interpolated():
    scores = pd.concat(
        [table("a", "T", 1, [0.0, 0.4], steps=[0, 200]), table("a", "T", 2, [0.0, 0.1, 0.4], steps=[0, 100, 200])]
    )
    curve = learning_curves(scores)[0]["a"]
    assert curve.steps.tolist() == [0, 100, 200]
    assert curve.iqm == pytest.approx([0.0, 0.15, 0.4])
    apart = pd.concat([table("a", "T", 1, [0.1], steps=[10]), table("a", "T", 2, [0.1], steps=[20])])
    with pytest.raises(UserError, match="no step in common"):
        learning_curves(apart)


def test_the_figure_says_what_it_shows():
    rng = np.random.default_rng(0)
    scores = pd.concat(
        [table(algo, "PourWater-v0", seed, rng.uniform(size=3)) for algo in ("sac", "sac_por") for seed in range(3)]
    )
    axes = draw_curves(learning_curves(scores)[0]).axes[0]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["sac (3 seeds)", "sac_por (3 seeds)"]
    assert axes.get_xlabel() == "environment steps" and axes.get_ylabel() == "normalized performance"
    assert "PourWater-v0" in axes.get_title("left") and "95 %" in axes.get_title("left")
    looks = {(line.get_color(), line.get_linestyle()) for line in axes.get_lines()}
    assert len(looks) == 2
    single = draw_curves(learning_curves(scores[scores["seed"] == 0])[0]).axes[0]
    assert "one seed, no interval" in single.get_title("left")


@pytest.mark.parametrize("suffix", ["png", "pdf", "svg"])
def test_figures_are_the_same_byte_for_byte(suffix, tmp_path):
    scores = pd.concat([table("a", "T", seed, [0.1, 0.2, seed / 10]) for seed in range(3)])
    contents = []
    for name in ("first", "second"):
        plot(scores, tmp_path / f"{name}.{suffix}")
        contents.append((tmp_path / f"{name}.{suffix}").read_bytes())
    assert contents[0] == contents[1] and len(contents[0]) > 1000
    assert sorted(path.stem for path in tmp_path.iterdir()) == ["first", "second"]


def test_figures_of_unknown_format_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"must end in \.png or \.pdf or \.svg"):
        plot(table("a", "T", 1, [0.1, 0.2, 0.3]), tmp_path / "curve.bmp")


def test_a_grid_of_five_algorithms_four_tasks_five_seeds_is_quick():
    rng = np.random.default_rng(0)
    steps = list(range(0, 50_000, 1000))
    scores = pd.concat(
        [
            table(f"algo{a}", f"Task{t}", seed, rng.uniform(size=50), steps=steps)
            for a in range(5)
            for t in range(4)
            for seed in range(5)
        ]
    )
    begin = time.perf_counter()
    curves, _ = learning_curves(scores)
    assert len(curves) == 5 and curves["algo0"].iqm.shape == (50,)
    assert time.perf_counter() - begin < 30
