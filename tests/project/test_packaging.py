"""What is installed is what is imported, and a machine that cannot run it is told so."""

import ast
import configparser
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from sb3_por import ALGORITHMS
from softbody_envs import ENV_IDS

ROOT = Path(__file__).parents[2]
PACKAGES = ("sb3_por", "softbody_envs")

#: import name -> distribution, where they differ
DISTRIBUTIONS = {"cv2": "opencv-python-headless", "PIL": "pillow", "sb3_contrib": "sb3-contrib", "yaml": "pyyaml"}


@pytest.fixture(scope="module")
def options():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    return config


def names(text):
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def canonical(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def requirements(text):
    return {canonical(requirement.name): requirement for requirement in map(Requirement, names(text))}


def test_every_package_is_listed(options):
    listed = set(names(options["options"]["packages"]))
    found = {
        str(file.parent.relative_to(ROOT)).replace("/", ".") for p in PACKAGES for file in (ROOT / p).rglob("__init__.py")
    }
    shipped = {"suites", "zoo_hyperparams", "zoo_hyperparams.paper"}
    assert listed == found | {f"sb3_por.shipped.{folder}" for folder in shipped}


def test_every_import_is_a_declared_dependency(options):
    extras = options["options.extras_require"]
    optional = [extras[name] for name in ("ray", "human", "demos", "hub")]
    declared = set(requirements("\n".join([options["options"]["install_requires"], *optional])))
    imported = set()
    for file in (file for package in PACKAGES for file in (ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                imported.add(node.module.partition(".")[0])
    foreign = imported - set(sys.stdlib_module_names) - set(PACKAGES)
    # pybullet_utils and eglRenderer come in pybullet's wheel.
    foreign -= {"pybullet_utils"}
    assert {canonical(DISTRIBUTIONS.get(name, name)) for name in foreign} <= {canonical(name) for name in declared}


def test_constraints_pin_what_is_declared_within_its_range(options):
    pinned = requirements((ROOT / "constraints.txt").read_text())
    extras = options["options.extras_require"]
    texts = (options["options"]["install_requires"], *(extras[name] for name in ("test", "dev", "docs")))
    declared = requirements("\n".join(texts))
    assert set(declared) <= set(pinned)
    for name, requirement in declared.items():
        (pin,) = pinned[name].specifier
        assert pin.operator == "==" and requirement.specifier.contains(pin.version), name


def test_the_page_of_installation_lists_the_extras(options):
    listed = re.findall(r"^\| `(\w+)` \| ", (ROOT / "docs" / "install.md").read_text(), re.MULTILINE)
    assert set(options["options.extras_require"]) <= set(listed)


@pytest.mark.parametrize("version", ["3.10", "3.11", "3.12", "3.13"])
@pytest.mark.parametrize("system, machine", [("linux", "x86_64"), ("linux", "aarch64"), ("darwin", "arm64")])
def test_one_pybullet_is_chosen_everywhere(options, system, machine, version):
    declared = requirements(options["options"]["install_requires"])
    environment = {"sys_platform": system, "platform_machine": machine, "python_version": version}
    chosen = {name for name in ("pybullet", "pybullet-arm64") if declared[name].marker.evaluate(environment)}
    original = (system, machine) == ("linux", "x86_64") and version in ("3.10", "3.11")
    assert chosen == {"pybullet" if original else "pybullet-arm64"}


@pytest.fixture(scope="module")
def sdist(tmp_path_factory):
    """The source distribution of the files that git knows or would add."""
    source = tmp_path_factory.mktemp("source")
    files = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True
    ).stdout.split("\0")
    for name in filter(None, files):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, source / name)
    script = "from setuptools.build_meta import build_sdist; build_sdist('dist')"
    subprocess.run([sys.executable, "-c", script], cwd=source, check=True, capture_output=True)
    (archive,) = (source / "dist").glob("sb3_por-*.tar.gz")
    return archive


@pytest.fixture(scope="module")
def installed(sdist, tmp_path_factory):
    """An environment that holds the wheel of the source distribution alone, away from the checkout."""
    folder = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip"]
    wheel = [*pip, "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", folder, sdist]
    subprocess.run(wheel, check=True, capture_output=True)
    venv.create(folder / "venv", symlinks=True)
    (built,) = folder.glob("sb3_por-*.whl")
    install = [*pip, "--python", folder / "venv/bin/python", "install", "-q", "--no-deps", "--no-index", built]
    # With a checkout on PYTHONPATH pip would take the package for installed.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run(install, env=environment, check=True, capture_output=True)
    return folder / "venv"


def run_installed(installed, *command):
    """Run a command of the environment; what the packages depend on comes from this one."""
    environment = os.environ | {"PYTHONPATH": sysconfig.get_path("purelib")}
    command = [installed / "bin" / command[0], *command[1:]]
    return subprocess.run(command, cwd=installed, env=environment, capture_output=True, text=True)


def test_a_source_distribution_holds_the_suites_and_the_constraints(sdist):
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"constraints.txt", *(f"suites/{path.name}" for path in (ROOT / "suites").glob("*.yml"))} <= names


