"""Loading of a stranger's model: rebuilt from JSON values and tensors, so that nothing in its file is run."""

import itertools
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common import torch_layers
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from torch import nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from sb3_por.common import plain
from sb3_por.common.checks import check_types
from sb3_por.common.errors import UserError, check_known, one_line, short
from sb3_por.evaluation.model_files import LOADABLE, candidates, model_file
from sb3_por.evaluation.plain_files import may_lack, read_json, read_tensors
from sb3_por.runs.environment import TrainingEnvironment, without_ranker
from sb3_por.runs.folder import ClassName
from sb3_por.visual import encoders
from softbody_envs.registration import task_class

#: Class name -> algorithm that a file may name
ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"DDPG": TD3, **{cls.__name__: cls for cls in LOADABLE.values()}}
_ACTIVATIONS = (nn.ReLU, nn.LeakyReLU, nn.ELU, nn.SELU, nn.CELU, nn.GELU, nn.SiLU, nn.Mish, nn.Tanh, nn.Sigmoid, nn.Softplus)
_EXTRACTORS = (torch_layers.FlattenExtractor, torch_layers.NatureCNN, torch_layers.CombinedExtractor)
_ENCODERS = (encoders.ConvEncoder, encoders.VectorEncoder, encoders.CombinedEncoder)
#: Dotted path -> class that the arguments of a policy may name
CLASSES = {plain.class_path(cls): cls for cls in (*_ACTIVATIONS, *_EXTRACTORS, *_ENCODERS, nn.Identity)}
#: Wrappers that a model may have been trained inside: they touch no file and call no function that they are given
WRAPPERS = (
    *(f"softbody_envs.wrappers.{name}" for name in ("ActionRepeat", "Distraction")),
    *(f"softbody_envs.wrappers.{name}" for name in ("ProgressReward", "ShowQuantity", "SuccessReward")),
    *(f"gymnasium.wrappers.{name}" for name in ("ClipAction", "ClipReward", "RescaleAction", "RescaleObservation")),
    *(f"gymnasium.wrappers.{name}" for name in ("FlattenObservation", "GrayscaleObservation", "ResizeObservation")),
    *(
        f"gymnasium.wrappers.{name}"
        for name in ("FrameStackObservation", "MaxAndSkipObservation", "TimeAwareObservation", "TimeLimit")
    ),
    *(f"stable_baselines3.common.atari_wrappers.{name}" for name in ("AtariWrapper", "MaxAndSkipEnv", "WarpFrame")),
    "sb3_contrib.common.wrappers.TimeFeatureWrapper",
    "stable_baselines3.common.vec_env.VecFrameStack",
)
#: Most values among the arguments of an environment
MAX_VALUES = 10_000
#: Most parameters of a policy, and most tensors of them: a number in a file cannot fill the memory
MAX_PARAMETERS, MAX_PARAMETER_TENSORS = 2**26, 10_000


def load_safe(
    path: str | Path, env: str | gym.Env | VecEnv | None = None, device: th.device | str = "auto", algo: str | None = None
) -> BaseAlgorithm:
    """
    Load a model that somebody else saved, without running anything that its file holds.

    Algorithm, policy and their arguments come from names and numbers in the file, weights from its tensors. Pickled values are
    never read; a model that cannot be rebuilt without them is refused. The model plays: its optimizers are new, its replay
    buffer holds one transition, and a file of ``export`` has no Q networks, and other networks that only learning needs.

    :param path: A model's ``.zip``, or a run folder, which stands for its ``best_model.zip``
    :param env: Environment, or its id, that gives the spaces; needed for files that do not describe them
    :param device: PyTorch device
    :param algo: Name of the algorithm, for files that do not name it
    :return: The model
    :raises UserError: If something in the file is not plain, not known or too large; names it
    """
    path = model_file(path)
    with failing_in_one_line(path):
        return _load(path, env, device, algo)


