"""A film of a model at work, as GIF or MP4."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
from gymnasium.wrappers import RenderCollection

from sb3_por.common.errors import UserError, one_line
from sb3_por.common.files import atomic_write, check_output
from sb3_por.evaluation.episodes import EVAL_SEED, Evaluation, Model, evaluation_episodes, run_episodes
from sb3_por.evaluation.evaluate import EnvWrapper, make_evaluation_env
from softbody_envs.registration import ENV_IDS

FORMATS = (".gif", ".mp4")


def check_film(path: str | Path) -> Path:
    """
    :raises UserError: if a film cannot be written under this name
    """
    return check_output(path, FORMATS)


def film(
    model: Model,
    env_id: str,
    path: str | Path,
    n_episodes: int = 1,
    seed: int = EVAL_SEED,
    size: int = 480,
    env_kwargs: dict[str, Any] | None = None,
    vec_normalize: str | None = None,
    env_wrapper: EnvWrapper | None = None,
) -> Evaluation:
    """
    Film a model's deterministic policy on the first held-out episodes.

    :param model: an SB3 model
    :param env_id: a Gymnasium id
    :param path: ``.gif`` or ``.mp4``
    :param n_episodes: number of episodes, one after the other
    :param seed: seed of the first episode
    :param size: height and width in pixels, for environments that let it be chosen
    :param env_kwargs: for the environment's constructor
    :param vec_normalize: file of ``VecNormalize`` statistics that the model was trained with
    :param env_wrapper: what the model was trained inside
    :return: how the model did
    :raises UserError: if the environment does not fit the model or draws no images
    """
    path = check_film(path)
    if n_episodes < 1:
        raise UserError(f"a film needs at least 1 episode, got {n_episodes}")
    if size < 1:
        raise UserError(f"a film needs at least 1 pixel, got the size {size}")
    drawn: dict[str, Any] = {"render_mode": "rgb_array"} | ({"render_size": size} if env_id in ENV_IDS else {})
    kwargs = (env_kwargs or {}) | drawn

    def filmed(env: gym.Env) -> gym.Env:
        recorded: gym.Env = RenderCollection(env, reset_clean=False)  # innermost: sees every step of an ActionRepeat
        return recorded if env_wrapper is None else env_wrapper(recorded)

    env = make_evaluation_env(model, env_id, kwargs, vec_normalize, filmed)
    try:
        fps = env.get_attr("metadata")[0].get("render_fps", 30)
        evaluation = run_episodes(model, env, evaluation_episodes(env_id, n_episodes, seed))
        # The last frame is of the episode that the vectorised environment began when the last one ended.
        frames = env.env_method("render")[0][:-1]
    except gym.error.Error as error:
        raise UserError(f"{env_id} draws no images: {one_line(error)}") from error
    finally:
        env.close()
    write_film(path, frames, fps)
    return evaluation


def write_film(path: str | Path, frames: list[Any], fps: float) -> None:
    """
    :param path: ``.gif`` or ``.mp4``
    :param frames: uint8 images, ``(height, width, 3)``, at least one
    :param fps: frames a second
    """
    path = check_film(path)
    with atomic_write(path) as temporary:
        if path.suffix.lower() == ".gif":
            imageio.mimwrite(temporary, frames, duration=1000 / fps, loop=0)
        else:
            # H.264 wants even sizes: other frames are scaled up to the next multiple of 2.
            imageio.mimwrite(temporary, frames, fps=fps, macro_block_size=2)
