"""The documents' tables are those of the committed results, their links resolve, and their code and commands run."""

import configparser
import importlib.util
import re
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from sb3_por.__main__ import _parse as parse_arguments
from sb3_por.common.errors import UserError
from sb3_por.ranking import Ranker
from sb3_por.suites.suite_file import read_suite

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()


@pytest.fixture(scope="module")
def make_results():
    spec = importlib.util.spec_from_file_location("make_results", DOCS / "_scripts" / "make_results.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_tables_are_those_of_the_results(make_results):
    pages = {name: (DOCS / name).read_text() for name in make_results.PAGES}
    for name, page in pages.items():
        assert make_results.fill_in(page) == page, f"docs/{name} is not up to date: python docs/_scripts/make_results.py"
    assert all(f"<!-- table: {name} -->" in "".join(pages.values()) for name in make_results.TABLES)


def test_a_table_that_says_something_else_is_replaced(make_results):
    page = "before\n<!-- table: leak -->\n| 1 |\n<!-- end -->\nafter\n"
    filled = make_results.fill_in(page)
    assert filled.startswith("before\n<!-- table: leak -->\n\n| ") and filled.endswith(" |\n\n<!-- end -->\nafter\n")
    assert "| 1 |" not in filled and "`SwingingBall-v0`" in filled


def anchors(page):
    """Anchors of a page's titles, as code hosts make them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_somewhere(name):
    page = ROOT / name
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if not target.startswith(("http", "mailto:")):
            file, _, anchor = target.partition("#")
            linked = (page.parent / file) if file else page
            assert linked.exists(), target
            assert not anchor or anchor in anchors(linked), target


def test_the_pictures_of_the_readme_load_quickly():
    pictures = re.findall(r"!\[[^]]+\]\(([^)]+)\)", (ROOT / "README.md").read_text())
    assert len(pictures) >= 2 and sum((ROOT / picture).stat().st_size for picture in pictures) < 1_500_000


#: Records every command of a block, as bash expands it, instead of running it: no command is found on this PATH.
RECORDER = """
PATH=/nowhere
command_not_found_handle() { printf '%s\\x1f' "$@"; printf '\\x1e'; }
.() { :; }
"""


def blocks(language):
    """Code blocks of all pages: (page, number, text)."""
    pattern = re.compile(rf"^```{language}\n(.*?)^```", re.DOTALL | re.MULTILINE)
    return [(name, i, text) for name in PAGES for i, text in enumerate(pattern.findall((ROOT / name).read_text()))]


def commands(block):
    """The argument lists of a block's commands."""
    script = RECORDER + block.replace(".venv/bin/", "")
    done = subprocess.run(["bash", "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stderr == "", block
    return [command.split("\x1f")[:-1] for command in done.stdout.split("\x1e")[:-1]]


class Parsed(Exception):
    """The command line of a training was accepted."""


@pytest.fixture
def check_train(monkeypatch, tmp_path):
    """Give arguments to train.py, up to the place where it would train or read the run to be resumed."""
    from sb3_por.training import arguments as command_line
    from sb3_por.training import zoo

    def accept(*_, **__):
        raise Parsed

    def check(arguments):
        # The first paths of a command line are relative to the checkout, and its runs go elsewhere
        arguments = [str(ROOT / argument) if argument.startswith("zoo_hyperparams/") else argument for argument in arguments]
        with pytest.raises(Parsed):
            assert zoo.main(arguments) == 0

    monkeypatch.chdir(tmp_path)
    Ranker().save("fold.npz")  # a reader has it
    monkeypatch.setattr(zoo, "Experiment", accept)
    monkeypatch.setattr(
        command_line, "th", SimpleNamespace(cuda=SimpleNamespace(is_available=lambda: True))
    )  # a reader has it
    monkeypatch.setattr(zoo.Parser, "_resumed", accept)
    monkeypatch.setattr("sys.argv", [])
    return check


def check_command(command, check_train):
    """A command of the documents is one that its program accepts, as far as that can be said without running it."""
    program, *arguments = command
    if program == "make":
        targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
        assert next(argument for argument in arguments if "=" not in argument) in targets
    elif not program.startswith("python"):
        assert program in ("pip", "ray", "tensorboard", "uv")
    elif arguments[:2] == ["-m", "sb3_por"]:
        parse_arguments(arguments[2:])
    elif arguments[:1] == ["train.py"] or arguments[:2] == ["-m", "sb3_por.zoo"]:
        check_train(arguments[1 if arguments[0] == "train.py" else 2 :])
    elif arguments[0] == "-m":
        assert arguments[1] in ("pytest", "venv")
    else:
        source = (ROOT / arguments[0]).read_text()
        assert all(f'"{flag}"' in source for flag in arguments if flag.startswith("--")), command


@pytest.mark.parametrize("name, number, block", blocks("bash"))
def test_commands_are_accepted(name, number, block, check_train):
    found = commands(block)
    assert found
    for command in found:
        check_command(command, check_train)


def test_a_command_that_does_not_exist_is_noticed(check_train):
    for wrong in (
        "python -m sb3_por evaluate --modell logs --env PourWater-v0",
        "python train.py --algorithm sac_por",
        "python train.py --algo sac_pro",
        "python benchmarks/learner.py --no-such-flag",
        "make trian",
        "pip3 install x",
    ):
        with pytest.raises((AssertionError, UserError)):
            check_command(commands(wrong)[0], check_train)


@pytest.mark.parametrize("name, number, block", blocks("python"))
def test_python_runs(name, number, block, tmp_path, monkeypatch):
    """In small sizes: learning for 110 steps, 100 updates of a ranker, a small replay buffer, evaluating one episode."""
    monkeypatch.chdir(tmp_path)
    if "demonstrations" in block:
        pytest.importorskip("minari", reason="it needs Python 3.11 or newer")
    block = re.sub(r"\.learn\([\d_]+", ".learn(110", block)
    block = re.sub(r"updates=\d+", "updates=100", block)
    block = re.sub(r"n_episodes=\d+", "n_episodes=1", block)
    block = re.sub(r"buffer_size=[\d_]+", "buffer_size=200", block)
    block = re.sub(r"batch_size=\d+", "batch_size=8", block)
    exec(compile(block, name, "exec"), {})


@pytest.mark.parametrize("name, number, block", blocks("yaml"))
def test_suites_can_be_read(name, number, block, tmp_path):
    file = tmp_path / "grid.yml"
    file.write_text(block)
    assert read_suite(file).algos


def test_the_version_to_cite_is_that_of_the_package():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == config["metadata"]["version"]


def test_the_index_of_decisions_lists_all():
    folder = DOCS / "decisions"
    pages = {page.name: page.read_text() for page in folder.glob("*.md")}
    index = pages.pop("README.md")
    titles = [title for page in pages.values() for title in re.findall(r"^## (.+)$", page, flags=re.MULTILINE)]
    assert sorted(re.findall(r"^\* \[(.+)\]\(", index, flags=re.MULTILINE)) == sorted(titles)
    for page in pages.values():
        for decision in page.split("\n## ")[1:]:
            assert re.findall(r"^\*\*(\w+)\.\*\*", decision, flags=re.MULTILINE) == ["Context", "Choice", "Price"]
