"""Suites: a file that names algorithms, environments and seeds becomes runs, in as many processes as the machine has cores."""

import ctypes
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from rich.console import Console
from rich.live import Live
from rich.table import Table

import softbody_envs  # noqa: F401  (registers its ids)
from sb3_por.errors import UserError, check_known, one_line
from sb3_por.loading import LOADABLE
from sb3_por.runs import is_finished, progress, run_arguments
from sb3_por.scores import read_scores, write_csv

#: Seconds between two looks at the running processes.
POLL_S = 0.5
#: Lines of a failed run's log that are shown.
LOG_LINES = 8


@dataclass(frozen=True)
class Suite:
    """
    What a suite file says. Every combination of algorithm, environment and seed is a run.

    :param algos: names of algorithms
    :param envs: environment ids
    :param seeds: seeds
    :param n_timesteps: steps of each run; those of the settings if ``None``
    :param eval_freq: steps between two evaluations
    :param eval_episodes: episodes of an evaluation
    :param save_freq: steps between two checkpoints
    :param hyperparams: changes to the settings of all runs
    :param overrides: algorithm, environment, or ``algorithm/environment`` -> changes to the settings of its runs
    :param workers: processes at a time; the number of cores divided by ``threads`` if ``None``
    :param threads: PyTorch threads of a process
    """

    algos: list[str]
    envs: list[str]
    seeds: list[int]
    n_timesteps: int | None = None
    eval_freq: int = 2000
    eval_episodes: int = 10
    save_freq: int = 10_000
    hyperparams: dict[str, Any] = field(default_factory=dict)
    overrides: dict[str, dict[str, Any]] = field(default_factory=dict)
    workers: int | None = None
    threads: int = 1


@dataclass(frozen=True)
class Run:
    """
    One run of a suite.

    :param folder: ``<root>/<env>/<algo>/seed_<seed>``; the zoo's layout begins in it
    :param flags: of train.py, besides algorithm, environment, seed and folder
    """

    algo: str
    env: str
    seed: int
    folder: Path
    flags: tuple[str, ...]

    @property
    def name(self) -> str:
        return f"{self.env}/{self.algo}/seed_{self.seed}"

    @property
    def run_folder(self) -> Path:
        """Where train.py writes."""
        return self.folder / self.algo / f"{self.env}_1"

    @property
    def log(self) -> Path:
        return self.folder / "log.txt"

    def state(self) -> str:
        """``"finished"``, ``"interrupted"``, or ``"new"``."""
        if is_finished(self.run_folder, self.env):
            return "finished"
        return "interrupted" if run_arguments(self.run_folder) else "new"

    def command(self) -> list[str]:
        """What starts the run or goes on with it."""
        train = [sys.executable, "-m", "sb3_por.zoo"]
        if self.state() == "interrupted":
            return [*train, "--resume", str(self.run_folder)]
        named = ["--algo", self.algo, "--env", self.env, "--seed", str(self.seed), "-f", str(self.folder)]
        return [*train, *named, *self.flags]


# -- the file ----------------------------------------------------------------------------------------------------------


def read_suite(path: str | Path) -> Suite:
    """
    :param path: a YAML file with the fields of ``Suite``
    :raises UserError: names the line and what to write there
    """
    path = Path(path)
    try:
        text = path.read_text()
        node = yaml.compose(text)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    except yaml.YAMLError as error:
        raise UserError(f"{path} is not YAML: {one_line(error)}") from error
    if not isinstance(node, yaml.MappingNode) or not node.value:
        raise UserError(f"{path} is empty; a suite has at least algos, envs and seeds")
    lines = _check_keys(path, node)
    fields = yaml.safe_load(text)
    for name in ("algos", "envs", "seeds"):
        if name not in fields:
            raise UserError(f"{path} has no {name}; add a line such as {name}: [{_EXAMPLES[name]}]")
    for name, value in fields.items():
        at = f"{path}:{lines[name]}"
        _check_type(at, name, value)
        if name in ("algos", "envs"):
            known = LOADABLE if name == "algos" else gym.registry
            for one in value:
                _at(at, check_known, "algorithm" if name == "algos" else "environment", one, known)
        if name == "overrides":
            keys = {*fields["algos"], *fields["envs"], *(f"{a}/{e}" for a in fields["algos"] for e in fields["envs"])}
            for one in value:
                _at(at, check_known, "run", one, keys)
    return Suite(**fields)


