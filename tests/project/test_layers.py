"""A module imports only what stands below it, and only training imports the RL Zoo."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
#: From the bottom to the top; ``from sb3_por import NAME`` counts as algorithms
LAYERS = (
    "common",
    "objectives",
    "acceleration",
    "demonstrations",
    "visual",
    "ranking",
    "algorithms",
    "runs",
    "evaluation",
    "training",
    "analysis",
    "sharing",
    "suites",
    "commands",
)
FILES = [*ROOT.glob("sb3_por/*/*.py"), *ROOT.glob("softbody_envs/**/*.py")]


def imported_modules(file):
    """Absolute names of all modules that a file imports, also inside of functions."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            yield from (node.module,) if node.module != "sb3_por" else ("sb3_por.algorithms",)


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_imports_go_down(file):
    package, layer = file.relative_to(ROOT).parts[:2]
    for name in imported_modules(file):
        top, _, rest = name.partition(".")
        if package == "softbody_envs":
            assert top != "sb3_por", name
        elif top == "sb3_por":
            assert LAYERS.index(rest.partition(".")[0]) <= LAYERS.index(layer), name
        assert top != "rl_zoo3" or layer == "training", name