def test_an_installed_package_holds_its_data_and_finds_it(installed):
    (package,) = installed.glob("lib/python*/site-packages/sb3_por")
    for folder in ("suites", "zoo_hyperparams"):
        there, here = (
            {path.relative_to(data): path.read_bytes() for path in data.rglob("*.yml")}
            for data in (package / "shipped" / folder, ROOT / folder)
        )
        assert there == here
    assert (package / "analysis" / "report.html.jinja").is_file()
    assert all((package.parent / name / "py.typed").is_file() for name in PACKAGES)
    script = "from sb3_por.training.hyperparameters import hyperparameter_file as f; print(f('sac_por', 'PourWater-v0'))"
    shown = run_installed(installed, "python", "-c", script)
    assert shown.stdout.strip() == str(package / "shipped" / "zoo_hyperparams" / "sac_por.yml"), shown.stderr


def test_an_installed_package_runs_its_suites_by_name(installed):
    shown = run_installed(installed, "sb3-por", "suite", "smoke", "--dry-run")
    assert shown.returncode == 0 and shown.stdout.startswith("new "), shown.stderr
    assert "runs/smoke/" in shown.stdout


@pytest.mark.parametrize("script", ["sb3-por", "sb3-por-train"])
def test_an_installed_package_has_its_commands(installed, script):
    shown = run_installed(installed, script, "--help")
    assert shown.returncode == 0 and shown.stdout.startswith("usage: "), shown.stderr


def test_make_refuses_an_unsupported_interpreter_and_says_what_to_type(tmp_path):
    python = tmp_path / "python3.14"
    python.write_text("#!/bin/sh\nexit 1\n")  # what the Makefile's check of a version answers
    python.chmod(0o755)
    for interpreter, named in ((str(python), str(python)), ("", "what was found")):
        done = subprocess.run(
            ["make", "train", f"VENV={tmp_path}/venv", f"PYTHON={interpreter}"], cwd=ROOT, capture_output=True, text=True
        )
        assert done.returncode == 2
        assert f"make: {named} is not Python 3.10 to 3.13" in done.stderr
        assert "uv python install 3.13\n" in done.stderr
        assert 'make train PYTHON="$(uv python find 3.13)"\n' in done.stderr
        assert not (tmp_path / "venv").exists()


def test_make_installs_once(tmp_path):
    """An up-to-date stamp means nothing to do; a newer setup.cfg means an installation."""
    (tmp_path / "venv" / "bin").mkdir(parents=True)
    (tmp_path / "venv" / "bin" / "pip").touch()
    stamp = tmp_path / "venv" / ".installed-test"
    command = ["make", "-n", "train", f"VENV={tmp_path}/venv", "ARGS=-n 5"]
    # Without what a make that runs these tests tells the makes below it.
    env = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}
    fresh = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True).stdout
    assert "pip install -q -c constraints.txt -e '.[test,docs]'" in fresh
    stamp.touch()
    again = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True).stdout
    assert again.strip() == f"{tmp_path}/venv/bin/python train.py --algo sac_por --env PourWater-v0 -n 5"


def test_every_task_and_algorithm_is_listed():
    """In a table, with a page of its own."""
    docs = ROOT / "docs"
    for table, folder, names in (("algorithms.md", "algorithms", {*ALGORITHMS, "sac"}), ("tasks/README.md", "tasks", ENV_IDS)):
        listed = re.findall(r"^\| \[`([^`]+)`\]\((\S+)\) \|", (docs / table).read_text(), re.MULTILINE)
        assert {name for name, _ in listed} == set(names)
        for name, page in listed:
            assert (docs / table).parent / page == docs / folder / f"{name}.md" and (docs / folder / f"{name}.md").is_file()


def test_the_readme_begins_with_the_commands():
    text = (ROOT / "README.md").read_text()
    assert 0 <= text.index("make demo") < text.index("make train") < text.index("make test") < 2500
