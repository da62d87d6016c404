"""What is quick stays quick: help and errors do not wait for PyTorch."""

import ast
import configparser
import subprocess
import sys
from pathlib import Path

import pytest

import sb3_por
from sb3_por.analysis.figures import KINDS
from sb3_por.analysis.names import FIGURES

ROOT = Path(__file__).parents[2]
SLOW = ("torch", "stable_baselines3", "matplotlib", "pandas", "numpy")
SCRIPT = """
import contextlib, io, resource, runpy, sys
sys.argv = ["sb3_por", *{arguments}]
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    runpy.run_module("sb3_por", run_name="__main__")
usage = resource.getrusage(resource.RUSAGE_SELF)
print([name for name in {slow} if name in sys.modules], usage.ru_utime + usage.ru_stime)
"""


@pytest.mark.parametrize("arguments", [["--help"], *([name, "--help"] for name in ("evaluate", "plot", "report", "suite"))])
def test_help_takes_less_than_half_a_second_of_cpu_time(arguments):
    script = SCRIPT.format(arguments=arguments, slow=SLOW)
    shown = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    loaded, seconds = shown.rsplit(" ", 1)
    assert loaded == "[]" and float(seconds) < 0.5


def test_errors_can_be_imported_without_torch():
    script = f"import sys, sb3_por.common.errors; print([name for name in {SLOW} if name in sys.modules])"
    shown = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert shown.strip() == "[]"


def test_a_worker_of_a_cluster_does_not_wait_for_torch():
    """What ``suites/ray_task.py`` imports besides Ray."""
    imported = set()
    for node in ast.walk(ast.parse((ROOT / "sb3_por" / "suites" / "ray_task.py").read_text())):
        if isinstance(node, ast.ImportFrom):
            imported.add(node.module)
    own = sorted(name for name in imported if name.startswith("sb3_por"))
    slow = ("torch", "stable_baselines3", "matplotlib", "pandas", "gymnasium")
    script = f"import sys, {', '.join(own)}; print([name for name in {slow} if name in sys.modules])"
    shown = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert len(own) >= 3 and shown.strip() == "[]"


def test_public_names_are_what_they_name():
    for name in sb3_por.__all__:
        value = getattr(sb3_por, name)
        assert name in dir(sb3_por) and getattr(value, "__name__", name) == name
    assert set(sb3_por.ALGORITHMS.values()) <= {getattr(sb3_por, name) for name in sb3_por.__all__ if name != "ALGORITHMS"}
    with pytest.raises(AttributeError, match="module 'sb3_por' has no attribute 'SACPOOR'"):
        _ = sb3_por.SACPOOR


def test_the_version_is_that_of_setup_cfg():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    assert sb3_por.__version__ == config["metadata"]["version"]


def test_every_figure_can_be_named_on_the_command_line():
    assert list(KINDS) == FIGURES
