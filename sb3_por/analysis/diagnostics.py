"""What a trained objective has learned: order or encoder identity, and whether its potential follows the physics."""

import warnings
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch as th
from scipy.stats import ConstantInputWarning, spearmanr
from stable_baselines3.common.utils import obs_as_tensor, set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_por.common.errors import UserError
from sb3_por.evaluation.episodes import evaluation_episodes
from sb3_por.evaluation.evaluate import EnvWrapper, make_evaluation_env
from sb3_por.evaluation.loading import find_environment, load_model, trained_in
from sb3_por.objectives.por import PartialOrder
from sb3_por.runs.facts import run_identity
from sb3_por.runs.folder import find_runs, is_finished
from sb3_por.visual.replay_buffer import SequenceReplayBuffer

#: Pairs of a batch, and batches that a number is the mean of.
BATCH_SIZE, N_BATCHES = 256, 4


@dataclass(frozen=True)
class Diagnosis:
    """
    Losses are per term, so that chance is ln 2 = 0.693; accuracies are fractions, chance 0.5.

    :param loss: POR loss on the policy's own frames
    :param accuracy: how often the classifier is right on them
    :param leak_loss: POR loss on pairs of a frame with itself (k = 0): below ln 2 the classifier reads the encoders
    :param leak_accuracy: the same as an accuracy
    :param random_loss: POR loss on frames of a random policy
    :param random_accuracy: the same as an accuracy
    :param grad_norm_critic: norm of the critic loss's gradient at the encoder
    :param grad_norm_por: norm of the weighted POR loss's gradient there
    :param feature_std: standard deviation of the encoder's features over the policy's own frames, mean of the features; near
        0 the encoder has collapsed: it says the same of all frames
    :param correlation: Spearman's correlation between the learned potential and ``info["monotone"]`` over an episode, mean
        of the episodes in which that quantity changes; NaN if it never does
    :param correlations: the same of each episode, NaN where the quantity is constant
    """

    loss: float
    accuracy: float
    leak_loss: float
    leak_accuracy: float
    random_loss: float
    random_accuracy: float
    grad_norm_critic: float
    grad_norm_por: float
    feature_std: float
    correlation: float
    correlations: list[float]

    def as_dict(self) -> dict[str, Any]:
        """For JSON: ``None`` stands for NaN."""
        plain = asdict(self) | {"correlations": [None if np.isnan(value) else value for value in self.correlations]}
        return {name: None if isinstance(value, float) and np.isnan(value) else value for name, value in plain.items()}

    def __str__(self) -> str:
        rows = [
            ("", "loss", "accuracy"),
            ("frames of its own policy", f"{self.loss:.3f}", f"{self.accuracy:.3f}"),
            ("frames of a random policy", f"{self.random_loss:.3f}", f"{self.random_accuracy:.3f}"),
            ("leak control (k = 0)", f"{self.leak_loss:.3f}", f"{self.leak_accuracy:.3f}"),
            ("chance", "0.693", "0.500"),
        ]
        table = "\n".join(f"{name:26s}{loss:>8s}{accuracy:>10s}" for name, loss, accuracy in rows)
        return (
            f"{table}\ngradient norm at the encoder: critic {self.grad_norm_critic:.3g}, POR {self.grad_norm_por:.3g}\n"
            f"standard deviation of the encoder's features over frames: {self.feature_std:.3g}\n"
            f"Spearman correlation of potential and monotone quantity: {self.correlation:.3f}"
        )


def check_order(model: Any) -> PartialOrder:
    """
    :return: the model's partial-order objective
    :raises UserError: if it has none
    """
    objective = getattr(getattr(model, "policy", None), "objective", None)
    if not isinstance(objective, PartialOrder):
        raise UserError(f"{type(model).__name__} learns no order; use a model of sac_por or tqc_por")
    return objective


