"""Numbers of stacked frames."""

import numpy as np
from gymnasium import spaces


def n_stacked(stacked: spaces.Space, single: spaces.Space) -> int:
    """
    :param stacked: Space of stacked observations
    :param single: Space of one observation
    :return: Number of observations of one space that are stacked in one of the other; 1 where that cannot be
    """
    if isinstance(stacked, spaces.Dict) and isinstance(single, spaces.Dict):
        numbers = {n_stacked(part, single.spaces[key]) for key, part in stacked.spaces.items() if key in single.spaces}
        return numbers.pop() if len(numbers) == 1 else 1
    if isinstance(stacked, spaces.Box) and isinstance(single, spaces.Box):
        return int(np.prod(stacked.shape)) // max(int(np.prod(single.shape)), 1)
    return 1
