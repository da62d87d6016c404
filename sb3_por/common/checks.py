"""Checks of constructor arguments: of their types, from the annotations, and of their ranges."""

import inspect
import math
import types
import typing
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import Any

#: Annotations that can be checked, and what each accepts: numpy's numbers are numbers, and a bool is no number.
_ACCEPTED: dict[Any, type] = {float: Real, int: Integral}


def check_types(function: Callable[..., Any], values: Mapping[str, Any]) -> None:
    """
    :param function: A function, or a class whose constructor is checked
    :param values: Name of a parameter: its value
    :raises TypeError: If a value does not have the type that its parameter is annotated with
    """
    hints = typing.get_type_hints(function.__init__ if inspect.isclass(function) else function)
    for name, value in values.items():
        if name in hints and not _is_a(value, hints[name]):
            expected = inspect.formatannotation(hints[name]).replace("NoneType", "None")
            raise TypeError(f"{name} must be {expected}, got {value!r}")


def check_ranges(values: Mapping[str, Any], ranges: Mapping[str, tuple[float, float]]) -> None:
    """
    :param values: Name of a parameter: its value
    :param ranges: Name of a parameter: its smallest and its largest value
    :raises ValueError: If a number is outside of its range, or not a number
    """
    for name, (low, high) in ranges.items():
        value = values.get(name)
        if isinstance(value, Real) and not low <= float(value) <= high:
            limit = f"at least {low}" if math.isinf(high) else f"between {low} and {high}"
            raise ValueError(f"{name} must be {limit}, got {value!r}")


def _is_a(value: Any, hint: Any) -> bool:
    """Whether a value has an annotated type; True for annotations that cannot be checked."""
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_is_a(value, part) for part in typing.get_args(hint))
    if origin is type:
        return isinstance(value, type) and issubclass(value, typing.get_args(hint)[0])
    if origin in (dict, list, tuple):
        return isinstance(value, origin)
    if origin is not None or not isinstance(hint, type):
        return callable(value) if origin is Callable else True
    if hint in _ACCEPTED and isinstance(value, bool):
        return False
    return isinstance(value, _ACCEPTED.get(hint, hint))
