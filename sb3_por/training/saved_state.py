"""Check of what a loaded model holds besides its networks, before it is trained further: files can be edited by hand."""

from collections import deque
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import ActionNoise

from sb3_por.common.checks import check_types
from sb3_por.common.errors import UserError, short
from sb3_por.evaluation.model_files import read_data

#: State of training that not every constructor takes: its types
STATE: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(
        ("num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "_episode_num", "_n_updates"), (Integral,)
    ),
    **dict.fromkeys(("start_time", "_current_progress_remaining"), (Real,)),
    "_stats_window_size": (Integral,),
    **dict.fromkeys(("ep_info_buffer", "ep_success_buffer"), (deque,)),
    **dict.fromkeys(("_last_obs", "_last_original_obs"), (np.ndarray, dict, type(None))),
    "action_noise": (ActionNoise, type(None)),
    # Of OverlappedTraining, in the file if it was saved during training
    "_defers_updates": (bool,),
    "_updates_due": (Integral,),
}


def check_saved_state(file: Path, model: BaseAlgorithm) -> None:
    """
    :param file: The model's ``.zip``
    :param model: The model as it was loaded from it
    :raises UserError: If the file holds what no model saves, or something of another type; names it
    """
    values = vars(model)
    try:
        _check(read_data(file), values, model)
    except TypeError as error:
        raise UserError(f"{file} cannot be trained further: {error}; use a file as model.save() wrote it") from error


def _check(data: dict[str, Any], values: dict[str, Any], model: BaseAlgorithm) -> None:
    """
    :raises TypeError: See ``check_saved_state``
    """
    left_out = sorted(set(data) & set(model._excluded_save_params()))
    if left_out:
        raise TypeError(f"it holds {left_out[0]}, which no model saves")
    # Not those that SB3 has replaced by objects
    check_types(type(model), {name: value for name, value in values.items() if name not in ("env", "policy", "device")})
    learned = values["ep_info_buffer"] is not None or values["ep_success_buffer"] is not None
    for name, types in STATE.items():
        if name not in values:
            continue
        value = values[name]
        if not isinstance(value, types) and (learned or value is not None or types != (deque,)):
            expected = " or ".join(one.__name__ for one in types)
            raise TypeError(f"{name} must be {expected}, got {short(value)}")
