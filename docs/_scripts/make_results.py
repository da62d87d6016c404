"""
Fill in the tables of the pages in PAGES from results/ and docstrings, and draw their figures.

    python docs/_scripts/make_results.py              tables only
    python docs/_scripts/make_results.py --figures    and the figures

A table stands between `<!-- table: NAME -->` and `<!-- end -->`; ``TABLES`` maps its name to a function.
"""

import argparse
import inspect
import re
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats
from scipy.integrate import trapezoid
from stable_baselines3 import SAC

from sb3_por.analysis.figures import plot, plot_order
from sb3_por.analysis.por_logs import read_order
from sb3_por.analysis.scores import read_scores
from sb3_por.ranking import RankedProgress
from sb3_por.visual.encoders import ConvEncoder
from sb3_por.visual.sac import VisualSAC
from softbody_envs.env import SoftbodyEnv
from softbody_envs.wrappers import ActionRepeat, Distraction, ProgressReward, ShowQuantity, SuccessReward

DOCS = Path(__file__).parents[1]
RESULTS = DOCS.parent / "results"
#: Algorithms with a page, a curve and scores.
ALGOS = ("sac_por", "sac_drq", "sac_curl", "sac_spr", "sac")
PAGES = (
    "results.md",
    "algorithms.md",
    "usage.md",
    "tasks/README.md",
    "lab/full_speed.md",
    "lab/trials.md",
    "por.md",
    "reliability.md",
    "algorithms/tqc_por.md",
    "algorithms/sac_mrq.md",
    *(f"algorithms/{algo}.md" for algo in ALGOS),
)
METRIC = "normalized_performance"
#: POR's rivals from pixels in the paper.
RIVALS = ("sac_drq", "sac_curl", "sac_spr")
#: Task -> target mean score of SAC on the state, and the steps to reach it in.
WANTED = {
    "PourWater-v0": (0.8, 100_000),
    "PourWaterAmount-v0": (0.7, 100_000),
    "StraightenRope-v0": (0.85, 150_000),
    "FoldCloth-v0": (0.6, 300_000),
    "DropFoldCloth-v0": (0.5, 300_000),
}

#: Correlations in a table of diagnoses -> their titles. Tables from before the controls have the first alone.
CORRELATIONS = {
    "correlation": "correlation",
    "clock_correlation": "of the clock",
    "partial_correlation": "given time",
    "equal_time_correlation": "at equal time",
}


