"""The report stands by itself, says what was run, and its numbers are those of the statistics."""

import base64
import io
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser

import gymnasium as gym
import pytest
import yaml
from filelock import FileLock
from made_runs import log_order, random_scores, write_run
from PIL import Image
from stable_baselines3 import SAC

from sb3_por import SACPOR
from sb3_por.analysis.learning_curves import read_grid
from sb3_por.analysis.report import write_report
from sb3_por.analysis.scores import read_scores, write_csv
from sb3_por.analysis.statistics import aggregates, improvements
from sb3_por.common.errors import UserError
from sb3_por.runs.facts import progress, take_inventory

ENV = "FallingBall-v0"
PERFORMANCE = {"sac_por": (0.1, 0.5, 0.9), "sac": (0.2, 0.3, 0.6)}


class Page(HTMLParser):
    """Pictures, links, texts and tables of a page; fails where tags are not closed in order."""

    VOID = ("meta", "img", "br")

    def __init__(self, path):
        super().__init__()
        self.folder, self.source = path.parent, path.read_text()
        self.open, self.images, self.addresses, self.tables, self.section = [], [], [], {}, None
        self.feed(self.source)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.addresses += [attributes[name] for name in ("src", "href", "srcset", "data", "action") if name in attributes]
        self.section = attributes.get("id", self.section)
        if tag == "img":
            self.images.append(attributes)
        elif tag == "tr":
            self.tables.setdefault(self.section, []).append([])
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, self.getpos()

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.tables[self.section][-1].append(data)

    def picture(self, i):
        kind, _, content = self.images[i]["src"].partition(";base64,")
        return kind, Image.open(io.BytesIO(base64.b64decode(content)))


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    """A suite's folder: two algorithms with two seeds each, one of them stopped; one run failed before it began."""
    root = tmp_path_factory.mktemp("runs") / "falling"
    model_of = {
        "sac_por": lambda: SACPOR("CnnPolicy", gym.make(ENV, obs_type="pixels", image_size=32), buffer_size=10),
        "sac": lambda: SAC("MlpPolicy", gym.make(ENV, obs_type="state"), buffer_size=10),
    }
    for algo, performance in PERFORMANCE.items():
        for seed in (0, 1):
            folder = root / ENV / algo / f"seed_{seed}"
            run = write_run(folder, algo, ENV, seed, [one - 0.1 * seed for one in performance])
            arguments = {"algo": algo, "env": ENV, "seed": seed, "commit": "abc123", "machine": "2 cores of Abacus"}
            (run / ENV / "args.yml").write_text(yaml.safe_dump(arguments | {"n_timesteps": -1, "eval_freq": 100}))
            (run / ENV / "config.yml").write_text(yaml.safe_dump({"batch_size": 64, "n_timesteps": 300.0}))
            (folder / "log.txt").write_text("one line\n")
            (run / f"{ENV}.zip").touch()
        for seed in (0, 1):
            model_of[algo]().save(root / ENV / algo / f"seed_{seed}" / algo / f"{ENV}_{seed}" / "best_model.zip")
    log_order(root / ENV / "sac_por" / "seed_0" / "sac_por" / f"{ENV}_0" / "tb" / "SACPOR_1", [0.7, 0.5])
    stopped = root / ENV / "sac" / "seed_1"
    (stopped / "sac" / f"{ENV}_1" / f"{ENV}.zip").unlink()
    (stopped / "log.txt").write_text("\n".join(f"line {i}" for i in range(100)) + "\nKilled: <b>out of memory</b>\n")
    (root / ENV / "sac" / "seed_2").mkdir()
    (root / ENV / "sac" / "seed_2" / "log.txt").write_text("train.py: error: no such setting\n")
    return root


@pytest.fixture(scope="module")
def page(suite, tmp_path_factory):
    return Page(write_report([suite], tmp_path_factory.mktemp("report")))


