"""Plain descriptions of models and spaces: JSON values from which they are made anew, without pickled code."""

import inspect
import json
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

#: Attribute of a model that holds its description; JSON in its ``.zip``
ATTRIBUTE = "plain_description"
#: Attribute of a model whose file holds no Q networks, so that its own are as they were initialized
LACKS_VALUES = "lacks_values"
#: Arguments of an algorithm that have no place in a description: they concern learning, memory or the machine
LEFT_OUT = (
    *("policy", "env", "policy_kwargs", "device", "_init_setup_model", "seed", "verbose", "tensorboard_log"),
    *("buffer_size", "replay_buffer_class", "replay_buffer_kwargs", "optimize_memory_usage"),
    *("rollout_buffer_class", "rollout_buffer_kwargs", "action_noise", "train_freq", "overlap", "precision", "compile_mode"),
)
#: Arguments of an algorithm that name places of the machine: a description has None for them
PLACES = ("demos",)
#: Arguments of a policy that have no place in a description: an algorithm gives them, or only learning needs them
POLICY_LEFT_OUT = ("objective_class", "objective_kwargs", "optimizer_class", "optimizer_kwargs")
#: Most values of one array in a space
MAX_VALUES = 2**24
_SCALARS = (bool, int, float, str, type(None))
#: Key of a dict that stands for a class; its value is the dotted path
CLASS = "class"
#: Key of a dict that stands for a tuple; its value is a list
TUPLE = "tuple"
#: Key of a dict that stands for an object that has no plain form; its value is the object's type
UNKNOWN = "unknown"


def describe(model: BaseAlgorithm) -> dict[str, Any]:
    """
    :param model: A model with its networks
    :return: JSON values: names of algorithm and policy, their arguments, the two spaces
    """
    aliases = [name for name, policy in model.policy_aliases.items() if policy is model.policy_class]
    policy_kwargs = {name: value for name, value in (model.policy_kwargs or {}).items() if name not in POLICY_LEFT_OUT}
    values = {name: None if name in PLACES else value for name, value in vars(model).items()}
    return {
        "algorithm": type(model).__name__,
        "policy": aliases[0] if aliases else class_path(model.policy_class),
        "policy_kwargs": plain(policy_kwargs),
        "arguments": arguments(type(model), values),
        "observation_space": describe_space(model.observation_space),
        "action_space": describe_space(model.action_space),
    }


def arguments(algorithm: type[BaseAlgorithm], values: dict[str, Any]) -> dict[str, Any]:
    """
    :param algorithm: Class of a model
    :param values: Its attributes, or those in its file
    :return: The arguments of its constructor that are numbers, texts, None, or lists of such, but those in ``LEFT_OUT``
    """
    names = [name for name in inspect.signature(algorithm).parameters if name not in LEFT_OUT]
    numbers = {name: value.item() for name, value in values.items() if isinstance(value, np.generic)}
    return {name: value for name, value in {**values, **numbers}.items() if name in names and _is_simple(value)}


def _is_simple(value: Any) -> bool:
    """Whether a value is a scalar or a list of such, at any depth."""
    return isinstance(value, _SCALARS) or (isinstance(value, list) and all(map(_is_simple, value)))


def plain(value: Any) -> Any:
    """
    :param value: Arguments
    :return: JSON values; ``{"class": path}`` for a class, ``{"unknown": type}`` for an object that has no plain form
    """
    if isinstance(value, _SCALARS):
        return value
    if isinstance(value, (list, tuple)):
        return [plain(part) for part in value]
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, type):
        return {CLASS: class_path(value)}
    return {UNKNOWN: class_path(type(value))}


def with_marked_tuples(value: Any) -> Any:
    """
    :param value: Arguments
    :return: The same with ``{"tuple": [...]}`` in the place of each tuple, of which JSON would make a list
    """
    if isinstance(value, tuple):
        return {TUPLE: [with_marked_tuples(part) for part in value]}
    if isinstance(value, list):
        return [with_marked_tuples(part) for part in value]
    if isinstance(value, dict):
        return {key: with_marked_tuples(part) for key, part in value.items()}
    return value


