"""The pins of constraints.txt are renewed by a script, and setup.cfg allows them."""

import configparser
import importlib.util
import re
from pathlib import Path

from packaging.requirements import Requirement

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


def test_every_requirement_is_pinned_to_a_version_that_it_allows():
    pins = {script.normalize(name): version for name, version in script.PIN.findall(script.CONSTRAINTS.read_text())}
    assert len(requirements()) > 30
    for requirement in requirements():
        if not requirement.name.startswith("sb3-por"):
            assert requirement.specifier.contains(pins[script.normalize(requirement.name)], prereleases=True), requirement


def test_renewing_changes_versions_and_nothing_else():
    text = script.CONSTRAINTS.read_text()
    assert script.renew(text, {}) == text and script.changes(text, text) == []
    renewed = script.renew(text, {"torch": "99.1", "rl-zoo3": "2.9.9", "not-pinned": "1"})
    assert "\ntorch==99.1\n" in renewed and "\nrl_zoo3==2.9.9\n" in renewed
    assert re.sub(r"==[^\s;]+", "", renewed) == re.sub(r"==[^\s;]+", "", text)
    told = script.changes(text, renewed)
    assert len(told) == 2 and any(re.fullmatch(r"torch \S+ -> 99\.1", line) for line in told)
