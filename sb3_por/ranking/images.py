"""Images in observations, and their size."""

from collections.abc import Callable
from operator import itemgetter
from typing import Any

import cv2
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first

from sb3_por.common.errors import UserError


def find_image(space: spaces.Space) -> Callable[[Any], np.ndarray] | None:
    """
    :param space: Space of observations
    :return: A function from an observation, or a batch of them, to its image with the channels last; None if there is no image
        or more than one
    """
    if isinstance(space, spaces.Dict):
        keys = [key for key, part in space.spaces.items() if is_image_space(part)]
        inner = find_image(space.spaces[keys[0]]) if len(keys) == 1 else None
        return None if inner is None else _chain(itemgetter(keys[0]), inner)
    if not is_image_space(space) or not isinstance(space, spaces.Box):
        return None
    return (lambda image: np.moveaxis(image, -3, -1)) if is_image_space_channels_first(space) else np.asarray


def resize(frames: np.ndarray, size: int) -> np.ndarray:
    """
    Make squares of RGB images.

    :param frames: Shape ``(n, height, width, channels)``; one channel is grey, of four the last is dropped, and of more the
        last three count: those of the newest of stacked frames
    :param size: Height and width of the result in pixels
    :return: uint8, shape ``(n, size, size, 3)``
    :raises UserError: If these are no such frames
    """
    if frames.ndim != 4 or frames.dtype != np.uint8 or 0 in frames.shape:
        raise UserError(f"frames are uint8 of (n, height, width, channels), not {frames.dtype} of {frames.shape}")
    channels = frames.shape[3]
    if channels > 4 and frames.shape[1] in (1, 3, 4):
        raise UserError(f"the channels of frames come last: (n, height, width, channels), not {frames.shape}")
    rgb = frames[..., -3:] if channels > 4 else np.repeat(frames[..., :1], 3, axis=3) if channels < 3 else frames[..., :3]
    if rgb.shape[1:3] == (size, size):
        return np.ascontiguousarray(rgb)
    smaller = [cv2.resize(np.ascontiguousarray(image), (size, size), interpolation=cv2.INTER_AREA) for image in rgb]
    return np.stack(smaller)


def _chain(first: Callable[[Any], Any], second: Callable[[Any], np.ndarray]) -> Callable[[Any], np.ndarray]:
    return lambda value: second(first(value))
