"""States of the global random generators, so that a loaded model can go on as if it had never stopped."""

import random
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces


def get_rng_state(action_space: spaces.Space) -> dict[str, Any]:
    """
    :param action_space: Space whose generator draws the random actions of the warm-up
    :return: States of the generators of Python, numpy, torch and the action space
    """
    return dict(
        python=random.getstate(),
        numpy=np.random.get_state(),
        torch=th.get_rng_state().numpy(),
        cuda=[state.numpy() for state in th.cuda.get_rng_state_all()] if th.cuda.is_available() else [],
        action_space=action_space.np_random.bit_generator.state,
    )


def set_rng_state(state: dict[str, Any], action_space: spaces.Space) -> None:
    """
    :param state: From ``get_rng_state``
    :param action_space: Space whose generator draws the random actions of the warm-up
    """
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    th.set_rng_state(th.from_numpy(state["torch"]))
    if th.cuda.is_available() and len(state["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all([th.from_numpy(one) for one in state["cuda"]])
    action_space.np_random.bit_generator.state = state["action_space"]
