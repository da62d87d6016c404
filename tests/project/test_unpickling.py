"""Nothing unpickles, imports or evaluates what comes from a file, but for places that are listed here with their reason."""

import ast
from pathlib import Path

import pytest
import yaml

from sb3_por.runs import folder

ROOT = Path(__file__).parents[2]
FILES = [ROOT / "train.py", *ROOT.glob("sb3_por/**/*.py"), *ROOT.glob("softbody_envs/**/*.py")]

#: Modules whose loading functions run code of the file
PICKLES = {"pickle", "_pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
#: Functions that run code which their argument names or holds
RUN = {
    *("eval", "exec", "__import__", "import_module", "resolve_name", "run_path", "run_module"),
    *("read_pickle", "load_from_pkl", "load_replay_buffer", "_load_pretrained_agent", "json_to_data"),
    *("unsafe_load", "unsafe_load_all", "full_load", "full_load_all"),
}
#: Methods called ``load`` that read plain values; a ranker's file holds arrays and JSON
PLAIN = {"json", "Ranker"}

#: Place: who told it to
TOLD = {
    # -- what the user names as a model to be used: with a note if train.py did not write it here, and --safe runs nothing
    ("sb3_por/evaluation/loading.py", "load_model", "load"): "SB3's own files; after note_foreign, and not for plain files",
    ("sb3_por/common/random_state.py", "load", "load"): "SB3's method, extended",
    ("sb3_por/visual/algorithm.py", "load", "load"): "SB3's method, extended",
    ("sb3_por/evaluation/environment.py", "_normalize", "load"): "statistics of the same model",
    # -- train.py --resume and -i: after note_foreign
    ("sb3_por/training/experiment.py", "_load_pretrained_agent", "_load_pretrained_agent"): "the model that the user resumes",
    ("sb3_por/training/experiment.py", "_normalized", "load"): "statistics of the best model that the user begins with",
    ("sb3_por/runs/checkpoints.py", "restore_buffer", "pickle.loads"): "its replay buffer",
    ("sb3_por/runs/checkpoints.py", "read_rng_state", "pickle.loads"): "its random states",
    ("sb3_por/visual/algorithm.py", "load_replay_buffer", "load_replay_buffer"): "SB3's method, extended",
    # -- names, not code
    ("sb3_por/evaluation/loading.py", "import_packages", "import_module"): "--gym-packages, and those of a run without --safe",
    ("sb3_por/runs/folder.py", "import_names", "resolve_name"): "wrappers of a run without --safe",
    ("sb3_por/__init__.py", "__getattr__", "import_module"): "a fixed table",
    ("sb3_por/runs/environment.py", "_import_wrapper", "resolve_name"): "wrappers of a run; checked before with --safe",
    ("softbody_envs/experts/__init__.py", "make_expert", "resolve_name"): "a fixed table",
    ("softbody_envs/registration.py", "_find_spec", "import_module"): "the package in --env PACKAGE:ID",
}


def name_of(node):
    """``a.b`` of an expression."""
    if isinstance(node, ast.Attribute):
        return f"{name_of(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else "?"


def keyword(call, name):
    """The constant that a call gives for an argument by name."""
    found = [one.value for one in call.keywords if one.arg == name]
    return found[0].value if found and isinstance(found[0], ast.Constant) else None


def runs_code(call):
    """The name under which a call is listed; None if it cannot run what it reads."""
    name = name_of(call.func)
    first, _, last = name.rpartition(".")
    base = first.rpartition(".")[2]
    if base in PICKLES:
        return None if last in ("dump", "dumps", "PickleBuffer", "HIGHEST_PROTOCOL") else name
    if last == "load_from_zip_file":
        return None if keyword(call, "load_data") is False else last
    if last != "load":
        return last if last in RUN else None
    if base in ("th", "torch"):
        return None if keyword(call, "weights_only") is True else name
    if base in ("np", "numpy"):
        return None if keyword(call, "allow_pickle") in (None, False) else name
    if base == "yaml":
        return None if len(call.args) == 2 and name_of(call.args[1]) in ("_Loader", "yaml.SafeLoader") else name
    return None if base in PLAIN else last


def places(source, file):
    """(file, function, call) of what can run code in a module."""

    def visit(node, function):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            function = node.name
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in PICKLES:
            yield file, function, f"from {node.module}"
        if isinstance(node, ast.Call) and (called := runs_code(node)):
            yield file, function, called
        for child in ast.iter_child_nodes(node):
            yield from visit(child, function)

    return set(visit(ast.parse(source), ""))


def test_code_of_others_is_run_in_the_listed_places_alone():
    found = {place for file in FILES for place in places(file.read_text(), str(file.relative_to(ROOT)))}
    assert len(FILES) > 100
    assert found - set(TOLD) == set(), "not listed"
    assert set(TOLD) - found == set(), "listed, and not there any more"


@pytest.mark.parametrize(
    "source",
    [
        "pickle.loads(x)",
        "pickle.Unpickler(x)",
        "from pickle import loads",
        "cloudpickle.load(x)",
        "th.load(x)",
        "th.load(x, weights_only=False)",
        "torch.load(x, weights_only=flag)",
        "np.load(x, allow_pickle=True)",
        "yaml.load(x, yaml.Loader)",
        "yaml.load(x, Loader=yaml.UnsafeLoader)",
        "yaml.unsafe_load(x)",
        "pd.read_pickle(x)",
        "SAC.load(x)",
        "LOADABLE[name].load(x)",
        "load_from_zip_file(x)",
        "eval(x)",
        "importlib.import_module(x)",
    ],
)
def test_what_runs_code_is_found(source):
    assert places(source, "file")


@pytest.mark.parametrize(
    "source",
    [
        "pickle.dumps(x)",
        "th.load(x, weights_only=True)",
        "np.load(x)",
        "yaml.safe_load(x)",
        "json.loads(x)",
        "json.load(x)",
        "ast.literal_eval(x)",
        "load_from_zip_file(x, load_data=False)",
    ],
)
def test_what_reads_plain_values_is_not_found(source):
    assert not places(source, "file")


def test_the_loader_of_settings_makes_no_objects():
    assert issubclass(folder._Loader, yaml.SafeLoader)
    with pytest.raises(ValueError, match="could not determine a constructor"):
        folder.parse_settings("a: !!python/object/apply:os.system ['true']")
