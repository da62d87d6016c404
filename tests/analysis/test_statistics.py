"""Intervals are those of rliable and reproducible; what cannot be compared is left out, and that is said."""

import time

import numpy as np
import pandas as pd
import pytest
from made_runs import STEPS, random_scores, table
from rliable import library as rly
from rliable import metrics

from sb3_por.analysis.learning_curves import read_grid
from sb3_por.analysis.por_logs import ORDER_COLUMNS
from sb3_por.analysis.statistics import (
    aggregates,
    improvements,
    iqm,
    iqm_curves,
    order_curves,
    performance_profiles,
    probability_of_improvement,
    ratios,
    task_curves,
)
from sb3_por.common.errors import UserError


def at_the_end(scores, algo):
    """``(seeds, environments)`` at the last step."""
    rows = scores[(scores["algo"] == algo) & (scores["step"] == scores["step"].max())]
    return rows.pivot(index="seed", columns="env", values="normalized_performance").to_numpy(float)


def test_iqm_is_the_mean_of_the_middle_half():
    rng = np.random.default_rng(0)
    scores = rng.normal(size=(4, 2, 3))
    for i in range(3):
        ordered = sorted(scores[:, :, i].ravel())
        assert iqm(scores)[i] == pytest.approx(np.mean(ordered[2:6]))


def test_curve_and_interval_of_several_seeds():
    rng = np.random.default_rng(0)
    scores = pd.concat([table("a", "T", seed, rng.uniform(size=3)) for seed in range(8)])
    grid = read_grid(scores)
    curve = iqm_curves(grid)
    assert curve["step"].tolist() == STEPS and set(curve["seeds"]) == {8} and set(curve["tasks"]) == {1} and not grid.notes
    matrix = scores["normalized_performance"].to_numpy(float).reshape(8, 1, 3)
    assert curve["iqm"].to_numpy() == pytest.approx(iqm(matrix))
    assert (curve["low"] < curve["iqm"]).all() and (curve["iqm"] < curve["high"]).all()
    # An own bootstrap of the same statistic has the same interval, up to sampling.
    drawn = np.array([iqm(matrix[rng.integers(8, size=8)]) for _ in range(4000)])
    assert curve["low"].to_numpy() == pytest.approx(np.percentile(drawn, 2.5, axis=0), abs=0.03)
    assert curve["high"].to_numpy() == pytest.approx(np.percentile(drawn, 97.5, axis=0), abs=0.03)


@pytest.mark.parametrize("measure", [iqm_curves, aggregates, performance_profiles, improvements, ratios])
def test_intervals_are_reproducible_and_leave_numpys_generator_alone(measure):
    grid = read_grid(random_scores())
    np.random.seed(5)
    before = np.random.get_state()[1].copy()
    first, again, other = (measure(grid, reps=200, seed=seed) for seed in (0, 0, 1))
    pd.testing.assert_frame_equal(first, again)
    assert not first.equals(other)
    assert np.array_equal(before, np.random.get_state()[1])


def test_unequal_lengths_missing_seeds_and_nan_are_handled_and_said():
    scores = pd.concat(
        [
            table("a", "T", 1, [0.1, 0.2, 0.3]),
            table("a", "T", 2, [0.1, 0.2, 0.3, 0.4], steps=[*STEPS, 400]),
            table("a", "T", 3, [0.2, np.nan, 0.4]),
            table("a", "T", 4, [np.nan, np.nan, np.inf]),
            table("a", "U", 1, [0.5, 0.5, 0.5]),
            table("a", "U", 2, [0.5, 0.5, 0.5]),
        ]
    )
    grid = read_grid(scores)
    curve = iqm_curves(grid)
    assert curve["step"].tolist() == STEPS and set(curve["seeds"]) == {2} and set(curve["envs"]) == {"T U"}
    assert curve["iqm"].tolist() == pytest.approx([0.3, 0.35, 0.4])
    text = "\n".join(grid.notes)
    assert "4 of 19 evaluations have no normalized_performance" in text
    assert "a on T, seed 4: no normalized_performance at all" in text
    assert "3 seeds on T but 2 elsewhere" in text
    assert "ends with the shortest at step 300 (a on T, seed 1)" in text


def test_each_task_has_its_own_seeds_and_length():
    scores = pd.concat(
        [table("a", "T", 1, [0.1, 0.2, 0.3]), table("a", "T", 2, [0.3, 0.6, 0.5]), table("a", "U", 1, [0, 0, 1])]
    )
    scores = pd.concat([scores, table("b", "U", 1, [1, 1], steps=[100, 200])])
    grid = read_grid(scores)
    curves = task_curves(grid).set_index(["env", "algo"])
    assert curves.loc[("T", "a"), "mean"].tolist() == pytest.approx([0.2, 0.4, 0.4])
    assert curves.loc[("T", "a"), "std"].tolist() == pytest.approx([0.1, 0.2, 0.1])
    assert curves.loc[("U", "a"), "step"].tolist() == STEPS and curves.loc[("U", "b"), "step"].tolist() == [100, 200]
    assert "b was not run on T" in grid.notes


