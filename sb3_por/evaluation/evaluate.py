"""Evaluation on held-out variations with fixed seeds: the same episodes for every method, seed and checkpoint."""

from pathlib import Path
from typing import Any

from sb3_por.common.errors import UserError
from sb3_por.evaluation.environment import make_evaluation_env
from sb3_por.evaluation.episodes import EVAL_SEED, Evaluation, Model, evaluation_episodes, run_episodes
from sb3_por.evaluation.loading import resolve
from sb3_por.runs.environment import EnvWrapper, VecEnvWrapper

__all__ = ["EnvWrapper", "evaluate", "make_evaluation_env"]


def evaluate(
    model: Model | str | Path,
    env_id: str,
    n_episodes: int = 20,
    seed: int = EVAL_SEED,
    env_kwargs: dict[str, Any] | None = None,
    vec_normalize: str | None = None,
    env_wrapper: EnvWrapper | None = None,
    vec_env_wrapper: VecEnvWrapper | None = None,
) -> Evaluation:
    """
    Evaluate a model's deterministic policy on held-out variations 800, 801, ...

    A model of ``train.py`` is evaluated in the environment that it was trained in: wrappers, stacked frames, normalization.

    :param model: A run folder, the path of a model, or an SB3 model
    :param env_id: Gymnasium id
    :param n_episodes: Number of episodes
    :param seed: Seed of the first episode; episode ``k`` is reset with ``seed + k``
    :param env_kwargs: Changes to the arguments of the environment's constructor
    :param vec_normalize: File of ``VecNormalize`` statistics, instead of those in the run's folder
    :param env_wrapper: Wrappers, instead of those that the model was trained inside
    :param vec_env_wrapper: Wrappers of the vectorized environments, instead of those that the model was trained inside
    :return: The scores of the episodes
    :raises UserError: If the model cannot be loaded, or the environment does not fit it
    """
    if n_episodes < 1:
        raise UserError(f"an evaluation needs at least 1 episode, got {n_episodes}")
    loaded, environment = resolve(model, env_id, env_kwargs, vec_normalize, env_wrapper, vec_env_wrapper)
    env = make_evaluation_env(loaded, env_id, **environment)
    try:
        return run_episodes(loaded, env, evaluation_episodes(env_id, n_episodes, seed))
    finally:
        env.close()
