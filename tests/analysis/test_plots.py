"""Figures say what they show, look the same twice, and come with their numbers."""

import time

import numpy as np
import pandas as pd
import pytest
from made_runs import log_order, random_scores, table, write_run
from torch.utils.tensorboard import SummaryWriter

from sb3_por.analysis.figures import KINDS, plot, plot_all, plot_order, save_all
from sb3_por.analysis.plot_style import COLORS, looks
from sb3_por.analysis.por_logs import GRADIENT_METRICS, ORDER_COLUMNS, read_order, write_order
from sb3_por.analysis.scores import read_scores
from sb3_por.common.errors import UserError

NO_ORDER = pd.DataFrame(columns=ORDER_COLUMNS)


def texts(figure):
    return "\n".join(
        [text.get_text() for axes in figure.axes for text in axes.findobj(lambda one: hasattr(one, "get_text"))]
        + [text.get_text() for legend in figure.legends for text in legend.get_texts()]
        + [figure.get_suptitle()]
    )


def test_the_curve_says_what_it_shows():
    scores = random_scores(algos=("sac_por", "sac"), envs=("PourWater-v0",), n_seeds=3)
    axes = plot(scores)[0].figure.axes[0]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["sac_por (3 seeds)", "sac (3 seeds)"]
    assert axes.get_xlabel() == "environment steps" and axes.get_ylabel() == "normalized performance"
    assert "PourWater-v0" in axes.get_title("left") and "95 %" in axes.get_title("left")
    single = plot(scores[scores["seed"] == 0])[0].figure.axes[0]
    assert "one seed, no interval" in single.get_title("left")
    one_against_many = pd.concat([scores[scores["algo"] == "sac"], scores[(scores["algo"] != "sac") & (scores["seed"] == 0)]])
    assert "95 %" in plot(one_against_many, "improvement", reps=50)[0].figure.axes[0].get_title("left")


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("iqm", ["T, U", "sac_por (4 seeds, 2 tasks)", "interquartile mean"]),
        ("tasks", ["T", "U", "sac_drq", "environment steps"]),
        ("aggregates", ["IQM (higher is better)", "optimality gap (lower is better)", "sac_drq", "step 300"]),
        ("profile", ["fraction of runs above τ", "normalized performance τ", "sac (4 seeds, 2 tasks)"]),
        ("improvement", ["sac_por over sac_drq", "probability of improvement at step 300"]),
        ("ratio", ["sac_por : sac_drq", "ratio at step 300"]),
    ],
)
def test_every_figure_says_what_it_shows(kind, words):
    figure = plot(random_scores(), kind, reps=50)[0].figure
    for word in words:
        assert word in texts(figure)


def test_what_is_drawn_is_what_is_in_the_table():
    one = plot(random_scores(), "tasks")[0]
    drawn = {line.get_label(): line.get_ydata() for line in one.figure.axes[1].get_lines()}
    for algo, rows in one.table[one.table["env"] == "U"].groupby("algo"):
        assert drawn[algo] == pytest.approx(rows["mean"].to_numpy())


def test_an_algorithm_looks_the_same_beside_any_others_and_unlike_them():
    others = [f"other{i}" for i in range(56)]
    many = looks([*COLORS, *others])
    assert len(set(many.values())) == len(many)
    assert looks(reversed([*COLORS, *others])) == many
    assert all(looks([name, "ppo"])[name] == many[name] for name in COLORS)
    alone = {name: looks([name])[name] for name in others}
    assert looks(["por_10", "a2c", "my_variant"])["por_10"] == looks(["por_10"])["por_10"]
    same = next([a, b] for a in others for b in others if a < b and alone[a] == alone[b])
    assert looks(same)[same[0]] == alone[same[0]] != looks(same)[same[1]]
    assert len(looks(map(str, range(100)))) == 100