def test_evaluations_at_different_steps_are_interpolated():
    scores = pd.concat(
        [table("a", "T", 1, [0.0, 0.4], steps=[0, 200]), table("a", "T", 2, [0.0, 0.1, 0.4], steps=[0, 100, 200])]
    )
    curve = iqm_curves(read_grid(scores))
    assert curve["step"].tolist() == [0, 100, 200]
    assert curve["iqm"].tolist() == pytest.approx([0.0, 0.15, 0.4])
    apart = pd.concat([table("a", "T", 1, [0.1], steps=[10]), table("a", "T", 2, [0.1], steps=[20])])
    with pytest.raises(UserError, match="no step in common: a on T, seed 2 begins at 20, a on T, seed 1 ends at 10"):
        iqm_curves(read_grid(apart))


def test_a_seed_that_is_left_out_does_not_decide_the_step():
    scores = pd.concat(
        [table("a", env, seed, [0.0, 0.5, 1.0]) for env in "TU" for seed in (0, 1)] + [table("a", "T", 2, [0.0], steps=[100])]
    )
    grid = read_grid(scores)
    step, matrices = grid.last()
    assert step == 300 and matrices["a"].tolist() == [[1.0, 1.0]] * 2
    assert grid.notes == ["a: 3 seeds on T but 2 elsewhere, so the first 2 are used"]


def test_means_over_other_tasks_and_single_seeds_are_noted():
    grid = read_grid(
        pd.concat([table("a", "T", seed, [0.1, 0.2, 0.3]) for seed in (1, 2)] + [table("b", "U", 1, [0.1, 0.2, 0.3])])
    )
    iqm_curves(grid)
    assert grid.notes == [
        "one seed of b: how far its seeds differ is not known, and no interval includes it",
        "the algorithms were not run on the same tasks, so their means are of different ones; see --kind tasks",
    ]


def test_a_step_leaves_out_the_runs_that_end_before_it():
    scores = pd.concat([table("a", "T", 1, [0.0, 0.2, 0.4]), table("a", "T", 2, [0.5], steps=[100])])
    assert iqm_curves(read_grid(scores))["step"].tolist() == [100]
    grid = read_grid(scores, step=250)
    curve = iqm_curves(grid)
    assert curve["step"].tolist() == [100, 200, 250] and curve["iqm"].tolist() == pytest.approx([0.0, 0.2, 0.3])
    assert grid.notes == [
        "a on T, seed 2: evaluated from step 100 to 100, not at 250, so it is left out",
        "one seed of a: how far its seeds differ is not known, and no interval includes it",
    ]
    with pytest.raises(UserError, match="no run was evaluated at step 500; the last evaluation is at step 300"):
        read_grid(scores, step=500)


def test_aggregates_are_those_of_rliable():
    scores = random_scores()
    table_ = aggregates(read_grid(scores)).set_index(["algo", "statistic"])
    assert set(table_["step"]) == {300} and set(table_["seeds"]) == {4} and set(table_["tasks"]) == {2}
    assert (table_["low"] < table_["value"]).all() and (table_["value"] < table_["high"]).all()
    for algo in ("sac_por", "sac_drq", "sac"):
        matrix = at_the_end(scores, algo)
        assert table_.loc[(algo, "IQM"), "value"] == pytest.approx(metrics.aggregate_iqm(matrix))
        assert table_.loc[(algo, "mean"), "value"] == pytest.approx(metrics.aggregate_mean(matrix))
        assert table_.loc[(algo, "optimality gap"), "value"] == pytest.approx(metrics.aggregate_optimality_gap(matrix))


def test_returns_have_no_optimality_gap():
    scores = random_scores()
    scores["return"] = 50 * scores["normalized_performance"] - 100
    assert set(aggregates(read_grid(scores, "return"), reps=10)["statistic"]) == {"IQM", "mean"}
    thresholds = performance_profiles(read_grid(scores, "return"), reps=10)["threshold"]
    assert thresholds.min() < -60 and thresholds.max() < 0


def test_profiles_are_those_of_rliable():
    scores = random_scores()
    scores.loc[scores["seed"] == 0, "normalized_performance"] = 0.5  # a threshold: not above itself
    profiles = performance_profiles(read_grid(scores), reps=200)
    for algo, rows in profiles.groupby("algo"):
        expected = rly.score_distributions(at_the_end(scores, algo), rows["threshold"].to_numpy())
        assert rows["fraction"].to_numpy() == pytest.approx(expected)
        assert (rows["low"] <= rows["fraction"]).all() and (rows["fraction"] <= rows["high"]).all()
        assert (rows["high"] - rows["low"]).max() > 0.2


