"""Arguments of the wrong type or out of range are named before anything runs."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from toy_envs import DotEnv

from sb3_por import SACPOR, SACSPR
from sb3_por.common.checks import check_ranges, check_types


def function(a: int, b: float = 1.0, c: str | None = None, d: float | Callable[[float], float] = 1.0, e: type[int] = int, f=1):
    pass


@pytest.mark.parametrize(
    "values",
    [
        dict(a=1, b=2, c="x", d=abs, e=bool, f="anything"),
        dict(a=np.int64(1), b=np.float32(2), c=None, d=3),
        dict(unknown=object()),
    ],
)
def test_values_that_fit(values):
    check_types(function, values)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (dict(a="1"), "int"),
        (dict(a=1.5), "int"),
        (dict(a=True), "int"),
        (dict(b="x"), "float"),
        (dict(c=1), "str | None"),
        (dict(d="lin_1"), "float | "),
        (dict(e=str), "type[int]"),
        (dict(e=3), "type[int]"),
    ],
)
def test_values_that_do_not_fit(values, expected):
    (name,) = values
    with pytest.raises(TypeError) as error:
        check_types(function, values)
    assert str(error.value).startswith(f"{name} must be {expected}")


@pytest.mark.parametrize(
    ("value", "fits"), [(0, True), (1, True), (-0.1, False), (1.1, False), (math.nan, False), ("x", True)]
)
def test_ranges(value, fits):
    if fits:
        return check_ranges({"a": value}, {"a": (0, 1)})
    with pytest.raises(ValueError, match="a must be between 0 and 1, got"):
        check_ranges({"a": value}, {"a": (0, 1)})


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        (dict(por_coef=[1]), "por_coef must be str | float"),
        (dict(por_coef="x"), "por_coef must be a number, 'auto', or a ratio of gradients above 0 such as 'auto_0.1', got 'x'"),
        (dict(por_coef="auto_"), "por_coef must be a number"),
        (dict(por_coef="auto_x"), "por_coef must be a number"),
        (dict(por_coef="auto_0"), "por_coef must be a number"),
        (dict(por_coef="auto_nan"), "por_coef must be a number"),
        (dict(por_coef="automatic_1"), "por_coef must be a number"),
        (dict(learning_rate="fast"), "learning_rate must be float"),
        (dict(batch_size=8.5), "batch_size must be int"),
        (dict(pairing=3), "pairing must be str"),
        (dict(random_k="yes"), "random_k must be bool"),
        (dict(replay_buffer_kwargs=[1]), "replay_buffer_kwargs must be dict"),
        (dict(replay_buffer_class="ReplayBuffer"), "replay_buffer_class must be type"),
        (dict(actor_update_interval=0), "actor_update_interval must be a finite number of at least 1"),
        (dict(diagnostics_interval=0), "diagnostics_interval must be a finite number of at least 1"),
        (dict(n_augmentations=0), "n_augmentations must be a finite number of at least 1"),
        (dict(gamma=1.5), "gamma must be between 0 and 1"),
        (dict(tau=-0.1), "tau must be between 0 and 1"),
        (dict(reward_scale=math.inf), "reward_scale must be"),
        (dict(por_coef=math.nan), "por_coef must be"),
    ],
)
def test_an_algorithm_names_the_argument(kwargs, message):
    with pytest.raises((TypeError, ValueError), match=message):
        SACPOR("CnnPolicy", DotEnv(), **{"buffer_size": 10, **kwargs})


def test_arguments_of_a_loaded_model_are_checked_too(tmp_path):
    SACSPR("CnnPolicy", DotEnv(), buffer_size=10).save(tmp_path / "model.zip")
    with pytest.raises(TypeError, match="horizon must be int, got '5'"):
        SACSPR.load(tmp_path / "model.zip", horizon="5")
