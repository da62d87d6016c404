"""Episodes that score a policy: held-out scenes with fixed seeds, the same for every method and checkpoint."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from sb3_por.common.errors import UserError
from softbody_envs.registration import task_class
from softbody_envs.variations import SPLITS

#: Seed of the first evaluation episode; the k-th has this plus k.
EVAL_SEED = 0
#: What is added to the seeds of training episodes where no variation tells them from those of evaluations
TRAINING_SEED = 1_000_000


class Model(Protocol):
    """Interface of a policy that can be evaluated: every SB3 model, and others with its spaces and its ``predict``."""

    observation_space: spaces.Space
    action_space: spaces.Space

    def predict(self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False) -> Any:
        """See ``predict`` of ``stable_baselines3.common.base_class.BaseAlgorithm``."""


@dataclass(frozen=True)
class Episode:
    """
    What decides how an episode begins.

    :param index: place in the evaluation
    :param seed: passed to ``reset``
    :param variation: index of the scene; ``None`` for environments that have no variations
    """

    index: int
    seed: int
    variation: int | None


@dataclass(frozen=True)
class Evaluation:
    """
    One number an episode, in the order of the episodes, each a list of length ``n_episodes``.

    :param normalized_performance: at the end of the episode; 0: as after reset, 1: perfect; NaN if not reported
    :param returns: undiscounted sum of the rewards
    :param successes: 1.0 or 0.0; NaN if the environment does not report success
    :param lengths: steps
    :param variations: index of the scene, or ``None``
    """

    normalized_performance: list[float]
    returns: list[float]
    successes: list[float]
    lengths: list[int]
    variations: list[int | None]

    @property
    def score(self) -> float:
        """Mean normalized performance; mean return for environments that report none. Checkpoints are ranked by it."""
        return score(self.normalized_performance, self.returns)

    def as_dict(self) -> dict[str, Any]:
        """Means and the single episodes, for JSON: ``None`` stands for NaN."""
        lists = asdict(self)
        means = {
            "normalized_performance": np.mean(self.normalized_performance),
            "return": np.mean(self.returns),
            "success": np.mean(self.successes),
            "length": np.mean(self.lengths),
        }
        plain = {name: [_none_for_nan(value) for value in values] for name, values in lists.items()}
        return {"n_episodes": len(self.returns), "mean": {k: _none_for_nan(v) for k, v in means.items()}, "episodes": plain}

    def __str__(self) -> str:
        parts = [f"return {np.mean(self.returns):.3f} ± {np.std(self.returns):.3f}"]
        if not np.isnan(np.mean(self.normalized_performance)):
            performance = self.normalized_performance
            parts.insert(0, f"normalized performance {np.mean(performance):.3f} ± {np.std(performance):.3f}")
        if not np.isnan(np.mean(self.successes)):
            parts.append(f"success {np.mean(self.successes):.0%}")
        episodes = f"{len(self.returns)} episode{'s' if len(self.returns) > 1 else ''}"
        return f"{', '.join(parts)}, length {np.mean(self.lengths):.0f} ({episodes})"


def score(normalized_performance: Sequence[float], returns: Sequence[float]) -> float:
    """See :attr:`Evaluation.score`."""
    told = np.asarray(normalized_performance)
    return float(np.mean(returns) if np.isnan(told).all() else np.nanmean(told))


class FixedEpisodes(gym.Wrapper):
    """
    Plays a given list of episodes in turn, whatever seed ``reset`` is called with; then begins again.

    It makes SB3's vectorised environments, which reset themselves without a seed, play the same episodes each time.

    :param env: the environment
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self._episodes: list[Episode] = [Episode(0, EVAL_SEED, None)]
        self._next = 0

    def play(self, episodes: list[Episode]) -> None:
        """
        The next ``reset`` begins the first of these.

        :param episodes: Episodes; an environment that has none to play, beside others that have, keeps its earlier ones
        """
        self._episodes = episodes or self._episodes
        self._next = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._current = self._episodes[self._next % len(self._episodes)]
        self._next += 1
        variation = self._current.variation
        return self.env.reset(seed=self._current.seed, options=None if variation is None else {"variation": variation})

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        if not np.isfinite(action).all():
            raise UserError(f"the model's action is {action}, not finite; use an earlier checkpoint")
        observation, reward, terminated, truncated, info = self.env.step(action)
        if (terminated or truncated) and "episode" not in info:
            info = info | {"episode": self._so_far()}
        return observation, reward, terminated, truncated, info | {"evaluation_episode": self._current.index}

    def _so_far(self) -> dict[str, Any]:
        """What ``Monitor`` has seen of an episode that a wrapper around it has ended; it counts its own ends alone."""
        env = self.env
        while isinstance(env, gym.Wrapper) and not isinstance(env, Monitor):
            env = env.env
        rewards = env.rewards if isinstance(env, Monitor) else []
        return {"r": float(sum(rewards)), "l": len(rewards)}