@contextmanager
def failing_in_one_line(path: Path) -> Iterator[None]:
    """
    A stranger's file may fail in any way; none of them is worth a traceback.

    :param path: File that is read inside
    :raises UserError: If anything is raised inside
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise UserError(f"{path} cannot be loaded safely: {one_line(error)[:200]}") from error


def is_plain(data: dict[str, Any]) -> bool:
    """
    :param data: JSON values of a model's file
    :return: Whether ``save_plain`` wrote it, so that there is nothing in it that could be run
    """
    return plain.ATTRIBUTE in data and "policy_class" not in data


def check_environment(made_of: TrainingEnvironment) -> None:
    """
    :param made_of: A stranger's description of an environment
    :raises UserError: If making it could run code of the stranger's choice; names the part
    """
    for spec in (without_ranker(made_of.env_wrapper), made_of.vec_env_wrapper):
        for one in spec if isinstance(spec, list) else [spec] if spec else []:
            name, arguments = next(iter(one.items())) if isinstance(one, dict) and len(one) == 1 else (one, {})
            if name not in WRAPPERS:
                raise UserError(f"the wrapper {short(name)} is refused; safe loading knows {', '.join(WRAPPERS)}")
            _check_values(f"arguments of {name}", arguments or {}, texts=False)
    kwargs = dict(made_of.env_kwargs or {})
    if kwargs.get("render_mode") == "rgb_array":
        del kwargs["render_mode"]  # which every environment knows
    _check_values("env_kwargs", kwargs, texts=task_class(made_of.env_id) is not None)


def _load(path: Path, env: Any, device: th.device | str, algo: str | None) -> BaseAlgorithm:
    data, tensors = read_json(path), read_tensors(path)
    made_of = TrainingEnvironment.of_data(data)
    if made_of is not None:
        check_environment(made_of)
    model = _rebuild(path, _descriptions(path, data, env, algo), tensors, device)
    steps = data.get("num_timesteps")
    model.num_timesteps = steps if isinstance(steps, int) else 0
    if made_of is not None:
        made_of.store_in(model)
    return model


def _descriptions(path: Path, data: dict[str, Any], env: Any, algo: str | None) -> Iterator[dict[str, Any]]:
    """The file's description; for a file without one, what it may have been, the likeliest first."""
    found = data.get(plain.ATTRIBUTE)
    if isinstance(found, dict):
        if algo is not None:
            check_known("algorithm", algo, LOADABLE)
            if LOADABLE[algo] is not ALGORITHMS.get(found.get("algorithm", "")):
                raise UserError(f"{path} is a model of {found.get('algorithm')!r:.40}, not of {algo}")
        yield found
        return
    if env is None:
        raise UserError(f"{path} does not describe its spaces: give the environment that it was trained in")
    observed, acted = _spaces(env)
    names = [algo] if algo is not None else candidates(path, data)
    check_known("algorithm", names[0] if names else "none", LOADABLE)
    fitting = ["MultiInputPolicy"] if isinstance(observed, spaces.Dict) else ["MlpPolicy"]
    fitting = ["CnnPolicy", *fitting] if is_image_space(observed) else fitting
    for name, policy in itertools.product(names, fitting):
        if policy in LOADABLE[name].policy_aliases:
            yield {
                "algorithm": LOADABLE[name].__name__,
                "policy": policy,
                "policy_kwargs": _readable(data.get("policy_kwargs")),
                "arguments": plain.arguments(LOADABLE[name], data),
                "observation_space": plain.describe_space(observed),
                "action_space": plain.describe_space(acted),
            }


def _readable(policy_kwargs: Any) -> dict[str, Any]:
    """The arguments that SB3 writes readably, also beside a pickle of them; classes as ``<class 'path'>``."""
    readable = {}
    for name, value in policy_kwargs.items() if isinstance(policy_kwargs, dict) else []:
        if name not in plain.POLICY_LEFT_OUT and not name.startswith(":"):
            match = re.fullmatch(r"<class '([\w.]+)'>", value) if isinstance(value, str) else None
            readable[name] = {plain.CLASS: match[1]} if match else value
    return readable


def _rebuild(
    path: Path, descriptions: Iterator[dict[str, Any]], tensors: dict[str, th.Tensor], device: th.device | str
) -> BaseAlgorithm:
    """The first described model whose networks are those of the tensors."""
    problem: Exception | None = None
    for description in descriptions:
        try:
            model = _build(description, device)
            _load_networks(model, tensors)
            return model
        except (AssertionError, AttributeError, KeyError, TypeError, ValueError, RuntimeError, MemoryError) as error:
            problem = problem or error
    raise UserError(f"{path} cannot be loaded safely: {one_line(problem or KeyError('policy'))[:300]}") from problem


def _build(description: dict[str, Any], device: th.device | str) -> BaseAlgorithm:
    check_known("algorithm", str(description["algorithm"]), ALGORITHMS)
    algorithm: Any = ALGORITHMS[description["algorithm"]]
    check_known(f"policy of {algorithm.__name__}", str(description["policy"]), algorithm.policy_aliases)
    if not isinstance(description["arguments"], dict) or not isinstance(description["policy_kwargs"], dict):
        raise UserError("arguments that are no names and values are refused")
    arguments = plain.arguments(algorithm, description["arguments"])
    if unknown := [name for name in description["arguments"] if name not in arguments]:
        raise UserError(f"the argument {unknown[0]!r:.80} of {algorithm.__name__} is refused: it is not plain, or not known")
    check_types(algorithm, arguments)
    policy_kwargs = {name: _value(f"policy_kwargs: {name}", part) for name, part in description["policy_kwargs"].items()}
    with _bounded():
        model: Any = algorithm(
            description["policy"], None, policy_kwargs=policy_kwargs, device=device, _init_setup_model=False, **arguments
        )
        model.observation_space = plain.make_space(description["observation_space"])
        model.action_space = plain.make_space(description["action_space"])
        model.n_envs = 1
        if hasattr(model, "buffer_size"):
            model.buffer_size = 1
        if getattr(model, "target_entropy", None) == "auto":  # which SB3 computes from an environment
            model.target_entropy = -float(np.prod(model.action_space.shape))
        model._setup_model()
    setattr(model, plain.ATTRIBUTE, description)
    return model


