"""One module owns the names in a run's folder."""

import ast
from pathlib import Path

import sb3_por
from sb3_por.runs import folder

PACKAGE = Path(sb3_por.__file__).parent


def literals(file):
    """The string constants of a module, without its docstrings."""
    tree = ast.parse(file.read_text())
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    docstrings = {node.body[0].value for node in ast.walk(tree) if isinstance(node, documented) and ast.get_docstring(node)}
    constants = (node for node in ast.walk(tree) if isinstance(node, ast.Constant) and node not in docstrings)
    # A text with spaces is a message to the user, who knows the files by their names
    return [node.value for node in constants if isinstance(node.value, str) and " " not in node.value]


def test_no_other_module_spells_a_name_out():
    names = {value for name, value in vars(folder).items() if name.isupper()}
    assert {"args.yml", "config.yml", "best_model.zip", "evaluations.npz", "vecnormalize.pkl", "log.txt"} <= names
    names -= {folder.CHECKPOINTS, folder.TENSORBOARD}  # plain words
    for file in PACKAGE.rglob("*.py"):
        if file != Path(folder.__file__):
            found = [(name, text) for text in literals(file) for name in names if name in text]
            assert not found, f"{file}: {found}"