def markdown(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Format a table in Markdown."""
    lines = [tuple(head), *map(tuple, rows)]
    if len({len(line) for line in lines}) > 1:
        raise ValueError(f"a row has another number of cells than the head, {lines[0]}")
    lines.insert(1, ("---",) * len(lines[0]))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def with_interval(value: float, low: float, high: float) -> str:
    """``0.50 [0.40, 0.60]``"""
    return f"{value:.2f} [{low:.2f}, {high:.2f}]"


def comparison(suite: str) -> str:
    """Tabulate all methods of a suite: score, ratio to the best rival, probability that POR is better, time."""
    scores = read_scores([RESULTS / suite / "scores.csv"])
    tables = {kind: plot(scores, kind)[0].table for kind in ("aggregates", "ratio", "improvement")}
    means = tables["aggregates"].query("statistic == 'mean'").set_index("algo").sort_values("value", ascending=False)
    ratios = tables["ratio"].set_index("algo")
    better = {}
    for pair in tables["improvement"].itertuples():
        better[pair.algo, pair.rival] = pair.probability, pair.low, pair.high
        better[pair.rival, pair.algo] = 1 - pair.probability, 1 - pair.high, 1 - pair.low
    last = scores[scores["step"] == means["step"].iloc[0]]
    rows = []
    for algo, mean in means.iterrows():
        runs = last[last["algo"] == algo].sort_values("seed")
        ratio = with_interval(*ratios.loc[algo, ["ratio", "low", "high"]]) if algo in ratios.index else "-"
        rows.append(
            (
                f"`{algo}`",
                with_interval(mean["value"], mean["low"], mean["high"]),
                ", ".join(f"{score:.2f}" for score in runs[METRIC]),
                ratio,
                with_interval(*better["sac_por", algo]) if algo != "sac_por" else "-",
                f"{runs['wall_clock_s'].mean() / 60:.0f}",
            )
        )
    head = ("", "mean", "each seed", "ratio to its best rival", "`sac_por` is better with probability", "minutes")
    return markdown(head, rows)


def areas_of(suite: str) -> pd.DataFrame:
    """Area under each learning curve, divided by the agent steps from the first to the last evaluation: a row a run."""
    scores = read_scores([RESULTS / suite / "scores.csv"]).sort_values("step")
    last = scores.groupby(["env", "algo", "seed"]).tail(1).set_index(["env", "algo", "seed"])
    runs = scores.groupby(["env", "algo", "seed"])
    areas = pd.Series({key: trapezoid(run[METRIC], run["step"]) / np.ptp(run["step"]) for key, run in runs})
    return last.assign(**{METRIC: areas}).reset_index()


def ratio_of(runs: pd.DataFrame, algo: str, rivals: Iterable[str]) -> str:
    """Ratio of an algorithm's mean to that of its best rival, in which the bootstrap includes the choice of the rival."""
    ratios = plot(runs[runs["algo"].isin([algo, *rivals])], "ratio")[0].table.set_index("algo")
    return with_interval(*ratios.loc[algo, ["ratio", "low", "high"]])


def claims() -> str:
    """Tabulate the paper's gains in efficiency beside what has been measured here."""
    rows = []
    for task, gain, suite, rivals in (
        ("PourWater-v0", "1.32", "main", RIVALS),
        ("PourWaterAmount-v0", "1.11", "", ()),
        ("StraightenRope-v0", "1.04", "", ()),
        ("FoldCloth-v0", "1.02", "fold", ()),
    ):
        cells = ["not run"] + ["-"] * 4 + ["0"]
        if suite:
            final, areas = read_scores([RESULTS / suite / "scores.csv"]), areas_of(suite)
            final = final[final["step"] == final["step"].max()]
            cells = [
                ratio_of(runs, "sac_por", others) if others else "not run"
                for others in (rivals, ("por_lambda_0",))
                for runs in (areas, final)
            ]
            cells += [f"`python -m sb3_por suite {suite}`", str(areas["seed"].nunique())]
        rows.append((f"`{task}`", gain, *cells[:4], cells[5], cells[4]))
    head = (
        "task",
        "the paper",
        "area, POR / best rival",
        "last score, POR / best rival",
        "area, POR / λ = 0",
        "last score, POR / λ = 0",
        "seeds",
        "command",
    )
    return markdown(head, rows)


def rivals() -> str:
    """Tabulate POR and its ablation lambda = 0 against the paper's rivals."""
    scores = read_scores([RESULTS / "main" / "scores.csv"])
    rows = []
    for algo in ("sac_por", "por_lambda_0"):
        ratios = plot(scores[scores["algo"].isin([algo, *RIVALS])], "ratio")[0].table.set_index("algo")
        row = ratios.loc[algo]
        rows.append((f"`{algo}`", f"`{row['rival']}`", with_interval(*row[["ratio", "low", "high"]])))
    return markdown(("", "best of the three", "ratio"), rows)


def paired(difference: pd.Series) -> tuple[str, str]:
    """Mean of paired differences with a 95 % t-interval, and their standard deviation; dashes where one pair has none."""
    difference = difference.dropna()
    n, mean, deviation = len(difference), difference.mean(), difference.std(ddof=1)
    if n < 2:
        return f"{mean:+.2f}", "-"
    half = stats.t.ppf(0.975, n - 1) * deviation / np.sqrt(n)
    return f"{mean:+.2f} [{mean - half:+.2f}, {mean + half:+.2f}]", f"{deviation:.2f}"


def last_five(suite: str, reference: str) -> str:
    """Tabulate the mean of each run's last five evaluations, and the differences to another algorithm with the same seed."""
    scores = read_scores([RESULTS / suite / "scores.csv"]).sort_values("step")
    means = scores.groupby(["env", "algo", "seed"])[METRIC].apply(lambda run: run.tail(5).mean()).unstack("seed")
    rows = []
    for env_id, algo in means.index:
        own, other = means.loc[env_id, algo], means.loc[env_id, reference]
        each = ", ".join("-" if pd.isna(mean) else f"{mean:.2f}" for mean in own)
        difference = paired(own - other)[0] if algo != reference else "-"
        rows.append((f"`{env_id}`", f"`{algo}`", paired(own)[0].replace("+", ""), each, difference))
    return markdown(("", "", "mean", "each seed", f"difference to `{reference}`"), rows)


def areas(suite: str, reference: str = "por_lambda_0") -> str:
    """Tabulate the area under each learning curve, and the differences to another algorithm with the same seed."""
    areas = areas_of(suite).pivot(index="algo", columns="seed", values=METRIC)
    scores = read_scores([RESULTS / suite / "scores.csv"])
    last = scores[scores["step"] == scores["step"].max()].pivot(index="algo", columns="seed", values=METRIC)
    rows = []
    for algo in areas.mean(axis=1).sort_values(ascending=False).index:
        own = areas.loc[algo]
        differences = ["-"] * 3
        if algo != reference:
            differences = [*paired(own - areas.loc[reference]), paired(last.loc[algo] - last.loc[reference])[0]]
        each = ", ".join("-" if pd.isna(area) else f"{area:.2f}" for area in own)
        rows.append((f"`{algo}`", f"{own.mean():.2f}", each, *differences))
    head = (
        "",
        "mean area",
        "each seed",
        f"difference to `{reference}`",
        "standard deviation of differences",
        "difference of last scores",
    )
    return markdown(head, rows)


def power() -> str:
    """Tabulate the paired seeds at which a t-test finds a difference of areas in four of five studies."""
    areas = areas_of("main").pivot(index="algo", columns="seed", values=METRIC).drop(index="por_paper")
    differences = areas.sub(areas.loc["por_lambda_0"]).drop(index="por_lambda_0")
    deviation = np.sqrt(differences.var(axis=1, ddof=1).mean())
    rows = []
    for difference in (0.3, 0.2, 0.15, 0.1, 0.05):
        n = next(n for n in range(2, 1000) if _power(difference / deviation, n) >= 0.8)
        rows.append((f"{difference:.2f}", f"{deviation:.2f}", str(n)))
    return markdown(("difference of areas", "standard deviation of paired differences", "seeds"), rows)


def balance() -> str:
    """Tabulate who trains the encoder under fixed and balanced weights: in the first and in the last updates."""
    table = pd.read_csv(RESULTS / "balance" / "balance.csv")
    table["ratio"] = table["grad_norm_por"] / table["grad_norm_critic"]
    rows = []
    for coef, run in table.groupby("por_coef", sort=False):
        ends = run.sort_values("update").iloc[[0, -1]]
        cells = (
            f"{start:.3g}, {end:.3g}" for start, end in (ends[name] for name in ("weight", "ratio", "cosine", "accuracy"))
        )
        rows.append((f"`{coef}`", *cells))
    first, last = table["update"].min(), table["update"].max()
    head = ("`por_coef`", "λ", "gradient of λ POR / critic's", "cosine", "accuracy")
    return markdown((f"{head[0]}; updates to {first}, to {last}", *head[1:]), rows)


def _power(effect: float, n: int) -> float:
    """Power of a two-sided paired t-test at 5 %, for a difference in units of its standard deviation."""
    bound, shift = stats.t.ppf(0.975, n - 1), effect * np.sqrt(n)
    return float(stats.nct.sf(bound, n - 1, shift) + stats.nct.cdf(-bound, n - 1, shift))


def weights() -> str:
    """Tabulate POR by pairing and weight: each seed at two steps, and the mean at the second."""
    scores = pd.concat(read_scores([RESULTS / suite / "scores.csv"]) for suite in ("full_speed", "weights"))
    runs = scores.sort_values("seed").groupby(["algo", "step"])[METRIC]
    rows = []
    for algo, pairing, weight in (
        ("por_lambda_0", "-", 0),
        ("por_10", "swap", 10),
        ("sac_por", "swap", 100),
        ("por_paper_10", "paper", 10),
        ("por_paper", "paper", 100),
    ):
        columns = (", ".join(f"{score:.2f}" for score in runs.get_group((algo, step))) for step in (7500, 12500))
        rows.append((f"`{algo}`", pairing, str(weight), *columns, f"{runs.get_group((algo, 12500)).mean():.2f}"))
    return markdown(("", "pairing", "λ", "after 7500 steps", "after 12 500", "mean"), rows)


def courses(suite: str) -> str:
    """Tabulate single runs: best evaluation, mean of the last four, last evaluation."""
    scores = read_scores([RESULTS / suite / "scores.csv"])
    rows = []
    for (algo, seed), run in scores.groupby(["algo", "seed"]):
        best, last = run.loc[run[METRIC].idxmax()], run.loc[run["step"].idxmax()]
        rows.append(
            (
                f"`{algo}`",
                str(seed),
                f"{best[METRIC]:.2f} at {best['step'] / 1000:.0f}k",
                f"{run.nlargest(4, 'step')[METRIC].mean():.2f}",
                f"{last[METRIC]:.2f} at {last['step'] / 1000:.0f}k",
                f"{last['wall_clock_s'] / 60:.0f}",
            )
        )
    return markdown(("", "seed", "best evaluation", "mean of the last four", "last", "minutes"), rows)


def evaluations(folder: str) -> str:
    """Tabulate every evaluation of single runs."""
    scores = read_scores([RESULTS / folder / "scores.csv"])
    rows = []
    for (env_id, name, seed), run in scores.groupby(["env", "algo", "seed"]):
        run = run.sort_values("step")
        course = ", ".join(f"{score:.2f}" for score in run[METRIC])
        rows.append((f"`{env_id}`", f"`{name}`", str(seed), f"{run['step'].iloc[0] / 1000:g}k", course))
    return markdown(("", "label", "seed", "every", "evaluations"), rows)


def state() -> str:
    """Tabulate the best scores of SAC on the state against their targets."""
    scores = read_scores([RESULTS / "state" / "scores.csv"])
    rows = []
    for env_id, (wanted, within) in WANTED.items():
        runs = scores[(scores["env"] == env_id) & (scores["step"] <= within)]
        best = runs.loc[runs[METRIC].idxmax()]
        reached = f"{best[METRIC]:.2f}" if best[METRIC] >= wanted else f"not yet: {best[METRIC]:.2f}"
        rows.append(
            (
                f"`{env_id}`",
                f"{wanted} within {within // 1000}k",
                reached,
                f"{best['step'] / 1000:.0f}k",
                f"{runs['step'].max() / 1000:.0f}k",
                f"{best['wall_clock_s'] / 60:.0f}",
            )
        )
    return markdown(("", "wanted", "best evaluation", "at step", "stopped at", "minutes to the best"), rows)


def diagnosis(suite: str) -> str:
    """Tabulate the diagnoses of a suite's models, with the controls that its table has."""
    table = pd.read_csv(RESULTS / suite / "diagnosis.csv")
    correlations = {name: title for name, title in CORRELATIONS.items() if name in table}
    rows = [
        (
            f"`{row.algo}`",
            str(row.seed),
            *(f"{value:.3f}" for value in (row.accuracy, row.random_accuracy, row.leak_accuracy)),
            *(f"{value:.2g}" if value < 1 else f"{value:.0f}" for value in (row.grad_norm_critic, row.grad_norm_por)),
            f"{row.feature_std:.3f}",
            *("-" if pd.isna(value) else f"{value:.2f}" for value in (getattr(row, name) for name in correlations)),
        )
        for row in table.sort_values(["algo", "seed"], ascending=[False, True]).itertuples()
    ]
    head = (
        "",
        "seed",
        "accuracy",
        "of random play",
        "k = 0",
        "gradient of the critic",
        "of λ POR",
        "std of features",
        *correlations.values(),
    )
    return markdown(head, rows)


def leak() -> str:
    """Tabulate both pairings where the answer is known: means over the last hundred updates."""
    table = pd.read_csv(RESULTS / "leak" / "leak.csv")
    last = table.sort_values("update").groupby(["env", "pairing"]).last()
    names = {
        "iid": "noise without time (`iid`)",
        "SwingingBall-v0": "a reversible motion (`SwingingBall-v0`)",
        "PourWater-v0": "pouring, mostly random play (`PourWater-v0`)",
        "FallingBall-v0": "an order in every frame (`FallingBall-v0`)",
    }
    rows = []
    for env, name in names.items():
        for pairing in ("paper", "swap"):
            row = last.loc[env, pairing]
            numbers = row[["por_loss", "por_accuracy", "por_leak_loss", "por_leak_accuracy"]]
            rows.append(
                (name if pairing == "paper" else "", pairing, *(f"{x:.3f}" if x >= 0.001 else f"{x:.1g}" for x in numbers))
            )
    head = ("", "pairing", "loss, real pairs", "accuracy, real pairs", "loss, k = 0", "accuracy, k = 0")
    return markdown(head, rows)


def soak() -> str:
    """Tabulate what has been played, and what the audit of the physics has found."""
    table = pd.read_csv(RESULTS / "soak" / "one_process_plays.csv")
    rows = []
    for row in table.itertuples():
        extremes = {
            "rope {:.1%} longer or shorter": row.rope_stretch,
            "an edge {:.2f} times its length": row.edge_stretch,
            "water {:.1f} m away": row.water_distance,
        }
        farthest = "".join(text.format(value) for text, value in extremes.items() if not np.isnan(value))
        counts = (str(n) for n in (row.steps, row.episodes, row.reported, row.unreported, row.nan))
        rows.append((f"`{row.env}`", row.policy, *counts, farthest))
    totals = (str(table[name].sum()) for name in ("steps", "episodes", "reported", "unreported", "nan"))
    head = ("task", "policy", "control steps", "episodes", "explosions, reported", "unreported", "NaN", "at most")
    return markdown(head, [*rows, ("all", "", *totals, "")])


def soak_process() -> str:
    """Tabulate what each process held after its first and after its last round over all tasks."""
    rounds = pd.read_csv(RESULTS / "soak" / "one_process_rounds.csv")
    head = ("process", "after control steps", "minutes", "memory, MB", "file descriptors", "threads", "temporary files")
    ends = pd.concat([part.iloc[[0, -1]] for _, part in rounds.groupby("process")]).drop_duplicates()
    columns = ("process", "steps", "minutes", "memory_mb", *rounds.columns[4:])
    return markdown(head, zip(*(ends[name].astype(int).astype(str) for name in columns), strict=True))


def scores_of(algo: str) -> str:
    """Tabulate what one algorithm has reached in the suites that compare algorithms."""
    rows = []
    for suite in ("main", "full_speed", "fold"):
        scores = read_scores([RESULTS / suite / "scores.csv"])
        means = plot(scores, "aggregates")[0].table.query("statistic == 'mean'").set_index("algo")
        if algo not in means.index:
            continue
        mean = means.loc[algo]
        runs = scores.query("algo == @algo and step == @mean.step").sort_values("seed")
        rows.append(
            (
                f"`{runs['env'].iloc[0]}`",
                f"`suites/{suite}.yml`",
                str(mean["step"]),
                with_interval(mean["value"], mean["low"], mean["high"]),
                ", ".join(f"{score:.2f}" for score in runs[METRIC]),
                f"{runs['wall_clock_s'].mean() / 60:.0f}",
            )
        )
    return markdown(("task", "suite", "agent steps", "mean", "each seed", "minutes"), rows)


def metrics_of(objective: str) -> str:
    """Repeat an objective's rows of the page of metrics."""
    page = (DOCS / "metrics.md").read_text()
    own = f"{objective}_|encoder_grad_norm_{objective}`|encoder_grad_cosine`"
    rows = re.findall(rf"^\| `train/(?:{own}).*$", page, re.MULTILINE)
    return "\n".join(["| metric | meaning | usual | worry if |", "| --- | --- | --- | --- |", *rows])


def arguments_of(documented: type, base: type | None = None) -> str:
    """The arguments of a class that its base does not have, or has with another default, as its docstring explains them."""
    own, inherited = (inspect.signature(cls.__init__).parameters if cls else {} for cls in (documented, base))
    rows = []
    for name, text in re.findall(r":param (\w+): (.*?)(?=\n *:param |\n *\Z)", inspect.getdoc(documented) + "\n", re.DOTALL):
        default = own[name].default
        if default is inspect.Parameter.empty or (name in inherited and inherited[name].default == default):
            continue
        meaning = re.sub(r"\s+", " ", text).replace("``", "`")
        shown = f'"{default}"' if isinstance(default, str) else str(default)
        rows.append((f"`{name}`", f"`{shown}`", meaning + (f"; SB3: {inherited[name].default}" if name in inherited else "")))
    return markdown(("argument", "default", "meaning"), rows)


def wrappers_of(*wrappers: type) -> str:
    """Wrappers of environments with their arguments, as the first sentence of each docstring explains them."""
    rows = []
    for wrapper in wrappers:
        _, _, *arguments = inspect.signature(wrapper.__init__).parameters.values()  # without self and the environment
        shown = ", ".join(str(argument.replace(annotation=inspect.Parameter.empty)) for argument in arguments)
        sentence = re.split(r"(?<=\.)\s", inspect.getdoc(wrapper), maxsplit=1)[0]
        rows.append((f"`{wrapper.__name__}`", f"`{shown}`", re.sub(r"\s+", " ", sentence).replace("``", "`")))
    return markdown(("wrapper", "arguments", ""), rows)


TABLES: dict[str, Callable[[], str]] = {
    "comparison": lambda: comparison("main"),
    "rivals": rivals,
    "claims": claims,
    "areas": lambda: areas("main"),
    "areas_fold": lambda: areas("fold"),
    "areas_fair": lambda: areas("fair"),
    "power": power,
    "balance": balance,
    "full_speed": lambda: comparison("full_speed"),
    "weights": weights,
    "longer": lambda: courses("long"),
    "steady": lambda: courses("steady"),
    "trials": lambda: evaluations("trials"),
    "progress": lambda: evaluations("progress"),
    "pour": lambda: evaluations("pour"),
    "figure4_pour": lambda: evaluations("figure4_pour"),
    "drop": lambda: evaluations("drop"),
    "demos": lambda: evaluations("demos"),
    "rope": lambda: evaluations("rope"),
    "sparse": lambda: evaluations("sparse"),
    "sparse_areas": lambda: areas("sparse", "none"),
    "sparse_last_five": lambda: last_five("sparse", "none"),
    "fold": lambda: evaluations("fold"),
    "fold_comparison": lambda: comparison("fold"),
    "diagnosis_fold": lambda: diagnosis("fold"),
    "state": state,
    "diagnosis": lambda: diagnosis("main"),
    "diagnosis_full_speed": lambda: diagnosis("full_speed"),
    "leak": leak,
    "soak": soak,
    "soak_process": soak_process,
    "metrics_por": lambda: metrics_of("por"),
    "metrics_curl": lambda: metrics_of("curl"),
    "metrics_spr": lambda: metrics_of("spr"),
    "metrics_mrq": lambda: metrics_of("mrq"),
    "arguments": lambda: arguments_of(VisualSAC, SAC),
    "arguments_encoder": lambda: arguments_of(ConvEncoder),
    "arguments_env": lambda: arguments_of(SoftbodyEnv),
    "wrappers": lambda: wrappers_of(ActionRepeat, ProgressReward, SuccessReward, RankedProgress, Distraction, ShowQuantity),
    **{f"scores_{algo}": partial(scores_of, algo) for algo in ALGOS},
}


def fill_in(page: str) -> str:
    """Replace a page's tables by those that follow from the results."""
    return re.sub(
        r"(<!-- table: (\w+) -->\n).*?(?=<!-- end -->)",
        lambda match: f"{match[1]}\n{TABLES[match[2]]()}\n\n",
        page,
        flags=re.DOTALL,
    )


def draw() -> None:
    """Draw the figures of scores and of POR's classifier."""
    for suite in ("main", "full_speed", "weights", "long", "steady", "rope", "fold", "state", "fair", "sparse"):
        scores = read_scores([RESULTS / suite / "scores.csv"])
        plot(scores, "tasks")[0].save(RESULTS / suite / "curves.png")
    for suite in ("main", "full_speed"):
        plot_order(read_order([RESULTS / suite / "order.csv"])[0])[0].save(RESULTS / suite / "order.png")
    scores = read_scores([RESULTS / "main" / "scores.csv"])
    for algo in ALGOS:
        with_plain = scores[scores["algo"].isin([algo, "por_lambda_0"])]
        plot(with_plain, "tasks")[0].save(DOCS / "algorithms" / f"{algo}.png")


def main() -> None:
    """Parse the command line, fill in the pages, draw the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figures", action="store_true", help="draw the figures, too")
    if parser.parse_args().figures:
        draw()
    for name in PAGES:
        (DOCS / name).write_text(fill_in((DOCS / name).read_text()))


if __name__ == "__main__":
    main()