@pytest.mark.parametrize("suffix", ["png", "pdf", "svg", "csv"])
def test_figures_are_the_same_byte_for_byte(suffix, tmp_path):
    scores = pd.concat([table("a", "T", seed, [0.1, 0.2, seed / 10]) for seed in range(3)])
    contents = []
    for name in ("first", "second"):
        plot(scores, reps=100)[0].save(tmp_path / f"{name}.{suffix}")
        contents.append((tmp_path / f"{name}.{suffix}").read_bytes())
    assert contents[0] == contents[1] and len(contents[0]) > 100
    assert sorted(path.stem for path in tmp_path.iterdir()) == ["first", "second"]


def test_figures_of_unknown_format_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"must end in \.png or \.pdf or \.svg or \.csv"):
        plot(table("a", "T", 1, [0.1, 0.2, 0.3]))[0].save(tmp_path / "curve.bmp")


def test_a_figure_of_nothing_is_refused_and_left_out_of_all():
    alone = random_scores(algos=("sac_por",), n_seeds=2)
    for kind, message in {
        "improvement": r"one algorithm only \(sac_por\)",
        "ratio": "no two algorithms that learn from images",
    }.items():
        with pytest.raises(UserError, match=message):
            plot(alone, kind)
    plots, notes = plot_all(alone, NO_ORDER, reps=20)
    assert [one.name for one in plots] == ["iqm", "tasks", "aggregates", "profile"]
    assert any("no probability of improvement" in note for note in notes) and any("no ratio" in note for note in notes)
    short = random_scores(algos=("c",), n_seeds=2)
    short.loc[short["seed"] == 0, "step"] += 10_000
    plots, notes = plot_all(pd.concat([alone, short]), NO_ORDER, reps=20)
    assert "tasks" in [one.name for one in plots]
    assert any(note.startswith("left out: c on ") and "no step in common" in note for note in notes)
    apart = pd.concat([random_scores(algos=("a",), envs=("T",)), random_scores(algos=("b",), envs=("U",))])
    plots, notes = plot_all(apart, NO_ORDER, reps=20)
    assert [one.name for one in plots] == ["iqm", "tasks"]
    assert any(note.startswith("no figure profile: no environment was run with every algorithm") for note in notes)


def test_the_order_is_read_from_runs_and_from_its_table(tmp_path):
    for seed, losses in enumerate([(0.7, 0.6, 0.5), (0.7, 0.4, 0.1)]):
        log_order(write_run(tmp_path, seed=seed) / "tb" / "SACPOR_1", losses)
    other = write_run(tmp_path, algo="sac_curl", seed=0)
    with SummaryWriter(other / "tb" / "SACCURL_1") as writer:
        writer.add_scalar("train/encoder_grad_norm_critic", 1.0, 100)
    order, left_out = read_order([tmp_path])
    assert left_out == [] and set(order["algo"]) == {"sac_por"} and order["step"].tolist() == [100, 200, 300] * 2
    assert order["por_loss"].to_numpy() == pytest.approx([0.7, 0.6, 0.5, 0.7, 0.4, 0.1])
    assert order["por_leak_loss"].isna().all() and order["encoder_grad_cosine"].isna().all()
    assert order["por_coef"].to_numpy() == pytest.approx(2 * order["por_loss"].to_numpy())
    write_order(order, tmp_path / "order.csv")
    write_order(order.assign(por_loss=np.nan), tmp_path / "empty.csv")
    with pytest.raises(UserError, match="the column por_loss is empty"):
        read_order([tmp_path / "empty.csv"])
    pd.testing.assert_frame_equal(read_order([tmp_path / "order.csv"])[0], order)
    one, notes = plot_order(order)
    loss = one.table[one.table["metric"] == "por_loss"]
    assert loss["mean"].to_numpy() == pytest.approx([0.7, 0.5, 0.3]) and not notes
    assert {"POR loss", "POR accuracy", "PourWater-v0", "ln 2", "sac_por"} <= set(texts(one.figure).splitlines())
    gradients = {line.get_label(): line.get_ydata().tolist() for line in one.figure.axes[-1].lines}
    assert gradients["_sac_por"] == [10] * 3 and gradients["sac_por"] == pytest.approx([0.7, 0.5, 0.3])
    drawn = [(line.get_color(), line.get_linestyle(), line.get_alpha()) for line in one.figure.axes[-1].lines]
    assert len(set(drawn)) == len(drawn)
    bare, _ = plot_order(order.drop(columns=GRADIENT_METRICS).reindex(columns=order.columns))
    assert len(bare.figure.axes) == 2


