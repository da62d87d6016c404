"""Scores are read whole or refused."""

import numpy as np
import pandas as pd
import pytest
import yaml
from made_runs import STEPS, write_run

from sb3_por.analysis.figures import plot
from sb3_por.analysis.learning_curves import read_grid
from sb3_por.analysis.report import write_report
from sb3_por.analysis.scores import COLUMNS, read_csv, read_run, read_scores, write_csv
from sb3_por.common.errors import UserError


def test_a_run_becomes_rows(tmp_path):
    rows = read_run(write_run(tmp_path, seed=7))
    assert list(rows.columns) == COLUMNS
    assert rows["step"].tolist() == STEPS and set(rows["seed"]) == {7} and set(rows["commit"]) == {"abc"}
    assert rows["normalized_performance"].tolist() == pytest.approx([0.1, 0.2, 0.4])
    assert rows["return"].tolist() == pytest.approx([10.0, 20.0, 40.0])
    assert rows["success"].tolist() == [0.0, 0.0, 1.0]
    assert rows["wall_clock_s"].tolist() == [10.0, 20.0, 30.0]


def test_a_labelled_run_goes_by_its_label(tmp_path):
    write_run(tmp_path, algo="sac_por", label="por_paper")
    write_run(tmp_path / "plain", algo="sac_por")
    assert set(read_scores([tmp_path])["algo"]) == {"sac_por", "por_paper"}


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
        plot(scores)
    assert plot(scores, metric="return")[0].table["iqm"].tolist() == [-2.0]


def test_a_table_written_and_read_is_the_same_table(tmp_path):
    write_run(tmp_path, seed=1)
    write_run(tmp_path, algo="sac", seed=2, performance=(0.0, np.nan, 0.027327462838349127))
    scores = read_scores([tmp_path])
    write_csv(scores, tmp_path / "scores.csv")
    assert (tmp_path / "scores.csv").read_text().splitlines()[0] == ",".join(COLUMNS)
    pd.testing.assert_frame_equal(read_csv(tmp_path / "scores.csv"), scores, check_exact=True)
    pd.testing.assert_frame_equal(read_scores([tmp_path / "scores.csv"]), scores)


def test_any_label_is_a_name(tmp_path):
    for seed, label in enumerate(["None", "NA", "nan", 2]):
        write_run(tmp_path / str(seed), seed=seed, label=label)
    scores = read_scores([tmp_path])
    assert set(scores["algo"]) == {"None", "NA", "nan", "2"}
    write_csv(scores, tmp_path / "scores.CSV")
    pd.testing.assert_frame_equal(read_scores([tmp_path / "scores.CSV"]), scores)
    assert read_grid(scores).algos == sorted(set(scores["algo"]))


def test_bad_scores_are_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "evaluations.npz").write_bytes(b"PK nonsense")
    cut_off = write_run(tmp_path / "cut") / "evaluations.npz"
    cut_off.write_bytes(cut_off.read_bytes()[:500])
    (tmp_path / "column.csv").write_text("env,algo\na,b\n")
    (tmp_path / "nameless.csv").write_text("env,algo,seed,step\na,,1,2\n")
    (tmp_path / "header.csv").write_text("env,algo,seed,step\n")
    (tmp_path / "words.csv").write_text("env,algo,seed,step\na,b,one,2\n")
    write_run(tmp_path / "once", seed=1)
    write_run(tmp_path / "twice", seed=1)
    for paths, message in {
        ("nowhere",): "there is no folder",
        ("empty",): "no run under",
        ("broken",): "cannot read",
        ("cut",): "cannot read",
        ("column.csv",): "has no column seed, step",
        ("nameless.csv",): "a row has no algo",
        ("header.csv",): "holds no scores",
        ("words.csv",): "column seed must hold integers",
        ("missing.csv",): "cannot read",
        ("once", "twice"): "two runs of sac_por on PourWater-v0 with seed 1: .*once.* and .*twice",
    }.items():
        with pytest.raises(UserError, match=message) as error:
            read_scores([tmp_path / path for path in paths])
        assert "\n" not in str(error.value)


def test_two_runs_with_one_seed_are_refused_even_if_no_step_is_in_both(tmp_path):
    write_run(tmp_path / "once", seed=1)
    write_run(tmp_path / "twice", seed=1, steps=[150, 250, 350])
    with pytest.raises(UserError, match="two runs of sac_por on PourWater-v0 with seed 1"):
        read_scores([tmp_path])


def test_seeds_of_one_algorithm_with_other_settings_are_noted(tmp_path, recwarn):
    for seed, pairing in ((1, "swap"), (2, "swap"), (3, "paper")):
        run = write_run(tmp_path, seed=seed)
        settings = {"pairing": pairing, "gamma": 0.9, "n_timesteps": 100 * seed}
        (run / "PourWater-v0" / "config.yml").write_text(yaml.safe_dump(settings))
    read_scores([tmp_path / "sac_por" / "PourWater-v0_1", tmp_path / "sac_por" / "PourWater-v0_2"])
    assert not recwarn.list
    read_scores([tmp_path])
    (note,) = recwarn.list
    assert "the runs of sac_por on PourWater-v0 count as its seeds, and differ in pairing: label" in str(note.message)
    page = write_report([tmp_path], tmp_path / "report", videos=False).read_text()
    assert "differ in pairing" in page


def test_steps_of_different_lengths_are_noted(tmp_path, recwarn):
    for algo, repeat in (("sac", 1), ("sac_por", 10), ("sac_drq", 10)):
        run = write_run(tmp_path, algo=algo)
        wrapper = {"softbody_envs.wrappers.ActionRepeat": {"repeat": repeat}}
        (run / "PourWater-v0" / "config.yml").write_text(yaml.safe_dump({"env_wrapper": [wrapper]}))
    read_scores([tmp_path / "sac_por", tmp_path / "sac_drq"])
    assert not recwarn.list
    read_scores([tmp_path])
    (note,) = recwarn.list
    assert "on PourWater-v0 an agent's step is not the same number of control steps (1 of sac, 10 of sac_" in str(note.message)