def _load_networks(model: BaseAlgorithm, tensors: dict[str, th.Tensor]) -> None:
    own = model.policy.state_dict()
    missing, unexpected = set(own) - set(tensors), set(tensors) - set(own)
    if unexpected or not may_lack(model.policy, missing):
        names = sorted(unexpected or missing)
        raise ValueError(f"{len(names)} tensors do not fit a {type(model.policy).__name__}, {names[0]!r:.80} among them")
    targets = {name: tensors[name.replace("critic_target.", "critic.", 1)] for name in missing & _of_target(tensors)}
    model.policy.load_state_dict({**own, **targets, **tensors})
    vars(model)[plain.LACKS_VALUES] = bool(missing)


def _of_target(tensors: dict[str, th.Tensor]) -> set[str]:
    """Names that the target's copies of a critic's tensors have."""
    return {name.replace("critic.", "critic_target.", 1) for name in tensors if name.startswith("critic.")}


@contextmanager
def _bounded() -> Iterator[None]:
    """
    :raises UserError: If networks with too many parameters are built inside
    """
    built = {"tensors": 0, "parameters": 0}

    def count(module: nn.Module, name: str, parameter: nn.Parameter | None) -> None:
        built["tensors"] += 1
        built["parameters"] += 0 if parameter is None else parameter.numel()
        if built["tensors"] > MAX_PARAMETER_TENSORS or built["parameters"] > MAX_PARAMETERS:
            raise UserError(f"the policy is refused: its arguments ask for more than {MAX_PARAMETERS:,} parameters")

    handle = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        handle.remove()


def _spaces(env: str | gym.Env | VecEnv) -> tuple[spaces.Space, spaces.Space]:
    """Spaces of an environment as a model sees them: images with channels first."""
    if isinstance(env, str):
        made = gym.make(env)
        wrapped: VecEnv = DummyVecEnv([lambda: made])
    else:
        wrapped = env if isinstance(env, VecEnv) else DummyVecEnv([lambda: env])
    seen = BaseAlgorithm._wrap_env(wrapped, verbose=0, monitor_wrapper=False)
    try:
        return seen.observation_space, seen.action_space
    finally:
        if isinstance(env, str):
            seen.close()


def _value(name: str, value: Any) -> Any:
    """A plain argument of a policy, with known classes in the place of their names."""
    if isinstance(value, dict):
        if set(value) == {plain.CLASS}:
            if value[plain.CLASS] not in CLASSES:
                raise UserError(f"{name} is refused: safe loading does not know the class {value[plain.CLASS]!r:.80}")
            return CLASSES[value[plain.CLASS]]
        if set(value) == {plain.UNKNOWN}:
            raise UserError(f"{name} is refused: it is a {value[plain.UNKNOWN]!r:.80}, which has no plain form")
        if ":serialized:" in value:
            raise UserError(f"{name} is refused: it is pickled")
        return {key: _value(f"{name}.{key}", part) for key, part in value.items()}
    return [_value(name, part) for part in value] if isinstance(value, list) else value


def _check_values(what: str, value: Any, texts: bool = True) -> None:
    """
    :raises UserError: If a stranger's arguments are not plain values, or too many: in YAML, few lines can be a great many
    """
    left = [(what, value)]
    for _ in range(MAX_VALUES):
        if not left:
            return
        where, part = left.pop()
        if isinstance(part, dict) and all(type(key) is str for key in part):
            left += [(f"{what}: {key}", one) for key, one in part.items()]
        elif isinstance(part, (list, tuple)):
            left += [(where, one) for one in part]
        elif isinstance(part, ClassName) or not isinstance(part, (bool, int, float, str, type(None))):
            raise UserError(f"{where} is refused: {short(part)} is no plain value")
        elif isinstance(part, str) and not texts:
            raise UserError(f"{where} is refused: what the text {short(part)} does there is not known")
    raise UserError(f"{what} is refused: more than {MAX_VALUES} values")