def test_probability_of_improvement_is_that_of_rliable_draws_included():
    rng = np.random.default_rng(0)
    x, y = rng.integers(5, size=(4, 3)), rng.integers(5, size=(6, 3))
    assert probability_of_improvement(x, y) == pytest.approx(metrics.probability_of_improvement(x, y))
    assert probability_of_improvement(x, x) == pytest.approx(0.5)


def test_improvements_compare_each_pair_once_with_por_first():
    scores = random_scores()
    table_ = improvements(read_grid(scores))
    assert table_[["algo", "rival"]].values.tolist() == [["sac_por", "sac_drq"], ["sac_por", "sac"], ["sac_drq", "sac"]]
    expected = metrics.probability_of_improvement(at_the_end(scores, "sac_por"), at_the_end(scores, "sac_drq"))
    row = table_.iloc[0]
    assert row["probability"] == pytest.approx(expected) and 0 < row["low"] < expected < row["high"] <= 1
    grid = read_grid(scores[scores["algo"] == "sac"])
    assert improvements(grid).empty and "one algorithm only (sac)" in grid.notes[0]


def test_comparisons_are_over_the_environments_that_all_were_run_on():
    scores = random_scores(algos=("a", "b"))
    grid = read_grid(scores[(scores["algo"] == "a") | (scores["env"] == "T")])
    assert set(aggregates(grid, reps=10)["tasks"]) == {1}
    assert grid.notes == ["U was not run with b, so comparisons of all algorithms leave it out"]
    apart = scores[(scores["algo"] == "a") == (scores["env"] == "T")]
    with pytest.raises(UserError, match="no environment was run with every algorithm"):
        aggregates(read_grid(apart))


def test_ratio_to_the_best_rival():
    ends = {"sac_por": [0.6, 0.8], "sac_drq": [0.5, 0.5], "sac_curl": [0.3, 0.1], "sac": [1.0, 1.0]}
    scores = pd.concat([table(algo, "T", s, [0, 0, end]) for algo, both in ends.items() for s, end in enumerate(both)])
    grid = read_grid(scores)
    table_ = ratios(grid).set_index("algo")
    assert table_["rival"].to_dict() == {"sac_por": "sac_drq", "sac_curl": "sac_por", "sac_drq": "sac_por"}
    assert table_["ratio"].to_dict() == pytest.approx({"sac_por": 1.4, "sac_curl": 0.2 / 0.7, "sac_drq": 0.5 / 0.7})
    # Two seeds: a quarter of the samples each is the lower one twice, and the higher one twice.
    assert table_.loc["sac_por", ["low", "high"]].tolist() == pytest.approx([1.2, 1.6])
    assert grid.notes == ["sac observes the state, so the ratios leave it out"]
    early = ratios(read_grid(scores, step=150)).set_index("algo")
    assert early["ratio"].isna().all(), "0 / 0 at the beginning"


def test_a_ratio_to_a_rival_at_zero_is_infinite_and_that_is_said():
    scores = pd.concat([table("a", "T", s, [0, 0, 0.5]) for s in (0, 1)] + [table("b", "T", s, [0, 0, 0]) for s in (0, 1)])
    grid = read_grid(scores)
    assert ratios(grid).set_index("algo")["ratio"].to_dict() == {"a": np.inf, "b": 0.0}
    assert grid.notes == ["T: rivals of a score 0 or less, at least in some samples, where no ratio is finite"]


def test_order_curves_have_each_metric_where_it_was_logged():
    runs = [table("sac_por", "T", seed, np.nan).drop(columns="normalized_performance") for seed in (0, 1)]
    order = pd.concat(runs).reindex(columns=ORDER_COLUMNS)
    order = order.assign(por_loss=[0.7, 0.6, 0.5, 0.7, 0.4, 0.1], por_accuracy=0.8, por_leak_accuracy=np.nan)
    order["por_leak_loss"] = [np.nan, 0.6, 0.7, np.nan, 0.7, 0.7]
    curves, notes = order_curves(order)
    loss, leak = (curves[curves["metric"] == name] for name in ("por_loss", "por_leak_loss"))
    assert loss["mean"].tolist() == pytest.approx([0.7, 0.5, 0.3]) and loss["std"].tolist() == pytest.approx([0, 0.1, 0.2])
    assert leak["step"].tolist() == [200, 300] and set(curves["metric"]) == {"por_loss", "por_accuracy", "por_leak_loss"}
    assert notes == []
    assert order_curves(pd.concat([order[order["seed"] == 0], order[order["seed"] == 1].iloc[:2]]))[1][0] == (
        "POR's logs: sac_por on T: the runs differ in length, so it ends with the shortest at step 200 (sac_por on T, seed 1)"
    )


def test_an_iqm_of_five_tasks_five_seeds_fifty_evaluations_is_quick():
    scores = random_scores(algos=("a",), envs="TUVWX", n_seeds=5, steps=list(range(50)))
    begin = time.perf_counter()
    iqm_curves(read_grid(scores), reps=2000)
    assert time.perf_counter() - begin < 5
