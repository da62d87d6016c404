"""
Play all tasks for a long time, and watch the process and the physics.

    make soak                                                   an hour
    make soak SOAK=15                                           15 minutes
    make soak ARGS=--more                                       another hour, added to the committed tables
    python benchmarks/soak.py --workers 4                       the same in worker processes
    python benchmarks/soak.py --plot                            draws from the committed tables

Random play, the expert and the best trained agent that comes with the package play an episode of every task, one after the
other, from each kind of observation. `one_process_rounds.csv` (`workers_rounds.csv` with `--workers`) has a row for each round
over all of them: memory, file descriptors, threads and temporary files of the process and its workers. `..._plays.csv` has the
control steps and the faults of each task and policy: what the environment reported (`sim_error`), what an audit of Bullet's
own positions found although nothing was reported, observations and rewards that were not finite, and the extremes of rope,
cloth and water.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np
import pandas as pd
import psutil
from matplotlib.figure import Figure
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_por.evaluation.environment import make_evaluation_env
from sb3_por.evaluation.loading import resolve
from sb3_por.sharing.agents import PRETRAINED, find_agent, read_agents
from softbody_envs import ENV_IDS
from softbody_envs.env import OBS_TYPES
from softbody_envs.experts import has_expert, make_expert
from softbody_envs.sim import cloth, rope

#: Water is inside if it is no farther away than this, m: particles that were spilled roll without friction.
MAX_WATER_DISTANCE = 20.0
#: Largest relative change of the rope's length, longest edge of the cloth in rest lengths, farthest particle in m
LIMITS = {"rope_stretch": rope.MAX_STRETCH, "edge_stretch": cloth.MAX_STRETCH, "water_distance": MAX_WATER_DISTANCE}
EXTREMES = tuple(LIMITS)
COUNTS = ("steps", "episodes", "reported", "unreported", "nan")


class Audited(gym.Wrapper):
    """
    Looks at Bullet's own positions after every step. ``info["audit"]`` has what was found since the environment was made, so
    that a wrapper that repeats actions hides nothing.

    :param env: One of the tasks
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.counts = dict.fromkeys(COUNTS, 0)
        self.extremes = dict.fromkeys(EXTREMES, np.nan)

    def reset(self, **kwargs: Any) -> Any:
        observation, info = self.env.reset(**kwargs)
        self._audit(observation, 0.0, reported=False)
        return observation, info

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.counts["steps"] += 1
        self.counts["episodes"] += terminated or truncated
        self._audit(observation, reward, reported="sim_error" in info)
        return observation, reward, terminated, truncated, info | {"audit": self.counts | self.extremes}

    def _audit(self, observation: Any, reward: Any, reported: bool) -> None:
        parts = observation.values() if isinstance(observation, dict) else [observation]
        self.counts["nan"] += not all(np.isfinite(part).all() for part in [*parts, reward])
        self.counts["reported"] += reported
        if not reported:
            found = self._extremes()
            self.counts["unreported"] += any(not value <= LIMITS[name] for name, value in found.items())
            self.extremes |= {name: float(np.fmax(self.extremes[name], value)) for name, value in found.items()}

    def _extremes(self) -> dict[str, float]:
        """Those that the task has now."""
        task: Any = self.unwrapped
        found = {}
        if hasattr(task, "rope"):
            found["rope_stretch"] = abs(rope.length(task.rope.nodes()) / rope.LENGTH - 1)
        if hasattr(task, "cloth"):
            found["edge_stretch"] = float(task.cloth.stretch().max())
        if hasattr(task, "water"):
            found["water_distance"] = float(np.abs(task.water.positions()).max())
        return found


class Random:
    """Uniform actions."""

    def __init__(self, env: VecEnv) -> None:
        self.space = env.action_space

    def act(self, observations: Any, dones: np.ndarray) -> np.ndarray:
        """Choose an action for each environment."""
        return np.stack([self.space.sample() for _ in dones])