_EXAMPLES = {"algos": "sac_por, sac", "envs": "PourWater-v0", "seeds": "0, 1, 2"}


def _check_keys(path: Path, node: yaml.MappingNode) -> dict[str, int]:
    """Line of each field. YAML itself lets the second of two equal keys win."""
    lines: dict[str, int] = {}
    for key, _ in node.value:
        line = key.start_mark.line + 1
        if key.value in lines:
            raise UserError(f"{path}:{line}: {key.value} stands on line {lines[key.value]}, too; keep one")
        _at(f"{path}:{line}", check_known, "key", key.value, Suite.__dataclass_fields__)
        lines[key.value] = line
    return lines


def _check_type(at: str, name: str, value: Any) -> None:
    if name in ("algos", "envs", "seeds"):
        kind: type = int if name == "seeds" else str
        if not isinstance(value, list) or not value or not all(type(one) is kind for one in value):
            raise UserError(f"{at}: {name} must be a list, such as [{_EXAMPLES[name]}]")
        if len(set(value)) < len(value):
            doubled = next(one for one in value if value.count(one) > 1)
            raise UserError(f"{at}: {name} has {doubled} twice; keep one")
    elif name in ("hyperparams", "overrides"):
        inner = value.values() if name == "overrides" and isinstance(value, dict) else [value]
        if not all(isinstance(one, dict) for one in [value, *inner]):
            example = "{por_coef: 0.1}" if name == "hyperparams" else "{sac_por: {por_coef: 0.1}}"
            raise UserError(f"{at}: {name} must be a mapping, such as {example}")
    elif type(value) is not int or value < 1:
        raise UserError(f"{at}: {name} must be a positive integer, got {value!r}")


def _at(place: str, check: Callable[..., None], *arguments: Any) -> None:
    """Put the place before the message of a check."""
    try:
        check(*arguments)
    except UserError as error:
        raise UserError(f"{place}: {error}") from error


def suite_runs(suite: Suite, root: Path) -> list[Run]:
    """
    :param root: the suite's folder
    :return: every run; seeds outermost, so that early results are of all algorithms and environments
    """
    frequencies = {"--eval-freq": suite.eval_freq, "--eval-episodes": suite.eval_episodes, "--save-freq": suite.save_freq}
    if suite.n_timesteps is not None:
        frequencies["-n"] = suite.n_timesteps
    common = [part for flag, value in frequencies.items() for part in (flag, str(value))]
    runs = []
    for seed in suite.seeds:
        for env in suite.envs:
            for algo in suite.algos:
                changes = dict(suite.hyperparams)
                for key in (env, algo, f"{algo}/{env}"):
                    changes |= suite.overrides.get(key, {})
                params = ["-params", *(f"{name}:{value!r}" for name, value in changes.items())] if changes else []
                flags = [*common, "--num-threads", str(suite.threads), *params]
                runs.append(Run(algo, env, seed, root / env / algo / f"seed_{seed}", tuple(flags)))
    return runs


# -- local processes ---------------------------------------------------------------------------------------------------


