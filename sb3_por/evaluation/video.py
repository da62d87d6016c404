"""Videos of a model's episodes, as GIF or MP4."""

from io import BytesIO
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
from gymnasium.wrappers import RenderCollection
from imageio_ffmpeg import count_frames_and_secs

from sb3_por.common.errors import UserError, one_line
from sb3_por.common.files import atomic_write, check_output
from sb3_por.evaluation.environment import make_evaluation_env
from sb3_por.evaluation.episodes import EVAL_SEED, Evaluation, Model, evaluation_episodes, run_episodes
from sb3_por.evaluation.loading import resolve
from sb3_por.runs.environment import EnvWrapper, VecEnvWrapper
from softbody_envs.registration import task_class

FORMATS = (".gif", ".mp4")


def check_video(path: str | Path) -> Path:
    """
    Check that a video can be written here.

    :param path: ``.gif`` or ``.mp4``
    :return: the path
    :raises UserError: if the format is unknown or the folder cannot be written to
    """
    return check_output(path, FORMATS)


def record_video(
    model: Model | str | Path,
    env_id: str,
    path: str | Path,
    n_episodes: int = 1,
    seed: int = EVAL_SEED,
    size: int = 480,
    env_kwargs: dict[str, Any] | None = None,
    vec_normalize: str | None = None,
    env_wrapper: EnvWrapper | None = None,
    vec_env_wrapper: VecEnvWrapper | None = None,
) -> Evaluation:
    """
    Record a model's deterministic policy on the first held-out episodes.

    :param model: a run folder, the path of a model, or an SB3 model
    :param env_id: a Gymnasium id
    :param path: ``.gif`` or ``.mp4``
    :param n_episodes: number of episodes, one after the other
    :param seed: seed of the first episode
    :param size: height and width in pixels, for environments with a ``render_size``
    :param env_kwargs: as in :func:`sb3_por.evaluation.evaluate`
    :param vec_normalize: as in :func:`sb3_por.evaluation.evaluate`
    :param env_wrapper: as in :func:`sb3_por.evaluation.evaluate`
    :param vec_env_wrapper: as in :func:`sb3_por.evaluation.evaluate`
    :return: the scores of these episodes
    :raises UserError: if the environment does not fit the model or renders no images
    """
    path = check_video(path)
    if n_episodes < 1:
        raise UserError(f"a video needs at least 1 episode, got {n_episodes}")
    if size < 1:
        raise UserError(f"a video needs at least 1 pixel, got the size {size}")
    loaded, environment = resolve(model, env_id, env_kwargs, vec_normalize, env_wrapper, vec_env_wrapper)
    rendering: dict[str, Any] = {"render_mode": "rgb_array"} | ({} if task_class(env_id) is None else {"render_size": size})
    wrap = environment["env_wrapper"]

    fps = 30.0

    def recorded(env: gym.Env) -> gym.Env:
        nonlocal fps
        fps = env.metadata.get("render_fps", fps)  # of every step inside an ActionRepeat, as is recorded
        innermost: gym.Env = RenderCollection(env, reset_clean=False)
        return innermost if wrap is None else wrap(innermost)

    changes = {"env_kwargs": environment["env_kwargs"] | rendering, "env_wrapper": recorded}
    env = make_evaluation_env(loaded, env_id, **environment | changes)
    try:
        evaluation = run_episodes(loaded, env, evaluation_episodes(env_id, n_episodes, seed))
        # The vectorised environment resets itself after the last episode: the last frame belongs to the next one.
        frames = env.env_method("render")[0][:-1]
    except (gym.error.Error, NotImplementedError) as error:
        raise UserError(f"{env_id} renders no images: {one_line(error)}") from error
    finally:
        env.close()
    for frame in frames:
        if not isinstance(frame, np.ndarray) or frame.dtype != np.uint8 or frame.ndim not in (2, 3):
            found = f"{frame.dtype} of shape {frame.shape}" if isinstance(frame, np.ndarray) else type(frame).__name__
            raise UserError(f"{env_id} renders no images of uint8: {found}")
    write_video(path, frames, fps)
    return evaluation


def write_video(path: str | Path, frames: list[Any], fps: float) -> None:
    """
    Write frames as a video.

    :param path: ``.gif`` or ``.mp4``
    :param frames: uint8 images, ``(height, width, 3)``, at least one
    :param fps: frames per second
    :raises DiskError: if the disk is full, read-only or out of reach; a video that was there before stays
    """
    path = check_video(path)
    with atomic_write(path) as temporary:
        if path.suffix.lower() == ".gif":
            # In memory first: on a full disk Pillow's writer would fail a second time when it is collected.
            video = BytesIO()
            imageio.mimwrite(video, frames, format="gif", duration=1000 / fps, loop=0)  # type: ignore[call-overload]  # a name
            temporary.write_bytes(video.getvalue())
        else:
            # H.264 needs even sizes: other frames are scaled up to the next multiple of 2.
            imageio.mimwrite(temporary, frames, fps=fps, macro_block_size=2)
            # imageio does not look at how ffmpeg's process ended: on a full disk, with half a video.
            if count_frames_and_secs(str(temporary))[0] != len(frames):
                raise OSError(f"ffmpeg has not written all of {path}")