def test_the_page_needs_nothing_but_itself(page):
    assert page.images and all(one["alt"] for one in page.images)
    assert all(re.match("data:image/(png|gif);base64,|#", address) for address in page.addresses)
    assert not re.search(r"https?://|url\(|@import|<script|<link|<iframe", page.source)
    targets = {address[1:] for address in page.addresses if address.startswith("#")}
    assert targets and all(f'id="{target}"' in page.source for target in targets)
    for i in range(len(page.images)):
        page.picture(i)[1].load()


def test_the_numbers_are_those_of_the_statistics(page, suite):
    grid = read_grid(read_scores([suite]))
    for name, measure in {"aggregates": aggregates, "improvement": improvements}.items():
        expected = measure(grid)
        header, *rows = page.tables[name]
        assert header == list(expected.columns)
        for row, values in zip(rows, expected.itertuples(index=False), strict=True):
            assert row == [f"{value:.3f}" if isinstance(value, float) else str(value) for value in values]
    assert ["sac_por", "300", "0.850"] in [row[:3] for row in page.tables["iqm"]]
    assert [ENV, "sac_por", "200", "0.500"] in [row[:4] for row in page.tables["order"]]


def test_the_page_says_what_was_run(page):
    header, *rows = page.tables["runs"]
    assert header[:5] == ["algorithm", "environment", "seed", "state", "steps"]
    row = dict(zip(header, next(row for row in rows if row[0] == "sac_por" and row[2] == "0"), strict=True))
    assert (row["state"], row["steps"], row["last score"], row["best score"]) == ("finished", "300 of 300", "0.900", "0.900")
    assert (row["commit"], row["machine"]) == ("abc123", "2 cores of Abacus")
    assert f"sac_por on {ENV}, seeds 0, 1" in page.source
    assert ["batch_size", "64"] in page.tables["settings"] and ["eval_freq", "100"] in page.tables["settings"]


def test_the_page_shows_what_failed(page):
    assert "<p>4 runs, 12 evaluations." in page.source and "2 not finished" in page.source
    assert f"sac on {ENV}, seed 1: stopped at step 300 of 300" in page.source
    assert "line 99\nKilled: &lt;b&gt;out of memory&lt;/b&gt;" in page.source and "line 10\n" not in page.source
    assert "seed_2/log.txt: failed before the run started" in page.source and "error: no such setting" in page.source


def test_the_page_shows_the_best_models(page):
    shown = {image["alt"]: page.picture(i) for i, image in enumerate(page.images) if image["alt"].startswith(ENV)}
    video = f"{ENV}, sac_por, seed 0: best of its evaluations 0.900"
    assert len(shown) == 3 and {video, f"{ENV}, sac, seed 0: best of its evaluations 0.600"} < set(shown)
    kind, moving = shown[video]
    assert kind == "data:image/gif" and moving.n_frames > 1
    (saliency,) = [picture for alt, picture in shown.items() if "saliency of its classifier" in alt]
    assert saliency[0] == "data:image/png"


def test_figures_for_print_lie_beside_the_page(page):
    assert {"iqm.pdf", "order.pdf", "aggregates.csv"} < {path.name for path in (page.folder / "figures").iterdir()}


def test_a_table_of_scores_makes_a_page_that_says_what_is_missing(tmp_path):
    write_csv(random_scores(algos=("sac_por", "sac_drq"), n_seeds=2), tmp_path / "scores.csv")
    page = Page(write_report([tmp_path / "scores.csv"], tmp_path / "page"))
    assert {"iqm", "tasks", "aggregates", "improvement", "ratio"} == set(page.tables) and "runs" not in page.tables
    assert "made from scores alone" in page.source and "<p>8 runs, 24 evaluations." in page.source