def evaluation_episodes(env_id: str, n_episodes: int, seed: int = EVAL_SEED) -> list[Episode]:
    """The episodes of an evaluation: held-out variations 800, 801, ... with seeds ``seed``, ``seed + 1``, ..."""
    held_out = SPLITS["eval"]
    has_variations = task_class(env_id) is not None
    return [Episode(k, seed + k, held_out[k % len(held_out)] if has_variations else None) for k in range(n_episodes)]


def training_episodes(env_id: str, n_episodes: int, seed: int) -> list[Episode]:
    """
    :param env_id: Gymnasium id
    :param n_episodes: Number of episodes
    :param seed: Chooses the scenes
    :return: Episodes in training scenes drawn without replacement, as long as there are any left. In environments without
        variations the seeds are far from those of evaluations, since the seed is all that tells one episode from another
    """
    if task_class(env_id) is None:
        return [Episode(k, TRAINING_SEED + seed + k, None) for k in range(n_episodes)]
    scenes = np.random.default_rng(seed).permutation(SPLITS["train"])
    return [Episode(k, seed + k, int(scenes[k % len(scenes)])) for k in range(n_episodes)]


def scene_kwargs(env_id: str, split: str) -> dict[str, Any]:
    """
    :param env_id: Gymnasium id
    :param split: ``"train"`` or ``"eval"``
    :return: Arguments of the constructor of an environment with these scenes; none for environments that have no variations
    """
    return {"split": split} if task_class(env_id) is not None else {}


def whole_episodes(env_id: str, env_kwargs: dict[str, Any]) -> dict[str, Any]:
    """
    A training environment's arguments as evaluation takes them. Training episodes may be cut short (so that a picker that
    has gone astray starts again); what is scored is whole. An environment that has no limit of its own keeps that of training:
    its episodes might never end.

    :param env_id: Gymnasium id
    :param env_kwargs: Arguments of the training environment
    :return: Arguments of an evaluation environment
    """
    spec = gym.registry.get(env_id)
    if spec is None or spec.max_episode_steps is None:
        return env_kwargs
    return {name: value for name, value in env_kwargs.items() if name != "max_episode_steps"}


def has_diverged(model: Model) -> bool:
    """Whether a parameter of the model's networks is NaN or infinite."""
    policy = getattr(model, "policy", None)
    return policy is not None and not all(bool(th.isfinite(parameter).all()) for parameter in policy.parameters())


def run_episodes(model: Model, env: VecEnv, episodes: list[Episode]) -> Evaluation:
    """
    Play episodes with a model's deterministic policy.

    :param model: an SB3 model
    :param env: environments, each inside ``Monitor`` and ``FixedEpisodes``, wrapped as the model's training environment
    :param episodes: Episodes to play, divided among the environments
    :raises UserError: if the model's training has diverged
    """
    if has_diverged(model):
        raise UserError("the model's networks hold NaN: its training has diverged; use an earlier checkpoint")
    n_envs = env.num_envs
    for i in range(n_envs):
        # The share that evaluate_policy gives environment i: (n_episodes + i) // n_envs.
        env.env_method("play", episodes[n_envs - 1 - i :: n_envs], indices=i)
    infos: dict[int, dict[str, Any]] = {}

    def collect(local_variables: dict[str, Any], _: dict[str, Any]) -> None:
        if local_variables["done"]:
            info = local_variables["info"]
            infos[info["evaluation_episode"]] = info

    evaluate_policy(model, env, len(episodes), deterministic=True, callback=collect, warn=False)
    ordered = [infos[episode.index] for episode in episodes]
    return Evaluation(
        normalized_performance=[float(info.get("normalized_performance", np.nan)) for info in ordered],
        returns=[float(info["episode"]["r"]) for info in ordered],
        successes=[float(info.get("is_success", np.nan)) for info in ordered],
        lengths=[int(info["episode"]["l"]) for info in ordered],
        variations=[episode.variation for episode in episodes],
    )


def _none_for_nan(value: Any) -> Any:
    if value is None or isinstance(value, int):
        return value
    return None if np.isnan(value) else float(value)
