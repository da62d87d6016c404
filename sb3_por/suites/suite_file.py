"""Suite files: the runs that one describes, and the command of each."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml

import softbody_envs  # noqa: F401  (registers its ids)
from sb3_por.common.errors import UserError, check_known, one_line
from sb3_por.common.shipped import shipped
from sb3_por.evaluation.loading import LOADABLE, import_packages
from sb3_por.suites.run import Run
from sb3_por.training.hyperparameters import changed


@dataclass(frozen=True)
class Suite:
    """
    What a suite file says. Every combination of algorithm, environment and seed is a run.

    :param algos: names of algorithms and variants
    :param envs: environment ids
    :param seeds: seeds
    :param n_timesteps: steps of each run; those of the settings if ``None``
    :param eval_freq: steps between two evaluations
    :param eval_episodes: episodes of an evaluation
    :param save_freq: steps between two checkpoints
    :param demos: folder of demonstrations, ``<demos>/<environment>``; none if ``None``
    :param hyperparams: changes to the settings of all runs
    :param variants: name -> the algorithm (``algo``) that runs under this name, and changes to its settings
    :param overrides: algorithm, environment, or ``algorithm/environment`` -> changes to the settings of its runs
    :param gym_packages: modules that register environments
    :param workers: processes at a time on this machine; the number of cores divided by ``threads`` if ``None``
    :param threads: PyTorch threads of a run, and the CPUs that it takes of a Ray cluster
    :param gpus: GPUs that a run takes of a Ray cluster; 0.5 puts two runs on one
    """

    algos: list[str]
    envs: list[str]
    seeds: list[int]
    n_timesteps: int | None = None
    eval_freq: int = 2000
    eval_episodes: int = 10
    save_freq: int = 10_000
    demos: str | None = None
    hyperparams: dict[str, Any] = field(default_factory=dict)
    variants: dict[str, dict[str, Any]] = field(default_factory=dict)
    overrides: dict[str, dict[str, Any]] = field(default_factory=dict)
    gym_packages: list[str] = field(default_factory=list)
    workers: int | None = None
    threads: int = 1
    gpus: float = 0


def suite_runs(suite: Suite, root: Path) -> list[Run]:
    """
    :param root: the suite's folder
    :return: every run; seeds outermost, so that early results are of all algorithms and environments
    """
    frequencies = {"--eval-freq": suite.eval_freq, "--eval-episodes": suite.eval_episodes, "--save-freq": suite.save_freq}
    if suite.n_timesteps is not None:
        frequencies["-n"] = suite.n_timesteps
    common = [part for flag, value in frequencies.items() for part in (flag, str(value))]
    packages = ["--gym-packages", *suite.gym_packages] if suite.gym_packages else []
    runs = []
    for seed in suite.seeds:
        for env in suite.envs:
            for name in suite.algos:
                variant = dict(suite.variants.get(name, {}))
                algo = variant.pop("algo", name)
                # From wide to narrow: a variant is its algorithm, overrides and all, but for what makes it one.
                wide, narrow = (env, algo, f"{algo}/{env}"), (name, f"{name}/{env}") if name in suite.variants else ()
                overrides = suite.overrides
                parts = [*(overrides.get(key, {}) for key in wide), variant, *(overrides.get(key, {}) for key in narrow)]
                changes = changed(suite.hyperparams, *parts)
                params = ["-params", *(f"{name}:{value!r}" for name, value in changes.items())] if changes else []
                demos = ["--demos", str(Path(suite.demos) / env)] if suite.demos is not None else []
                flags = [*common, "--num-threads", str(suite.threads), *packages, *demos, *params]
                folder = root / env / name / f"seed_{seed}"
                runs.append(Run(algo, env, seed, folder, tuple(flags), variant=name if name in suite.variants else ""))
    return runs


# -- reading -----------------------------------------------------------------------------------------------------------

_EXAMPLES = {
    "algos": "[sac_por, sac]",
    "envs": "[PourWater-v0]",
    "seeds": "[0, 1, 2]",
    "gym_packages": "[my_package]",
    "hyperparams": "{batch_size: 128}",
    "variants": "{por_paper: {algo: sac_por, pairing: paper}}",
    "overrides": "{sac_por: {k: 3}}",
}
_REQUIRED = ("algos", "envs", "seeds")


def find_suite(name: str | Path) -> Path:
    """
    :param name: a suite file, or the name of a suite that comes with this package, such as ``"main"``
    :return: the file; one with a suffix need not exist
    :raises UserError: if it is neither; the message has the nearest name
    """
    path = Path(name)
    if path.suffix or path.is_file():
        return path
    suites = {file.stem: file for file in shipped("suites").glob("*.yml")}
    check_known("suite", str(name), suites)
    if path.with_suffix(".yml").is_file():
        raise UserError(
            f"there is {path}.yml here, and a suite {name} that comes along: type {path}.yml or {suites[str(name)]}"
        )
    return suites[str(name)]


def read_suite(path: str | Path) -> Suite:
    """
    :param path: a YAML file with the fields of ``Suite``
    :raises UserError: names the line and what to write there
    """
    path = Path(path)
    try:
        text = path.read_text()
        node = yaml.compose(text)
        values = yaml.safe_load(text)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not a text file") from error
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise UserError(f"{path}:{line}: this is not YAML: {error.problem}") from error
    except (yaml.YAMLError, ValueError) as error:
        raise UserError(f"{path} is not YAML: {one_line(error)}") from error
    example = "; ".join(f"{name}: {_EXAMPLES[name]}" for name in _REQUIRED)
    if node is None:
        raise UserError(f"{path} is empty; a suite has at least these lines: {example}")
    if not isinstance(node, yaml.MappingNode):
        raise UserError(f"{path}:1: a suite is a mapping, of at least these lines: {example}")
    _Checks(path).check(node, values)
    return Suite(**values)


class _Checks:
    """
    Finds what is wrong with a suite file, from top to bottom.

    :param path: for the messages
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def check(self, node: yaml.MappingNode, values: dict[str, Any]) -> None:
        self._no_key_twice(node)
        nodes = {key.value: value for key, value in node.value}
        for key, _ in node.value:
            self._known(key, "key", [one.name for one in fields(Suite)])
        for name in _REQUIRED:
            if name not in nodes:
                raise UserError(f"{self.path} has no {name}; add a line such as {name}: {_EXAMPLES[name]}")
        for name, of_name in nodes.items():
            self._type(of_name, name, values[name])
            self._numbers(of_name)
        import_packages(values.get("gym_packages", []))
        if "variants" in nodes:
            self._variants(nodes["variants"], values["variants"])
        algos = [*LOADABLE, *values.get("variants", {})]
        for name, kind, known in (("algos", "algorithm", algos), ("envs", "environment", list(gym.registry))):
            for one in nodes[name].value:
                self._known(one, kind, known)
        if "overrides" in nodes:
            algos, envs = [*values["algos"], *(one["algo"] for one in values.get("variants", {}).values())], values["envs"]
            for key, _ in nodes["overrides"].value:
                self._known(key, "run", [*algos, *envs, *(f"{algo}/{env}" for algo in algos for env in envs)])

    def _fail(self, node: yaml.Node, message: str) -> None:
        raise UserError(f"{self.path}:{node.start_mark.line + 1}: {message}")

    def _known(self, node: yaml.Node, kind: str, known: list[str]) -> None:
        try:
            check_known(kind, str(node.value), known)
        except UserError as error:
            self._fail(node, str(error))

    def _no_key_twice(self, node: yaml.Node) -> None:
        """YAML itself lets the second of two equal keys win."""
        if isinstance(node, yaml.MappingNode):
            lines: dict[str, int] = {}
            for key, value in node.value:
                if key.value in lines:
                    self._fail(key, f"{key.value} stands on line {lines[key.value]}, too; keep one")
                lines[key.value] = key.start_mark.line + 1
                self._no_key_twice(value)

    def _numbers(self, node: yaml.Node) -> None:
        """YAML reads 1e-3, without a point, as a string."""
        if isinstance(node, yaml.MappingNode):
            for _, value in node.value:
                self._numbers(value)
        elif isinstance(node, yaml.ScalarNode) and node.style is None and _is_number_without_point(node):
            self._fail(node, f"YAML reads {node.value} as text; write the number with a point, such as {float(node.value)!r}")

    def _type(self, node: yaml.Node, name: str, value: Any) -> None:
        if name in (*_REQUIRED, "gym_packages"):
            self._list(node, name, value)
        elif name in ("hyperparams", "variants", "overrides"):
            inner = value.values() if name != "hyperparams" and isinstance(value, dict) else []
            if not all(isinstance(one, dict) for one in [value, *inner]):
                self._fail(node, f"{name} must be a mapping, such as {_EXAMPLES[name]}")
        elif name == "demos":
            if not isinstance(value, str):
                self._fail(node, f"demos must be a folder such as demos, got {value!r}")
        elif name == "gpus":
            if type(value) not in (int, float) or not value >= 0:
                self._fail(node, f"gpus must be a number such as 1 or 0.5, got {value!r}")
        elif type(value) is not int or value < 1:
            self._fail(node, f"{name} must be a positive integer, got {value!r}")

    def _variants(self, node: yaml.MappingNode, variants: dict[Any, dict[str, Any]]) -> None:
        for (key, _), (name, settings) in zip(node.value, variants.items(), strict=True):
            if not _is_name(name):
                self._fail(key, f"{key.value} is read as {name!r}; write the variant's name in quotes")
            if name in LOADABLE:
                self._fail(key, f"{name} is an algorithm; give the variant another name")
            if "algo" not in settings:
                self._fail(key, f"{name} has no algo; write for example variants: {_EXAMPLES['variants']}")
            try:
                check_known("algorithm", str(settings["algo"]), list(LOADABLE))
            except UserError as error:
                self._fail(key, str(error))

    def _list(self, node: yaml.Node, name: str, value: Any) -> None:
        is_one = _is_seed if name == "seeds" else _is_name
        if not isinstance(value, list) or not value or not all(map(is_one, value)):
            self._fail(node, f"{name} must be a list, such as {_EXAMPLES[name]}")
        for i, one in enumerate(value):
            if one in value[:i]:
                self._fail(node.value[i], f"{name} has {one} twice; keep one")


def _is_number_without_point(node: yaml.ScalarNode) -> bool:
    if node.tag != "tag:yaml.org,2002:str" or not any(character.isdigit() for character in node.value):
        return False
    try:
        float(node.value)
    except ValueError:
        return False
    return True


def _is_seed(value: Any) -> bool:
    return type(value) is int and value >= 0


def _is_name(value: Any) -> bool:
    return isinstance(value, str)
