"""Variations: 1000 numbered scenes per task, the same on every machine. 800 are for training, 200 are held out."""

import zlib

import numpy as np

#: Indices of each split.
SPLITS = {"train": range(0, 800), "eval": range(800, 1000)}
N_VARIATIONS = 1000


def check_variation(index: object) -> int:
    """
    Validate ``options["variation"]``.

    :return: index as an int
    :raises ValueError: if it is not an integer in 0..999
    """
    if isinstance(index, bool) or not isinstance(index, (int, np.integer)) or not 0 <= index < N_VARIATIONS:
        raise ValueError(f'options["variation"] must be an integer from 0 to {N_VARIATIONS - 1}, got {index!r}')
    return int(index)


def variation_rng(scenes: str, index: int) -> np.random.Generator:
    """
    Random generator for everything that differs between the variations of a task.

    :param scenes: ``SoftbodyEnv.scenes``; tasks with different names share no random numbers
    :param index: 0..999
    """
    return np.random.default_rng([zlib.crc32(scenes.encode()), index])
