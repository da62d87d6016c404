"""Settings of a run keep tuples and classes, and reading them imports nothing."""

import sys
from collections import OrderedDict

import pytest
import yaml

from sb3_por.common.errors import UserError
from sb3_por.runs.environment import TrainingEnvironment, import_wrappers, read_normalization
from sb3_por.runs.folder import dump_settings, import_names, parse_settings, read_settings, run_arguments

SETTINGS = {"k": 3, "frames": (1, 2), "wrappers": [{"a.B": {"kind": OrderedDict, "nested": ({"of": dict},)}}], "none": None}


def test_tuples_and_classes_come_back():
    assert import_names(parse_settings(dump_settings(SETTINGS))) == SETTINGS
    # Written again before anything was imported
    assert import_names(parse_settings(dump_settings(parse_settings(dump_settings(SETTINGS))))) == SETTINGS


@pytest.fixture
def strangers_module(tmp_path, monkeypatch):
    """A module that leaves a file behind when it is imported, and settings that name a class of it."""
    (tmp_path / "strangers.py").write_text("import pathlib\npathlib.Path('ran').touch()\nclass Wrapper: pass\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield "!!python/name:strangers.Wrapper ''"
    sys.modules.pop("strangers", None)


def test_reading_runs_nothing(strangers_module, tmp_path):
    (tmp_path / "Env-v0").mkdir()
    for name in ("args.yml", "config.yml"):
        (tmp_path / "Env-v0" / name).write_text(f"env: Env-v0\nalgo: {strangers_module}\nenv_wrapper: {strangers_module}\n")
    settings = read_settings(tmp_path / "Env-v0" / "config.yml")
    assert run_arguments(tmp_path)["env"] == settings["env"] == "Env-v0"
    TrainingEnvironment.of_data({"training_environment": dump_settings({"env_id": "Env-v0", "env_wrapper": settings["algo"]})})
    assert "strangers" not in sys.modules and not (tmp_path / "ran").exists()
    # An evaluation needs the wrapper
    assert import_wrappers(settings["env_wrapper"]) is not None
    assert (tmp_path / "ran").exists()


def test_a_model_whose_text_is_damaged_tells_nothing():
    for text in ("junk: [", "env_id: E-v0\nfoo: 1", "env_id: E-v0\nenv_kwargs: 3", "- 1", 3):
        assert TrainingEnvironment.of_data({"training_environment": text}) is None
    assert TrainingEnvironment.of_data({"environment_made_of": {"foo": 1}}) is None
    with pytest.raises(UserError, match="env_kwargs must be arguments of an environment by name, got 3"):
        TrainingEnvironment.of_settings("E-v0", {"env_kwargs": 3})


def test_a_class_that_does_not_exist_is_named():
    with pytest.raises(UserError, match=r"cannot import no_such\.Thing"):
        import_names(parse_settings("x: !!python/name:no_such.Thing ''"))


def test_settings_of_the_rl_zoo_are_read():
    settings = {"env_wrapper": [{"a.B": {"shape": (1, 2)}}], "env_kwargs": OrderedDict(size=3), "gamma": 0.9}
    assert parse_settings(yaml.dump(OrderedDict(settings))) == settings


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (True, True),
        ("True", True),
        ("False", False),
        (None, False),
        ({"norm_obs": False}, {"norm_obs": False}),
        ("{'norm_obs': False, 'clip_obs': -1.5}", {"norm_obs": False, "clip_obs": -1.5}),
        (" dict(norm_obs=True, norm_obs_keys=['a', 'b'])", {"norm_obs": True, "norm_obs_keys": ["a", "b"]}),
        ("dict()", True),
        ({}, True),
    ],
)
def test_normalization_is_read_as_the_zoo_writes_it(value, expected):
    assert read_normalization(value) == expected
    assert TrainingEnvironment.of_settings("E-v0", {"normalize": value}).normalize == expected


@pytest.mark.parametrize(
    "value",
    [
        "open('ran', 'w')",
        "dict(norm_obs=open('ran', 'w'))",
        "dict(**open('ran', 'w').__dict__)",
        "dict([('norm_obs', True)])",
        "[open('ran', 'w')]",
        "norm_obs",
        "dict(",
        "",
        "9" * 5000,
        "(" * 500,
        3,
        {3: 4},
        ["norm_obs"],
    ],
)
def test_other_normalization_is_refused_and_nothing_is_run(value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="normalize must be True, False or arguments of VecNormalize"):
        read_normalization(value)
    assert not list(tmp_path.iterdir())
