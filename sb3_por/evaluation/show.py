"""A model's episodes in a window."""

import sys
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_por.common.errors import UserError, one_line
from sb3_por.evaluation.environment import make_evaluation_env
from sb3_por.evaluation.episodes import EVAL_SEED, Evaluation, Model, evaluation_episodes, run_episodes
from sb3_por.evaluation.loading import resolve
from sb3_por.runs.environment import EnvWrapper, VecEnvWrapper
from softbody_envs.registration import task_class
from softbody_envs.window import check_display


def show_episodes(
    model: Model | str | Path,
    env_id: str,
    n_episodes: int = 1,
    seed: int = EVAL_SEED,
    size: int = 480,
    env_kwargs: dict[str, Any] | None = None,
    vec_normalize: str | None = None,
    env_wrapper: EnvWrapper | None = None,
    vec_env_wrapper: VecEnvWrapper | None = None,
) -> Evaluation:
    """
    Show a model's deterministic policy on the first held-out episodes in a window, in real time.

    :param model: a run folder, the path of a model, or an SB3 model
    :param env_id: a Gymnasium id
    :param n_episodes: number of episodes, one after the other
    :param seed: seed of the first episode
    :param size: height and width in pixels, for environments with a ``render_size``
    :param env_kwargs: as in :func:`sb3_por.evaluation.evaluate`
    :param vec_normalize: as in :func:`sb3_por.evaluation.evaluate`
    :param env_wrapper: as in :func:`sb3_por.evaluation.evaluate`
    :param vec_env_wrapper: as in :func:`sb3_por.evaluation.evaluate`
    :return: the scores of these episodes
    :raises UserError: if the environment does not fit the model, or if no window can be opened
    """
    if n_episodes < 1:
        raise UserError(f"there is nothing to show in {n_episodes} episodes")
    loaded, environment = resolve(model, env_id, env_kwargs, vec_normalize, env_wrapper, vec_env_wrapper)
    rendering: dict[str, Any] = {"render_mode": "human"} | ({} if task_class(env_id) is None else {"render_size": size})
    changes = {"env_kwargs": environment["env_kwargs"] | rendering}
    env = make_evaluation_env(loaded, env_id, **environment | changes)
    try:
        _open(env, env_id)
        return run_episodes(loaded, env, evaluation_episodes(env_id, n_episodes, seed))
    finally:
        env.close()


def _open(env: Any, env_id: str) -> None:
    """
    Open the window: the first frame is shown at reset.

    :raises UserError: If the environment has none, if that fails, or if nobody could see it
    """
    if "human" not in env.get_attr("metadata")[0].get("render_modes", []):
        raise UserError(f"{env_id} has no window and no images to show in one: its metadata has no render_modes for them")
    try:
        env.reset()
        pygame = sys.modules.get("pygame")
        if pygame is not None and pygame.display.get_init():
            check_display(pygame)
    except (gym.error.Error, RuntimeError) as error:  # RuntimeError: of pygame
        raise UserError(f"{env_id} cannot be shown: {one_line(error)}; -o FILE.gif records a video") from error