def diagnose(
    model: Any,
    env_id: str,
    n_episodes: int = 5,
    seed: int = 0,
    env_kwargs: dict[str, Any] | None = None,
    vec_normalize: str | None = None,
    env_wrapper: EnvWrapper | None = None,
) -> Diagnosis:
    """
    Play held-out episodes with a model and at random, and measure its partial-order objective on their frames.

    :param model: trained with a ``PartialOrder`` objective
    :param env_id: a Gymnasium id; for the correlation one that reports ``info["monotone"]``
    :param n_episodes: of each policy
    :param seed: of the first episode, the random policy, and the pairs; the global generators are set to it
    :param env_kwargs: for the environment's constructor
    :param vec_normalize: file of ``VecNormalize`` statistics that the model was trained with
    :param env_wrapper: what the model was trained inside
    :raises UserError: if the model learns no order, or was not trained on this environment
    """
    objective = check_order(model)
    if n_episodes < 1:
        raise UserError(f"a diagnosis needs at least 1 episode, got {n_episodes}")
    env = make_evaluation_env(model, env_id, env_kwargs, vec_normalize, env_wrapper)
    set_random_seed(seed)
    env.action_space.seed(seed)
    model.policy.set_training_mode(False)
    try:
        episodes = evaluation_episodes(env_id, n_episodes, seed)
        own, correlations = _play(model, env, episodes, at_random=False)
        random, _ = _play(model, env, episodes, at_random=True)
    finally:
        env.close()

    batches = [model.sample(BATCH_SIZE, own) for _ in range(N_BATCHES)]
    measured = [model.objective_metrics(batch) for batch in batches]
    leaks = [model.control_metrics(batch) for batch in batches]
    at_random = [model.objective_metrics(model.sample(BATCH_SIZE, random)) for _ in range(N_BATCHES)]
    norms = model.encoder_grad_norms(model.losses(batches[0]))
    with th.no_grad():
        features = th.cat([model.critic.encode(batch.observations) for batch in batches])
    changing = [value for value in correlations if not np.isnan(value)]
    return Diagnosis(
        loss=_mean(measured, "loss"),
        accuracy=_mean(measured, "accuracy"),
        leak_loss=_mean(leaks, "leak_loss"),
        leak_accuracy=_mean(leaks, "leak_accuracy"),
        random_loss=_mean(at_random, "loss"),
        random_accuracy=_mean(at_random, "accuracy"),
        grad_norm_critic=float(norms["critic"]),
        grad_norm_por=float(norms[objective.name]),
        feature_std=float(features.std(dim=0).mean()),
        correlation=float(np.mean(changing)) if changing else float("nan"),
        correlations=correlations,
    )


def diagnose_runs(folders: Iterable[str | Path], n_episodes: int = 5, seed: int = 0) -> pd.DataFrame:
    """
    Diagnose the last model of every run that learns an order; other runs and unfinished ones are passed over.

    :param folders: run folders, or folders that hold some at any depth
    :param n_episodes: as in :func:`diagnose`
    :param seed: as in :func:`diagnose`
    :return: one row a model: env, algo (or label), seed, step, and what a ``Diagnosis`` holds but single episodes
    :raises UserError: if there is no such model
    """
    rows = []
    for run in find_runs(folders):
        identity = run_identity(run)
        file = run / f"{identity['env']}.zip"
        if not is_finished(run, identity["env"]):
            continue
        find_environment(identity["env"], file)
        model: Any = load_model(file)
        if not isinstance(getattr(model.policy, "objective", None), PartialOrder):
            continue
        measured = diagnose(model, identity["env"], n_episodes, seed, **trained_in(file, identity["env"])).as_dict()
        del measured["correlations"]
        rows.append({**identity, "step": model.num_timesteps, **measured})
    if not rows:
        raise UserError("none of these runs has ended with a model that learns an order; give runs of sac_por or tqc_por")
    return pd.DataFrame(rows).sort_values(["env", "algo", "seed"], ignore_index=True)


def _play(model: Any, env: VecEnv, episodes: list[Any], at_random: bool) -> tuple[SequenceReplayBuffer, list[float]]:
    """The transitions of these episodes, and each one's correlation of potential and monotone quantity."""
    env.env_method("play", episodes)
    observation: Any = env.reset()
    monotone = [env.unwrapped.reset_infos[0].get("monotone", np.nan)]
    frames = [observation]
    transitions: list[Any] = []
    correlations: list[float] = []
    while len(correlations) < len(episodes):
        action = np.array([env.action_space.sample()]) if at_random else model.predict(observation, deterministic=True)[0]
        next_observation, reward, done, infos = env.step(action)
        last = _batch(infos[0]["terminal_observation"]) if done[0] else next_observation
        transitions.append((observation, last, model.policy.scale_action(action), reward, done, infos))
        frames.append(last)
        monotone.append(infos[0].get("monotone", np.nan))
        if done[0]:
            correlations.append(_correlation(model, frames, np.array(monotone)))
            frames, monotone = [next_observation], [env.unwrapped.reset_infos[0].get("monotone", np.nan)]
        observation = next_observation
    buffer = SequenceReplayBuffer(
        len(transitions), model.observation_space, model.action_space, model.device, n_steps=model.n_steps, gamma=model.gamma
    )
    for transition in transitions:
        buffer.add(*transition)
    return buffer, correlations


def _batch(observation: Any) -> Any:
    """A batch of one observation."""
    return {key: value[None] for key, value in observation.items()} if isinstance(observation, dict) else observation[None]


def _concatenate(batches: list[Any]) -> Any:
    """One batch of many."""
    if isinstance(batches[0], dict):
        return {key: np.concatenate([batch[key] for batch in batches]) for key in batches[0]}
    return np.concatenate(batches)


def _correlation(model: Any, frames: list[Any], monotone: np.ndarray) -> float:
    """Spearman's correlation over one episode; NaN where the quantity does not change."""
    with th.no_grad():
        features = model.critic.encode(obs_as_tensor(_concatenate(frames), model.device))
        potential = model.policy.objective.potential(features).cpu().numpy()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConstantInputWarning)
        return float(spearmanr(potential, monotone).statistic)


def _mean(metrics: list[dict[str, th.Tensor]], name: str) -> float:
    return float(np.mean([float(one[name]) for one in metrics]))
