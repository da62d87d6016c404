"""Checks of constructor arguments: of their types, from the annotations, and of their ranges."""

import inspect
import sys
import types
import typing
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import Any

#: Types of which numpy has its own
_NUMBERS: dict[Any, type] = {float: Real, int: Integral}


def check_types(function: Callable[..., Any], values: Mapping[str, Any]) -> None:
    """
    :param function: A function, or a class whose constructor is meant
    :param values: Name of a parameter: its value
    :raises TypeError: If a value does not have the type that its parameter is annotated with
    """
    for name, parameter in inspect.signature(function).parameters.items():
        if name in values and not _fits(values[name], parameter.annotation):
            expected = inspect.formatannotation(parameter.annotation)
            raise TypeError(f"{name} must be {expected}, got {values[name]!r}")


def check_ranges(values: Mapping[str, Any], ranges: Mapping[str, tuple[float, float]]) -> None:
    """
    :param values: Name of a parameter: its value. A tuple such as ``(1, "episode")`` stands for its first element, a schedule
        for its value at the start; other values that are not numbers are passed over
    :param ranges: Name of a parameter: its smallest and its largest value
    :raises ValueError: If a number is out of its range, or NaN
    """
    for name, (low, high) in ranges.items():
        value = values.get(name)
        value = value[0] if isinstance(value, tuple) and value else value(1.0) if callable(value) else value
        if isinstance(value, Real) and not low <= float(value) <= high:
            limit = f"between {low:g} and {high:g}" if high < sys.float_info.max else f"a finite number of at least {low:g}"
            raise ValueError(f"{name} must be {limit}, got {value!r}")


def _fits(value: Any, annotation: Any) -> bool:
    """Whether a value has the annotated type; True for annotations that cannot be checked."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is type:
        return inspect.isclass(value) and issubclass(value, parts[0])
    if origin is Callable:
        return callable(value)
    expected = annotation if origin is None else origin
    if annotation is inspect.Parameter.empty or not inspect.isclass(expected):
        return True
    if expected in _NUMBERS:
        return isinstance(value, _NUMBERS[expected]) and not isinstance(value, bool)
    return value is None if expected is types.NoneType else isinstance(value, expected)