class LocalPool:
    """
    Runs that are processes of this machine.

    :param runs: the runs; finished ones are skipped, interrupted ones go on
    :param workers: processes at a time
    :param threads: threads of a process
    """

    def __init__(self, runs: list[Run], workers: int, threads: int) -> None:
        self.runs = runs
        self.workers = workers
        self.threads = threads
        self.states = {run: run.state() for run in runs}
        self.started: dict[Run, tuple[float, int]] = {}
        self._processes: dict[Run, subprocess.Popen] = {}

    def work(self) -> Iterator[None]:
        """Start and collect processes until all runs are done; yields now and then."""
        waiting = [run for run in self.runs if self.states[run] != "finished"]
        try:
            while waiting or self._processes:
                while waiting and len(self._processes) < self.workers:
                    self._start(waiting.pop(0))
                for run, process in list(self._processes.items()):
                    if process.poll() is not None:
                        del self._processes[run]
                        self.states[run] = "finished" if process.returncode == 0 else "failed"
                yield
                if self._processes:
                    time.sleep(POLL_S)
        finally:
            self._stop()

    def _start(self, run: Run) -> None:
        command = run.command()
        if run.state() == "new":
            # What a process left that was killed before it had written its settings.
            shutil.rmtree(run.run_folder, ignore_errors=True)
        run.folder.mkdir(parents=True, exist_ok=True)
        threads = {name: str(self.threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")}
        with open(run.log, "ab") as log:
            self._processes[run] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=os.environ | threads,
                start_new_session=True,
                preexec_fn=_die_with_parent,
            )
        self.states[run] = "running"
        self.started[run] = time.monotonic(), progress(run.run_folder)[0]

    def _stop(self) -> None:
        """Ask what still runs to save and stop."""
        for process in self._processes.values():
            process.terminate()
        for run, process in self._processes.items():
            process.wait()
            self.states[run] = "interrupted"


def _die_with_parent() -> None:
    """A killed suite must not leave processes behind that its next start would run a second time (prctl, Linux)."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def progress_table(pool: LocalPool) -> Table:
    """Runs, steps, steps a second, the latest score and the time left."""
    table = Table("run", "state", "steps", "steps/s", "score", "time left")
    for run in pool.runs:
        steps, score = progress(run.run_folder)
        total = _total_steps(run)
        speed = left = ""
        if pool.states[run] == "running":
            begin, steps_before = pool.started[run]
            rate = (steps - steps_before) / max(time.monotonic() - begin, 1e-3)
            speed = f"{rate:.0f}"
            left = f"{(total - steps) / rate / 60:.0f} min" if rate > 0 and total else ""
        shown = f"{steps}/{total}" if total else str(steps)
        table.add_row(run.name, pool.states[run], shown, speed, "" if score is None else f"{score:.3f}", left)
    return table


def _total_steps(run: Run) -> int:
    flags = list(run.flags)
    if "-n" in flags:
        return int(flags[flags.index("-n") + 1])
    return 0


def run_suite(path: str | Path, root: str | Path = "runs", dry_run: bool = False) -> int:
    """
    Do what is left to do of a suite.

    :param path: the suite file
    :param root: the runs go to ``<root>/<name of the file>/<env>/<algo>/seed_<seed>``
    :param dry_run: print the runs and their states, and do nothing
    :return: 0 if every run is finished, 1 if some failed
    :raises UserError: if the file is wrong
    """
    suite = read_suite(path)
    folder = Path(root) / Path(path).stem
    runs = suite_runs(suite, folder)
    workers = suite.workers or max((os.cpu_count() or 1) // suite.threads, 1)
    pool = LocalPool(runs, workers, suite.threads)
    console = Console(stderr=True)
    if dry_run:
        for run in runs:
            print(f"{pool.states[run]:12} {' '.join(run.command())}")
        return 0
    handler = signal.signal(signal.SIGTERM, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    try:
        _work(pool, console)
    finally:
        signal.signal(signal.SIGTERM, handler)
    return _summary(pool, folder, console)


def _work(pool: LocalPool, console: Console) -> None:
    if console.is_terminal:
        with Live(progress_table(pool), console=console, refresh_per_second=2) as live:
            for _ in pool.work():
                live.update(progress_table(pool))
        return
    shown: dict[Run, str] = {}
    for _ in pool.work():
        for run, state in pool.states.items():
            if shown.get(run) != state:
                print(f"{state:12} {run.name}", file=sys.stderr, flush=True)
                shown[run] = state


def _summary(pool: LocalPool, folder: Path, console: Console) -> int:
    """Gather the scores; name the failed runs with the end of their logs."""
    console.print(progress_table(pool))
    if any(run.run_folder.joinpath("evaluations.npz").exists() for run in pool.runs):
        write_csv(read_scores([folder]), folder / "scores.csv")
        print(folder / "scores.csv")
    failed = [run for run, state in pool.states.items() if state == "failed"]
    for run in failed:
        print(f"failed: {run.name}, {run.log}:", file=sys.stderr)
        for line in run.log.read_text(errors="replace").splitlines()[-LOG_LINES:]:
            print(f"  {line}", file=sys.stderr)
    return 1 if failed else 0
