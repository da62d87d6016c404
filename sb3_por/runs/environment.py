"""Parts of a run's training environment, as its settings name them, and their import."""

import ast
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import VecEnv

from sb3_por.common.errors import UserError, one_line, short
from sb3_por.common.plain import with_tuples
from sb3_por.runs.folder import dump_settings, import_names, parse_settings
from sb3_por.visual.made_of import made_of

#: A function that wraps an environment
EnvWrapper = Callable[[gym.Env], gym.Env]
#: A function that wraps vectorized environments
VecEnvWrapper = Callable[[VecEnv], VecEnv]
#: Attribute of a model that holds the text of a ``TrainingEnvironment``; saved in its ``.zip``
ATTRIBUTE = "training_environment"
#: Paths of the wrapper that adds a ranker's potential to the rewards: that which is recorded, and that which is documented
RANKED_PROGRESS = "sb3_por.ranking.progress.RankedProgress"
RANKED_PROGRESS_PATHS = (RANKED_PROGRESS, "sb3_por.ranking.RankedProgress")


@dataclass(frozen=True)
class TrainingEnvironment:
    """
    The parts of a run's hyperparameters that decide what a policy sees and how its actions act.

    :param env_id: Gymnasium id
    :param env_kwargs: Arguments of the environment's constructor
    :param env_wrapper: Wrappers of each environment, see :func:`import_wrappers`
    :param vec_env_wrapper: Wrappers of the vectorized environments, in the same form
    :param frame_stack: Number of stacked frames
    :param normalize: Whether ``VecNormalize`` was used, or its arguments
    :param unknown: Names of wrappers and arguments that cannot be made again
    """

    env_id: str
    env_kwargs: dict[str, Any] | None = None
    env_wrapper: Any = None
    vec_env_wrapper: Any = None
    frame_stack: int | None = None
    normalize: Any = None
    unknown: list[str] | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.env_kwargs, dict | None):
            raise UserError(f"env_kwargs must be arguments of an environment by name, got {self.env_kwargs!r}")

    @classmethod
    def of_settings(cls, env_id: str, settings: dict[str, Any]) -> "TrainingEnvironment":
        """
        :param env_id: Gymnasium id
        :param settings: Hyperparameters of a run
        :return: The part of them that concerns the environment
        :raises UserError: If ``normalize`` is not understood
        """
        names = [field.name for field in fields(cls) if field.name != "env_id"]
        parts = {name: settings.get(name) for name in names}
        return cls(env_id, **parts | {"normalize": read_normalization(settings.get("normalize"))})

    @classmethod
    def of_model(cls, model: Any) -> "TrainingEnvironment | None":
        """
        :param model: An SB3 model
        :return: What ``train.py`` or ``learn()`` stored in it, or what its environments tell; None if that is unknown
        """
        if not hasattr(model, "__dict__"):
            return None
        stored = cls.of_data(vars(model))
        described = made_of(vars(model).get("env")) if stored is None else None
        return stored if described is None else cls(**with_tuples(described))

    @classmethod
    def of_data(cls, data: dict[str, Any]) -> "TrainingEnvironment | None":
        """
        :param data: Attributes of an SB3 model
        :return: As :meth:`of_model`; None if the text cannot be read, too
        """
        text, described = data.get(ATTRIBUTE), data.get("environment_made_of")
        try:
            if isinstance(text, str):
                return cls(**parse_settings(text))
            return cls(**with_tuples(described)) if isinstance(described, dict) else None
        except (TypeError, ValueError, RecursionError):
            return None

    @property
    def normalizes_observations(self) -> bool:
        """Whether a policy needs the statistics of ``VecNormalize``."""
        kwargs = self.normalize if isinstance(self.normalize, dict) else {}
        return bool(self.normalize) and kwargs.get("norm_obs", True)

    def __str__(self) -> str:
        """Wrappers and normalization, for messages."""
        named = {
            "env_wrapper": self.env_wrapper,
            "vec_env_wrapper": self.vec_env_wrapper,
            "normalize": self.normalize,
            "unknown": self.unknown,
        }
        return f"{self.env_id} with " + ", ".join(f"{name} {value}" for name, value in named.items() if value)

    def store_in(self, model: Any) -> None:
        """
        Make ``model.save()`` store this in the ``.zip``, so that a model without its run's folder can be evaluated.

        :param model: An SB3 model
        """
        setattr(model, ATTRIBUTE, dump_settings(asdict(self)))