def with_tuples(value: Any) -> Any:
    """
    :param value: What ``with_marked_tuples`` returned, perhaps read from JSON
    :return: The arguments
    """
    if isinstance(value, list):
        return [with_tuples(part) for part in value]
    if isinstance(value, dict):
        if value.keys() == {TUPLE} and isinstance(value[TUPLE], list):
            return tuple(with_tuples(value[TUPLE]))
        return {key: with_tuples(part) for key, part in value.items()}
    return value


def is_kept(value: Any) -> bool:
    """
    :param value: Arguments
    :return: Whether JSON keeps them, once tuples are marked
    """
    try:
        return bool(with_tuples(json.loads(json.dumps(with_marked_tuples(value)))) == value)
    except (TypeError, ValueError, RecursionError):
        return False


def class_path(cls: type) -> str:
    """The dotted path of a class."""
    return f"{cls.__module__}.{cls.__qualname__}"


def describe_space(space: spaces.Space) -> dict[str, Any]:
    """
    :param space: A space
    :return: JSON values from which ``make_space`` makes it
    """
    if isinstance(space, spaces.Box):
        bounds = {"low": _bound(space.low), "high": _bound(space.high)}
        return {"type": "Box", "shape": list(space.shape), "dtype": str(space.dtype), **bounds}
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
    if isinstance(space, spaces.MultiDiscrete):
        return {"type": "MultiDiscrete", "nvec": space.nvec.tolist()}
    if isinstance(space, spaces.MultiBinary):
        return {"type": "MultiBinary", "n": space.n if isinstance(space.n, int) else list(space.n)}
    if isinstance(space, spaces.Dict):
        return {"type": "Dict", "spaces": {name: describe_space(part) for name, part in space.spaces.items()}}
    return {UNKNOWN: class_path(type(space))}


def make_space(description: Any) -> spaces.Space:
    """
    :param description: Of ``describe_space``, perhaps of a stranger
    :return: The space
    :raises ValueError: If it describes no space
    """
    try:
        return _make_space(description)
    except (KeyError, TypeError, OverflowError, AssertionError) as error:
        raise ValueError(f"no description of a space: {error!r:.100}") from error


def _make_space(description: dict[str, Any]) -> spaces.Space:
    kind = description["type"]
    if kind == "Box":
        shape = tuple(_count(n) for n in description["shape"])
        dtype = np.dtype(str(description["dtype"]))
        if dtype.kind not in "fiub" or int(np.prod(shape, dtype=np.float64)) > MAX_VALUES:
            raise ValueError(f"a space of {shape} values of {dtype} is refused")
        low, high = (np.broadcast_to(np.array(description[name], dtype), shape) for name in ("low", "high"))
        return spaces.Box(low, high, shape, dtype.type)
    if kind == "Discrete":
        return spaces.Discrete(_count(description["n"]), start=int(description["start"]))
    if kind == "MultiDiscrete":
        return spaces.MultiDiscrete(np.array(description["nvec"], np.int64))
    if kind == "MultiBinary":
        n = description["n"]
        return spaces.MultiBinary([_count(one) for one in n] if isinstance(n, list) else _count(n))
    if kind == "Dict":
        return spaces.Dict({str(name): _make_space(part) for name, part in description["spaces"].items()})
    raise ValueError(f"a space of the type {kind!r:.40} is refused")


def _bound(values: np.ndarray) -> Any:
    """One number if all are equal."""
    equal = values.size > 0 and bool((values == values.flat[0]).all())
    return (values.flat[0] if equal else values).tolist()


def _count(value: Any) -> int:
    if not isinstance(value, int) or not 0 <= value <= MAX_VALUES:
        raise ValueError(f"a space of the size {value!r:.40} is refused")
    return value
