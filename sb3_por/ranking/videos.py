"""Videos to learn from: Minari datasets, and folders of .mp4, .gif and .npz files."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from gymnasium import spaces

from sb3_por.common.errors import UserError, one_line
from sb3_por.demonstrations.dataset import METADATA, Demonstrations, RecordedEpisode
from sb3_por.ranking.images import find_image, resize

SUFFIXES = (".gif", ".mp4", ".npz")
#: Characters of a decoder's error that are shown
LONGEST_REASON = 200


def read_videos(path: str | Path, image_size: int = 64) -> list[np.ndarray]:
    """
    :param path: A Minari dataset with images among its observations, or a folder of videos; an ``.npz`` holds one array of
        frames, uint8, shape ``(n, height, width, channels)``
    :param image_size: Height and width to which frames are resized
    :return: Frames of each video, uint8, shape ``(n, image_size, image_size, 3)``
    :raises UserError: If there are none, or one cannot be read
    """
    path = Path(path)
    if any((folder / METADATA).is_file() for folder in (path, path / "data")):
        dataset = Demonstrations(path)
        return episode_videos(dataset.episodes(), dataset.observation_space, image_size)
    if not path.is_dir():
        raise UserError(f"{path} is no folder of videos" if path.exists() else f"there is no folder {path}")
    files = sorted(file for file in path.glob("*") if file.suffix.lower() in SUFFIXES and file.is_file())
    if not files:
        raise UserError(f"there are no videos in {path}: no {METADATA} of a Minari dataset, and no {', '.join(SUFFIXES)}")
    return [_read(file, image_size) for file in files]


def episode_videos(
    episodes: Iterable[RecordedEpisode], observation_space: spaces.Space, image_size: int = 64
) -> list[np.ndarray]:
    """
    :param episodes: Recorded episodes
    :param observation_space: Space of their observations, with one image
    :param image_size: Height and width to which frames are resized
    :return: Frames of each episode, uint8, shape ``(n, image_size, image_size, 3)``
    :raises UserError: If there is no image in the observations, or more than one
    """
    image = image_of(observation_space)
    return [resize(image(episode.observations), image_size) for episode in episodes]


def image_of(observation_space: spaces.Space) -> Callable[[Any], np.ndarray]:
    """
    :param observation_space: Space of observations
    :return: See :func:`find_image`
    :raises UserError: If there is no image in them, or more than one
    """
    image = find_image(observation_space)
    if image is None:
        raise UserError(
            f"there is no single image in {observation_space}; our tasks have one with --env-kwargs obs_type:pixels, and a "
            "folder of video files serves any environment"
        )
    return image


def _read(file: Path, image_size: int) -> np.ndarray:
    try:
        if file.suffix.lower() == ".npz":
            with np.load(file, allow_pickle=False) as arrays:
                if len(arrays.files) != 1:
                    raise ValueError(f"an .npz holds one array, of frames; this one has {', '.join(arrays.files)}")
                frames = arrays[arrays.files[0]]
            video = resize(frames, image_size)
        else:
            # Frame by frame: a video in its own size may not fit into memory
            with imageio.get_reader(file) as reader:
                frames = reader.iter_data()  # type: ignore[attr-defined]  # missing in its stubs
                video = np.concatenate([resize(np.atleast_3d(frame)[None], image_size) for frame in frames])
    except Exception as error:  # whatever a damaged file makes its decoder raise
        # ffmpeg says last what matters, after its version and how it was built
        raise UserError(f"cannot read the video {file}: {one_line(error)[-LONGEST_REASON:]}") from error
    if len(video) < 2:
        raise UserError(f"the video {file} has {len(video)} frame; an order needs at least 2")
    return video
