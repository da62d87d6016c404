"""Trained agents as two files: a model without pickled code, and a JSON file that tells what it was and what it scores."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_por import ALGORITHMS
from sb3_por.common.errors import UserError, check_known
from sb3_por.evaluation.episodes import Evaluation

#: Folder of the agents that come with the package
PRETRAINED = Path(__file__).parents[1] / "pretrained"


@dataclass(frozen=True)
class Agent:
    """
    :param model: Its ``.zip``, see :func:`sb3_por.evaluation.load_safe`
    :param facts: The JSON values beside it: ``env``, ``algo``, ``command``, ``settings``, ``evaluation``, ...
    """

    model: Path
    facts: dict[str, Any]

    @property
    def evaluation(self) -> Evaluation:
        """The published scores."""
        return read_evaluation(self.facts["evaluation"])


def agent_name(algo: str, env_id: str) -> str:
    """Name of an agent's files, without a suffix; that of models on the hub."""
    return f"{algo}-{env_id}".replace("/", "-")


def find_agent(env_id: str, algo: str | None = None, folder: Path | None = None) -> Agent:
    """
    :param env_id: Gymnasium id of a task
    :param algo: Label of the agent, or its algorithm, of which the best agent counts; any algorithm if ``None``
    :param folder: Folder of agents; those that come with the package if ``None``
    :return: The agent
    :raises UserError: If there is none
    """
    agents = [agent for agent in read_agents(PRETRAINED if folder is None else folder) if agent.facts["env"] == env_id]
    if not agents:
        raise UserError(f"no trained agent of {env_id} comes with the package; train one: python train.py --env {env_id}")
    agents.sort(key=lambda agent: agent.evaluation.score)
    if algo is None:
        return agents[-1]
    saved_by = {ALGORITHMS[name].__name__: name for name in ALGORITHMS}
    named = {saved_by.get(agent.facts["class"]): agent for agent in agents} | {agent.facts["algo"]: agent for agent in agents}
    check_known(f"agent of {env_id}", algo, [name for name in named if name])
    return named[algo]


def read_agents(folder: Path) -> list[Agent]:
    """
    :param folder: Folder of agents
    :return: All agents in it, sorted by name
    """
    return [Agent(file.with_suffix(".zip"), json.loads(file.read_text())) for file in sorted(folder.glob("*.json"))]


def describe_evaluation(evaluation: Evaluation, seed: int) -> dict[str, Any]:
    """
    :param evaluation: Scores of held-out episodes
    :param seed: Seed of the first
    :return: JSON values: means, and the scores of every episode
    """
    return {"seed": seed, **evaluation.as_dict()}


def read_evaluation(described: dict[str, Any], n_episodes: int | None = None) -> Evaluation:
    """
    :param described: Of ``describe_evaluation``
    :param n_episodes: Take the first of its episodes alone
    :return: The scores
    """
    lists = {name: values[:n_episodes] for name, values in described["episodes"].items()}
    numbers = {
        name: [np.nan if value is None else value for value in lists[name]] for name in ("normalized_performance", "successes")
    }
    return Evaluation(**{**lists, **numbers})