class Scripted:
    """The task's expert, one for each environment."""

    def __init__(self, env_id: str, env: VecEnv) -> None:
        self.experts = [make_expert(env_id) for _ in range(env.num_envs)]

    def act(self, observations: Any, dones: np.ndarray) -> np.ndarray:
        """Choose an action for each environment."""
        states = observations["state"] if isinstance(observations, dict) else observations
        for expert, done in zip(self.experts, dones, strict=True):
            if done:
                expert.reset()
        return np.stack([expert.act(state) for expert, state in zip(self.experts, states, strict=True)])


class Trained:
    """A model's deterministic actions."""

    def __init__(self, model: Any) -> None:
        self.model = model

    def act(self, observations: Any, dones: np.ndarray) -> np.ndarray:
        """Choose an action for each environment."""
        return self.model.predict(observations, deterministic=True)[0]


def make(env_id: str, obs_type: str) -> gym.Env:
    """An audited environment."""
    return Audited(gym.make(env_id, obs_type=obs_type))


def plays(n_workers: int) -> list[tuple[str, str, str, Callable[[], tuple[VecEnv, Any]]]]:
    """Every task, policy and kind of observation, with a function that makes environments and policy."""

    def vectorized(env_id: str, obs_type: str) -> VecEnv:
        makers = [partial(make, env_id, obs_type)] * max(n_workers, 1)
        return SubprocVecEnv(makers) if n_workers else DummyVecEnv(makers)

    def make_random(env_id: str, obs_type: str) -> tuple[VecEnv, Any]:
        env = vectorized(env_id, obs_type)
        return env, Random(env)

    def make_scripted(env_id: str, obs_type: str) -> tuple[VecEnv, Any]:
        env = vectorized(env_id, obs_type)
        return env, Scripted(env_id, env)

    def make_trained(env_id: str) -> tuple[VecEnv, Any]:
        model, environment = resolve(find_agent(env_id).model, env_id)
        wrap = environment["env_wrapper"]
        inner = Audited if wrap is None else lambda env: wrap(Audited(env))
        return make_evaluation_env(model, env_id, **environment | {"env_wrapper": inner}), Trained(model)

    with_agent = {agent.facts["env"] for agent in read_agents(PRETRAINED)}
    found: list[tuple[str, str, str, Callable[[], tuple[VecEnv, Any]]]] = []
    for env_id in ENV_IDS:
        found += [(env_id, "random", kind, partial(make_random, env_id, kind)) for kind in OBS_TYPES]
        if has_expert(env_id):
            found += [(env_id, "expert", kind, partial(make_scripted, env_id, kind)) for kind in ("state", "dict")]
        if env_id in with_agent:
            found.append((env_id, "trained", "its own", partial(make_trained, env_id)))
    return found


def play(env: VecEnv, policy: Any, n_episodes: int) -> dict[str, float]:
    """
    Play until at least so many episodes are done.

    :return: ``COUNTS`` and ``EXTREMES`` of all environments
    """
    observations, dones, n_done = env.reset(), np.ones(env.num_envs, bool), 0
    while n_done < n_episodes:
        observations, _, dones, infos = env.step(policy.act(observations, dones))
        n_done += int(np.sum(dones))
    audits = [info["audit"] for info in infos]
    return {name: sum(audit[name] for audit in audits) for name in COUNTS} | {
        name: np.fmax.reduce([audit[name] for audit in audits]) for name in EXTREMES
    }


def resources(folder: str) -> dict[str, float]:
    """Of this process and its workers; memory in MB."""
    processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
    return {
        "memory_mb": round(sum(process.memory_info().rss for process in processes) / 1e6, 1),
        "file_descriptors": sum(process.num_fds() for process in processes),
        "threads": sum(process.num_threads() for process in processes),
        "temporary_files": sum(len(files) for _, _, files in os.walk(folder)),
    }