def test_a_page_of_runs_that_were_never_evaluated_names_their_failures(tmp_path):
    run = write_run(tmp_path / "seed_0")
    (run / "evaluations.npz").unlink()
    (tmp_path / "seed_0" / "log.txt").write_text("MemoryError\n")
    page = Page(write_report([tmp_path], tmp_path / "page"))
    assert "no run was evaluated" in page.source and "MemoryError" in page.source and not page.images


def test_a_run_that_died_has_no_scores_of_the_run_that_replaced_it(tmp_path):
    for attempt in ("first", "second"):
        write_run(tmp_path / attempt)
    (tmp_path / "first" / "sac_por" / "PourWater-v0_1" / "evaluations.npz").unlink()
    (tmp_path / "first" / "sac_por" / "PourWater-v0_1" / "best_model.zip").write_bytes(b"PK nonsense")
    page = Page(write_report([tmp_path], tmp_path / "page"))
    header, *rows = page.tables["runs"]
    of_scores = [header.index(name) for name in ("last score", "best score", "hours")]
    assert [[row[i] for i in of_scores] for row in rows] == [["-", "-", "-"], ["0.400", "0.400", "0.01"]]
    assert "cannot be shown" not in page.source


def test_settings_of_both_files_are_shown(tmp_path):
    run = write_run(tmp_path, arguments={"env_kwargs": {"image_size": 48}})
    (run / "PourWater-v0" / "config.yml").write_text(yaml.safe_dump({"env_kwargs": {"image_size": 64, "obs_type": "dict"}}))
    assert take_inventory([run])[0].settings["env_kwargs"] == {"image_size": 48, "obs_type": "dict"}


def test_a_corrupt_model_is_noted_and_the_page_written(tmp_path):
    run = write_run(tmp_path)
    (run / "best_model.zip").write_bytes(b"PK nonsense")
    page = Page(write_report([run], tmp_path / "page"))
    assert "its model cannot be shown" in page.source and "is corrupt" in page.source


def test_a_run_at_work_is_no_failure_yet(tmp_path):
    run = write_run(tmp_path)
    with FileLock(run / ".lock"):
        assert take_inventory([tmp_path])[0].state == "running"
    assert take_inventory([tmp_path])[0].state == "stopped"
    (run / "PourWater-v0.zip").touch()
    assert take_inventory([tmp_path])[0].state == "finished"


def test_a_page_of_nothing_is_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no run under"):
        write_report([tmp_path / "empty"], tmp_path / "page")


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs the program chromium")
def test_a_browser_shows_every_picture_and_loads_nothing(page, tmp_path):
    # The page has no script; this copy of it has one that tells what the browser made of it.
    probe = """<script>window.onload = () => document.title = JSON.stringify({
        sizes: [...document.images].map(image => image.naturalWidth),
        loaded: performance.getEntriesByType("resource").map(entry => entry.name).filter(name => !name.startsWith("data:")),
        overflow: document.documentElement.scrollWidth - innerWidth})</script></body>"""
    (tmp_path / "page.html").write_text(page.source.replace("</body>", probe))
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    command += ["--window-size=1100,800", "--virtual-time-budget=5000", "--dump-dom", f"file://{tmp_path / 'page.html'}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    seen = json.loads(re.search("<title>(.*?)</title>", done.stdout).group(1))
    assert len(seen["sizes"]) == len(page.images) and min(seen["sizes"]) > 100
    assert seen["loaded"] == [] and seen["overflow"] <= 0


def test_steps_of_held_actions_are_the_agents(tmp_path):
    run = write_run(tmp_path, steps=[100, 200, 300])
    (run / "0.monitor.csv").write_text("#{}\nr,l,t\n" + "1.0,102,1.0\n" * 80)
    assert progress(run)[0] == 8160
    wrappers = [{"softbody_envs.wrappers.ActionRepeat": {"repeat": 5}}, "gymnasium.wrappers.RescaleAction"]
    (run / "PourWater-v0" / "config.yml").write_text(yaml.safe_dump({"env_wrapper": wrappers}))
    assert progress(run)[0] == 80 * 21
