"""Batches whose images are turned and mirrored, together with the actions that point somewhere in them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_por.common.errors import UserError

#: Fields of a batch that hold images, and those that hold actions
IMAGES = ("observations", "next_observations", "future_observations", "past_observations", "window_observations")
ACTIONS = ("actions", "window_actions")
#: Turns by 90 degrees, and whether the image is mirrored before: the symmetries of a square
ELEMENTS = tuple((turns, mirrored) for turns in range(4) for mirrored in (False, True))

#: Rows of a batch, and the symmetry that they are shown in
Blocks = list[tuple[slice, int, bool]]


def turned(batch: Any, planar_actions: Sequence[Sequence[int]]) -> Any:
    """
    Show each row as a camera would that is turned by a multiple of 90 degrees or looks into a mirror. All frames of a row are
    turned alike. Rows are drawn at random already, so each symmetry gets a block of them; which one, chance decides.

    :param batch: Samples of a replay buffer, a named tuple; images are ``(rows, ..., height, width)`` and square
    :param planar_actions: Pairs of elements of an action, of which one points right in the image and one points up
    :return: A new batch
    """
    n, n_blocks = len(batch.actions), len(ELEMENTS)
    first = int(th.randint(n_blocks, ()))
    blocks = [(slice(i * n // n_blocks, (i + 1) * n // n_blocks), *ELEMENTS[(first + i) % n_blocks]) for i in range(n_blocks)]

    def images(frames: Any) -> Any:
        if isinstance(frames, dict):
            return {key: images(part) for key, part in frames.items()}
        return (_turn_pixels if frames.device.type == "cpu" else _turn)(frames, blocks)

    def actions(values: th.Tensor) -> th.Tensor:
        out = values.clone()
        for rows, turns, mirrored in blocks:
            for right, up in planar_actions:
                x, y = values[rows, ..., right], values[rows, ..., up]
                x = -x if mirrored else x
                for _ in range(turns):
                    x, y = -y, x
                out[rows, ..., right], out[rows, ..., up] = x, y
        return out

    changes = [*((name, images) for name in IMAGES), *((name, actions) for name in ACTIONS)]
    given = [(name, change) for name, change in changes if getattr(batch, name, None) is not None]
    return batch._replace(**{name: change(getattr(batch, name)) for name, change in given})


def _turn(frames: th.Tensor, blocks: Blocks) -> th.Tensor:
    out = th.empty_like(frames)
    for rows, turns, mirrored in blocks:
        out[rows] = th.rot90(frames[rows].flip(-1) if mirrored else frames[rows], turns, (-2, -1))
    return out


def _turn_pixels(frames: th.Tensor, blocks: Blocks) -> th.Tensor:
    """On CPU, where channels are last in memory, numpy moves a pixel as one piece: twice as fast as torch."""
    source = frames.movedim(-3, -1).contiguous().numpy()
    out = np.empty_like(source)
    pixel = np.dtype((np.void, source.shape[-1] * source.itemsize))
    before, after = source.view(pixel)[..., 0], out.view(pixel)[..., 0]
    for rows, turns, mirrored in blocks:
        after[rows] = np.rot90(before[rows][..., ::-1] if mirrored else before[rows], turns, (-2, -1))
    return th.from_numpy(out).movedim(-1, -3)


def check_planar(planar_actions: Sequence[Any], observation_space: spaces.Space, action_space: spaces.Space) -> None:
    """
    :param planar_actions: See :func:`turned`
    :param observation_space: Of the model, images with channels first
    :param action_space: Of the model
    :raises UserError: If the pairs do not fit the actions, or observations are more than square images
    """
    assert isinstance(action_space, spaces.Box)  # as everywhere in SAC
    low, high = action_space.low.ravel(), action_space.high.ravel()
    pairs = [pair for pair in planar_actions if isinstance(pair, list | tuple) and len(pair) == 2]
    elements = [i for pair in pairs for i in pair if type(i) is int and 0 <= i < len(low)]
    if not pairs or len(set(elements)) < 2 * len(planar_actions):
        raise UserError(
            f"planar_actions must be pairs of different elements of an action, from 0 to {len(low) - 1}, such as [[0, 1]], "
            f"got {planar_actions!r}"
        )
    for pair in pairs:
        if np.ptp([*high[list(pair)], *-low[list(pair)]]) > 0:
            raise UserError(f"planar_actions: turned, the elements {list(pair)} of an action would leave their bounds")
    parts = observation_space.spaces.values() if isinstance(observation_space, spaces.Dict) else [observation_space]
    for shape in (part.shape or () for part in parts):
        if len(shape) != 3 or shape[-1] != shape[-2]:
            raise UserError(f"planar_actions: only square images can be turned, and observations have the shape {shape}")