def soak(
    minutes: float, n_workers: int, folder: str, earlier: tuple[pd.DataFrame, pd.DataFrame] | None
) -> Iterator[tuple[pd.DataFrame, pd.DataFrame]]:
    """
    :param minutes: How long to play
    :param n_workers: Worker processes; 0 plays in this one
    :param folder: Folder of temporary files
    :param earlier: What an earlier process returned
    :return: After each round, a row for each round so far, and a row for each task and policy
    """
    begin = time.monotonic()
    todo = plays(n_workers)
    rounds: list[dict[str, Any]] = []
    totals: dict[tuple[str, str], dict[str, float]] = {}
    if earlier is not None:
        rounds = earlier[0].to_dict("records")
        totals = {(row.pop("env"), row.pop("policy")): row for row in earlier[1].to_dict("records")}
    process, steps = (rounds[-1]["process"] + 1, rounds[-1]["steps"]) if rounds else (1, 0)
    while time.monotonic() - begin < 60 * minutes:
        for env_id, policy_name, _, prepare in todo:
            env, policy = prepare()
            done = play(env, policy, max(n_workers, 1))
            env.close()
            steps += done["steps"]
            total = totals.setdefault((env_id, policy_name), dict.fromkeys(done, 0.0) | dict.fromkeys(EXTREMES, np.nan))
            for name, value in done.items():
                total[name] = np.fmax(total[name], value) if name in EXTREMES else total[name] + value
        played = round((time.monotonic() - begin) / 60, 2)
        rounds.append({"process": process, "minutes": played, "steps": steps, **resources(folder)})
        print(rounds[-1], flush=True)
        table = pd.DataFrame([{"env": env_id, "policy": name, **values} for (env_id, name), values in totals.items()])
        yield pd.DataFrame(rounds).astype({"steps": int}), table.astype(dict.fromkeys(COUNTS, int)).round(3)


def summary(rounds: pd.DataFrame, table: pd.DataFrame) -> str:
    """One line. Growth is that of the worst process, from its second round on: the first one loads what is loaded once."""
    processes = [process for _, process in rounds.groupby("process")]
    grown = pd.DataFrame([one.iloc[-1] - one.iloc[min(1, len(one) - 1)] for one in processes]).max()
    growth = ", ".join(f"{name} {grown[name]:+.0f}" for name in rounds.columns[3:])
    faults = ", ".join(f"{name} {table[name].sum()}" for name in ("reported", "unreported", "nan"))
    minutes = sum(one["minutes"].iloc[-1] for one in processes)
    played = f"{table['steps'].sum()} control steps, {table['episodes'].sum()} episodes in {minutes:.0f} min"
    return f"{played}: {faults}; {growth}"


def draw(rounds: pd.DataFrame, path: Path) -> None:
    """What the process holds over the control steps."""
    figure = Figure(figsize=(9, 2.4), layout="constrained")
    axes = figure.subplots(1, 3)
    for axis, names in zip(axes, (["memory_mb"], ["file_descriptors", "threads"], ["temporary_files"]), strict=True):
        for number, name in enumerate(names):
            for process, part in rounds.groupby("process"):
                label = name.replace("_", " ") if process == 1 else None
                axis.plot(part["steps"], part[name], color=f"C{number}", label=label)
        axis.set_ylim(bottom=0)
        axis.set_xlabel("control steps")
        axis.legend(frameon=False)
    figure.savefig(path, dpi=120)


def main() -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("results/soak"))
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--workers", type=int, default=0, help="worker processes; 0 plays in this one")
    parser.add_argument("--more", action="store_true", help="add to the tables that are there")
    parser.add_argument("--plot", action="store_true", help="only draw")
    arguments = parser.parse_args()
    matplotlib.use("Agg")
    arguments.output.mkdir(parents=True, exist_ok=True)
    name = "workers" if arguments.workers else "one_process"
    files = [arguments.output / f"{name}_{what}.csv" for what in ("rounds", "plays")]
    if not arguments.plot:
        has_earlier = arguments.more and all(file.is_file() for file in files)
        earlier = (pd.read_csv(files[0]), pd.read_csv(files[1])) if has_earlier else None
        with tempfile.TemporaryDirectory() as folder:
            tempfile.tempdir = os.environ["TMPDIR"] = folder  # temporary files of nobody else
            for tables in soak(arguments.minutes, arguments.workers, folder, earlier):
                for table, file in zip(tables, files, strict=True):
                    table.to_csv(file, index=False)
    rounds, table = (pd.read_csv(file) for file in files)
    draw(rounds, arguments.output / f"{name}.png")
    print(summary(rounds, table))


if __name__ == "__main__":
    main()