def test_what_a_resumed_run_logs_again_replaces_what_it_had_logged(tmp_path):
    run = write_run(tmp_path)
    log_order(run / "tb" / "SACPOR_1", [0.7, 0.6, 0.5, 0.4])
    log_order(run / "tb" / "SACPOR_1", [0.3, 0.2], first_step=300)
    log_order(run / "tb" / "SACPOR_2", [0.1], first_step=400)
    order, _ = read_order([run])
    assert order["step"].tolist() == [100, 200, 300, 400]
    assert order["por_loss"].to_numpy() == pytest.approx([0.7, 0.6, 0.3, 0.1])


def test_logs_are_found_where_the_runs_settings_point(tmp_path):
    tensorboard = {"log_folder": "logs", "tensorboard_log": "tb"}
    returns = {seed: [10.0 + seed, 20.0, 40.0] for seed in (0, 1)}
    for seed, rewards in returns.items():
        run = write_run(tmp_path / "logs", seed=seed, performance=np.array(rewards) / 100, arguments=tensorboard)
        log_order(tmp_path / "tb" / "PourWater-v0" / f"SACPOR_{seed + 1}", [0.7, 0.6 - 0.1 * seed], returns=rewards)
    log_order(tmp_path / "tb" / "Other-v0" / "SACPOR_1", [0.1], returns=returns[0])
    order, left_out = read_order([tmp_path / "logs"])
    assert left_out == [] and order["seed"].tolist() == [0, 0, 1, 1]
    assert order["por_loss"].to_numpy() == pytest.approx([0.7, 0.6, 0.7, 0.5])

    log_order(tmp_path / "tb" / "PourWater-v0" / "SACPOR_3", [0.3], returns=returns[1])
    order, left_out = read_order([tmp_path / "logs"])
    assert set(order["seed"]) == {0}
    assert len(left_out) == 1 and str(run) in left_out[0] and "several TensorBoard files" in left_out[0]


def test_runs_without_an_order_are_said(tmp_path):
    plain, lost = write_run(tmp_path, algo="sac"), write_run(tmp_path, arguments={"tensorboard_log": "/tmp/lost"})
    order, left_out = read_order([plain, lost])
    assert order.empty
    assert left_out == [f"POR's logs: {lost} is left out: no TensorBoard file in /tmp/lost/PourWater-v0 has its evaluations"]
    with pytest.raises(UserError, match="no run has logged a POR loss"):
        plot_order(order)
    assert any(
        note.startswith("no figure order: no run has logged") for note in plot_all(read_scores([plain]), order, reps=20)[1]
    )
    (tmp_path / "scores.csv").write_text("env,algo,seed,step\n")
    with pytest.raises(UserError, match="has no column por_loss"):
        read_order([tmp_path / "scores.csv"])


def test_a_grid_of_five_algorithms_four_tasks_five_seeds_is_quick(tmp_path):
    scores = random_scores(algos="abcde", envs="TUVW", n_seeds=5, steps=list(range(0, 50_000, 1000)))
    begin = time.perf_counter()
    one, _ = plot(scores)
    one.save(tmp_path / "curve.pdf")
    assert time.perf_counter() - begin < 30
    assert len(one.table) == 5 * 50


def test_all_figures_are_saved_in_all_formats_under_their_names(tmp_path):
    plots, _ = plot_all(random_scores(n_seeds=2), NO_ORDER, reps=20)
    save_all(plots, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {f"{kind}.{end}" for kind in KINDS for end in ("png", "pdf", "csv")}
    assert np.allclose(pd.read_csv(tmp_path / "iqm.csv")["iqm"], plots[0].table["iqm"], atol=1e-6)
