"""Host-to-device copies and checks that do not wait for the device."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch as th
from torch.distributions import Distribution


@contextmanager
def without_waiting(device: th.device) -> Iterator[None]:
    """
    Distributions do not check their arguments where the host would have to wait for the device to see the result of the
    check. They do on a CPU; and those of actions that a policy takes, which the host has to wait for anyway, do everywhere.

    :param device: Where the distributions are
    """
    before = Distribution._validate_args
    Distribution.set_default_validate_args(before and device.type == "cpu")
    try:
        yield
    finally:
        Distribution.set_default_validate_args(before)


def to_device(tensor: th.Tensor, device: th.device) -> th.Tensor:
    """
    :param tensor: In the host's memory, or on the device
    :param device: Where it should be
    :return: The tensor there. The host waits for copies to itself alone: others come before whatever the device does next
    """
    if device.type == "cuda" and tensor.device.type == "cpu":
        # From memory that can be paged out the copy would wait for the device's earlier work
        tensor = tensor.pin_memory()
    return tensor.to(device, non_blocking=device.type != "cpu")


def free_memory(device: th.device) -> int | None:
    """
    :return: Bytes of the device's own memory that are free; None where it has none, or does not say
    """
    if device.type == "cpu":
        return None
    tell = getattr(th.get_device_module(device), "mem_get_info", None)
    return None if tell is None else tell(device)[0]
