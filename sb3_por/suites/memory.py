"""Memory that the runs of a suite take together, estimated before they start."""

import inspect
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_por.common.memory import available_memory
from sb3_por.evaluation.loading import LOADABLE
from sb3_por.suites.inputs import run_settings
from sb3_por.suites.run import Run
from sb3_por.visual.actor_critic import VisualActorCritic

#: Bytes of a process with PyTorch and an environment, without its replay buffer
PROCESS = 450 * 2**20


def overcommitment(runs: Sequence[Run], workers: int) -> str | None:
    """
    :param runs: The runs that are left to do
    :param workers: Runs at a time
    :return: What is too much for this machine or its container, and what to change; None if there is memory for all
    """
    needed = sorted(map(run_memory, runs), reverse=True)
    available = available_memory()
    together = sum(needed[:workers])
    if not needed or together <= available:
        return None
    fitting = max((n for n in range(1, workers) if sum(needed[:n]) <= available), default=1)
    return (
        f"{min(workers, len(needed))} runs at a time may take {together / 2**30:.1f} GiB with full replay buffers, and "
        f"{available / 2**30:.1f} GiB are available: set workers to {fitting}, or a smaller buffer_size"
    )


def run_memory(run: Run) -> int:
    """
    :param run: A run
    :return: Bytes that it takes at its end: the process and its replay buffer, as far as its settings tell
    """
    return _memory(replace(run, seed=0, folder=Path()))


@cache
def _memory(run: Run) -> int:
    """See :func:`run_memory`; runs that differ by their seed alone are one."""
    settings = run_settings(run)
    parameter = inspect.signature(LOADABLE[run.algo]).parameters.get("buffer_size")
    if parameter is None:
        return PROCESS
    steps = int(run.flags[run.flags.index("-n") + 1]) if "-n" in run.flags else _number(settings.get("n_timesteps"), 10**9)
    size = min(_number(settings.get("buffer_size"), parameter.default), steps)
    # SB3's own buffers store the next observation, too.
    copies = 1 if issubclass(LOADABLE[run.algo], VisualActorCritic) else 2
    frame = _observation_size(run.env, settings.get("env_kwargs") or {}) * _number(settings.get("frame_stack"), 1)
    return PROCESS + size * copies * frame


def _number(value: Any, otherwise: int) -> int:
    """A setting; where it is none or no number, which its run will tell, the default."""
    return int(value) if isinstance(value, (int, float)) else otherwise


def _observation_size(env_id: str, env_kwargs: dict[str, Any]) -> int:
    """Bytes of an observation; 0 if the environment cannot be made, which its run will tell."""
    try:
        env = gym.make(env_id, **env_kwargs)
        space = env.observation_space
        env.close()
    except Exception:
        return 0
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    return sum(int(np.prod(part.shape or (1,))) * np.dtype(part.dtype or np.float64).itemsize for part in parts)
