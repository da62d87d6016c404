"""The pins of constraints.txt are renewed by a script; setup.cfg allows them, and neither what is known to be unsafe."""

import configparser
import csv
import importlib.util
import re
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[2]
spec = importlib.util.spec_from_file_location("renew_constraints", ROOT / ".ci" / "renew_constraints.py")
script = importlib.util.module_from_spec(spec)
spec.loader.exec_module(script)


def requirements():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    texts = [config["options"]["install_requires"], *config["options.extras_require"].values()]
    lines = [line.split("#")[0].strip() for text in texts for line in text.splitlines()]
    return [Requirement(line) for line in lines if line]


def pins():
    return {script.normalize(name): version for name, version in script.PIN.findall(script.CONSTRAINTS.read_text())}


def test_every_requirement_is_pinned_to_a_version_that_it_allows():
    assert len(requirements()) > 30
    for requirement in requirements():
        if not requirement.name.startswith("sb3-por"):
            assert requirement.specifier.contains(pins()[script.normalize(requirement.name)], prereleases=True), requirement


def test_renewing_changes_versions_and_nothing_else():
    text = script.CONSTRAINTS.read_text()
    assert script.renew(text, {}) == text and script.changes(text, text) == []
    renewed = script.renew(text, {"torch": "99.1", "rl-zoo3": "2.9.9", "not-pinned": "1"})
    assert "\ntorch==99.1\n" in renewed and "\nrl_zoo3==2.9.9\n" in renewed
    assert re.sub(r"==[^\s;]+", "", renewed) == re.sub(r"==[^\s;]+", "", text)
    told = script.changes(text, renewed)
    assert len(told) == 2 and any(re.fullmatch(r"torch \S+ -> 99\.1", line) for line in told)


def test_each_target_keeps_to_the_versions_of_those_before_it(monkeypatch):
    """What each resolution finds, and what it is given."""
    found = iter([{"numpy": "2.2.6", "torch": "2.13.0"}, {"numpy": "2.2.6", "mkdocs": "1.6.1"}, {"pygame": "2.6.1"}])
    given = []

    def resolve(python, platform, constraints):
        given.append((python, platform, constraints.splitlines()))
        return next(found)

    monkeypatch.setattr(script, "TARGETS", script.TARGETS[:3])
    monkeypatch.setattr(script, "resolve", resolve)
    assert script.newest() == {"numpy": "2.2.6", "torch": "2.13.0", "mkdocs": "1.6.1", "pygame": "2.6.1"}
    assert [python for python, _, _ in given] == ["3.10.9", "3.10.9", "3.11.9"]
    assert [constraints for _, _, constraints in given] == [
        ["moviepy>=2"],
        ["moviepy>=2", "numpy==2.2.6", "torch==2.13.0"],
        ["moviepy>=2", "numpy==2.2.6", "torch==2.13.0", "mkdocs==1.6.1"],
    ]


with open(ROOT / ".ci" / "advisories.csv", newline="") as file:
    ADVISORIES = list(csv.DictReader(file))


@pytest.mark.parametrize("row", ADVISORIES, ids=lambda row: f"{row['package']}: {row['advisory']}")
def test_no_version_with_a_known_vulnerability_is_pinned_or_allowed(row):
    """But for those that are accepted with a reason."""
    version = pins().get(row["package"]) or row["resolved"]
    assert version, "neither pinned nor resolved"
    if row["accepted_because"]:
        return
    assert Version(version) >= Version(row["fixed_in"])
    for requirement in requirements():
        if script.normalize(requirement.name) == row["package"]:
            lowest = min(Version(one.version) for one in requirement.specifier if one.operator == ">=")
            assert lowest >= Version(row["fixed_in"]), requirement
