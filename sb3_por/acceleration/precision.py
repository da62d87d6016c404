"""Numerical precision of updates."""

from collections.abc import Callable
from typing import Any

import torch as th

PRECISIONS = ("float32", "tf32", "bfloat16")


def check_precision(precision: str) -> None:
    """
    :param precision: Name of a precision
    :raises ValueError: If there is no such precision
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be one of {', '.join(PRECISIONS)}, not {precision!r}.")


def allow_tf32() -> None:
    """Let matrix products and convolutions of GPUs use TF32, in the whole process."""
    th.set_float32_matmul_precision("high")
    th.backends.cudnn.allow_tf32 = True


def in_bfloat16(forward: Callable[..., th.Tensor], device: th.device) -> Callable[..., th.Tensor]:
    """
    :param forward: Forward function of a trunk
    :param device: Device of its parameters
    :return: The same function, computed in bfloat16; the result is float32
    """

    def wrapped(*args: Any) -> th.Tensor:
        # The cache would keep weights that were cast without gradient
        with th.autocast(device.type, th.bfloat16, cache_enabled=False):
            return forward(*args).float()

    return wrapped