def read_normalization(value: Any) -> bool | dict[str, Any]:
    """
    Read the setting ``normalize``. The RL Zoo's files have Python as text there, ``"dict(norm_obs=True)"``: literals are read,
    and nothing is run.

    :param value: Whether to use ``VecNormalize``, or its arguments, or a text of either
    :return: The same without text
    :raises UserError: If it is neither
    """
    parsed = value
    if isinstance(value, str):
        try:
            parsed = ast.literal_eval(_DictCalls().visit(ast.parse(value.strip(), mode="eval")))
        except (MemoryError, RecursionError, SyntaxError, TypeError, ValueError):
            parsed = value
    if parsed is None or isinstance(parsed, bool):
        return bool(parsed)
    if isinstance(parsed, dict) and all(isinstance(key, str) for key in parsed):
        return parsed or True
    raise UserError(f"normalize must be True, False or arguments of VecNormalize, {{'norm_obs': False}}, got {short(value)}")


class _DictCalls(ast.NodeTransformer):
    """Replaces ``dict(a=1)`` by ``{"a": 1}``."""

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        if not (isinstance(node.func, ast.Name) and node.func.id == "dict") or node.args:
            return node
        keys = [None if keyword.arg is None else ast.Constant(keyword.arg) for keyword in node.keywords]
        return ast.copy_location(ast.Dict(list(keys), [keyword.value for keyword in node.keywords]), node)


def import_wrappers(spec: Any) -> Callable[[Any], Any] | None:
    """
    Import wrappers by their paths.

    :param spec: The path of a wrapper, ``{path: arguments}``, or a list of them, the innermost first, as in the RL Zoo
    :return: A function that puts them around an environment; None for none
    :raises UserError: If one cannot be imported
    """
    if not spec:
        return None
    wrappers = [_import_wrapper(one) for one in _as_list(spec)]

    def wrap(env: Any) -> Any:
        for wrapper in wrappers:
            env = wrapper(env)
        return env

    return wrap


def with_ranker(spec: Any, ranker: str, arguments: dict[str, Any]) -> list[Any]:
    """
    :param spec: Wrappers, see :func:`import_wrappers`
    :param ranker: File of a ranker
    :param arguments: Other arguments of ``RankedProgress``
    :return: The same with ``RankedProgress`` outermost, in the place of any other
    """
    return [*without_ranker(spec), {RANKED_PROGRESS: {"ranker": ranker, **arguments}}]


def without_ranker(spec: Any) -> list[Any]:
    """
    :param spec: Wrappers, see :func:`import_wrappers`
    :return: The same without ``RankedProgress``, which changes rewards alone and needs a file: scores are the task's own
    """
    return [one for one in _as_list(spec) if not any(path in _paths(one) for path in RANKED_PROGRESS_PATHS)]


def rankers(spec: Any) -> list[str]:
    """
    :param spec: Wrappers, see :func:`import_wrappers`
    :return: The files of the rankers among them
    """
    arguments = [one.get(path) for one in _as_list(spec) if isinstance(one, dict) for path in RANKED_PROGRESS_PATHS]
    return [str(one["ranker"]) for one in arguments if isinstance(one, dict) and "ranker" in one]


def with_rankers_by_name(spec: Any) -> list[Any]:
    """
    :param spec: Wrappers, see :func:`import_wrappers`
    :return: The same with the name of each ranker's file instead of its path
    """

    def with_name(wrapper: Any) -> Any:
        if not rankers([wrapper]):
            return wrapper
        ((path, arguments),) = wrapper.items()
        return {path: {**arguments, "ranker": Path(arguments["ranker"]).name}}

    return [with_name(one) for one in _as_list(spec)]


def _paths(wrapper: Any) -> list[Any]:
    return [*wrapper] if isinstance(wrapper, dict) else [wrapper]


def _as_list(spec: Any) -> list[Any]:
    return spec if isinstance(spec, list) else [spec] if spec else []


def _import_wrapper(spec: Any) -> Callable[[Any], Any]:
    spec = import_names(spec)
    path, arguments = next(iter(spec.items())) if isinstance(spec, dict) and len(spec) == 1 else (spec, None)
    try:
        return partial(resolve_name(path) if isinstance(path, str) else path, **(arguments or {}))
    except (AttributeError, ImportError, TypeError, ValueError) as error:
        raise UserError(f"cannot import the wrapper {path}: {one_line(error)}") from error
