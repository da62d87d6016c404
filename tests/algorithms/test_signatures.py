"""The classes that users import spell out their arguments: SB3's order, one documentation and one default for each name."""

import inspect
import re

import pytest
from sb3_contrib import TQC
from stable_baselines3 import SAC

import sb3_por
from sb3_por.objectives.base import Objective

CLASSES = [value for name in sb3_por.__all__ if isinstance(value := getattr(sb3_por, name), type)]
PARENTS = {cls: TQC if issubclass(cls, TQC) else SAC for cls in CLASSES}
#: Defaults in which a class differs from the one that it extends
OTHER_DEFAULTS = {("SACDrQ", "n_augmentations"), ("SACDrQ", "n_target_augmentations")}


def parameters(cls):
    return inspect.signature(cls).parameters


def documentation(cls):
    """Name of each documented argument: its text, in the order of the docstring."""
    _, *entries = re.split(r"^ *:param ", inspect.getdoc(cls), flags=re.MULTILINE)
    return {name: " ".join(text.split()) for name, _, text in (entry.partition(":") for entry in entries)}


@pytest.mark.parametrize("cls", CLASSES)
def test_every_argument_is_spelled_out_and_documented(cls):
    assert all(p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in parameters(cls).values())
    assert list(documentation(cls)) == list(parameters(cls))


@pytest.mark.parametrize("cls", CLASSES)
def test_positional_arguments_are_those_of_sb3(cls):
    positional = [name for name, p in parameters(cls).items() if p.kind == p.POSITIONAL_OR_KEYWORD]
    assert positional == list(parameters(PARENTS[cls]))


@pytest.mark.parametrize("cls", CLASSES)
def test_what_is_repeated_is_the_same(cls):
    base = sb3_por.VisualTQC if issubclass(cls, TQC) else sb3_por.VisualSAC
    for other in (base, sb3_por.SACPOR):
        shared = parameters(cls).keys() & parameters(other).keys()
        for name in shared:
            assert documentation(cls)[name] == documentation(other)[name], name
            if not {(cls.__name__, name), (other.__name__, name)} & OTHER_DEFAULTS:
                assert parameters(cls)[name].default == parameters(other)[name].default, name
    assert parameters(base).keys() <= parameters(cls).keys()


@pytest.mark.parametrize("cls", [cls for cls in CLASSES if cls.objective_class is not None])
def test_every_argument_of_the_objective_is_one_of_the_algorithm(cls):
    assert issubclass(cls.objective_class, Objective)
    for name in cls.objective_class.arguments():
        default = inspect.signature(cls.objective_class).parameters[name].default
        assert parameters(cls)[name].default == default, name


@pytest.mark.parametrize("cls", CLASSES)
def test_every_argument_reaches_the_model(cls):
    """Arguments become attributes of the same names, as in SB3; a value that is not the default gets through."""
    values = {
        name: {bool: not p.default, int: 3, float: 0.25}[type(p.default)]
        for name, p in parameters(cls).items()
        if p.kind == p.KEYWORD_ONLY and type(p.default) in (bool, int, float)
    }
    model = cls("MlpPolicy", "Pendulum-v1", buffer_size=10, _init_setup_model=False, **values)
    assert {name: getattr(model, name) for name in values} == values
