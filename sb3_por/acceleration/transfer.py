"""Host-to-device copies and checks that do not wait for the device."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch as th
from torch.distributions import Distribution


@contextmanager
def without_waiting(device: th.device) -> Iterator[None]:
    """
    A context without the argument checks of ``torch.distributions`` on devices other than the CPU: the host would wait for the
    result of each check.

    :param device: Device of the distributions
    """
    before = Distribution._validate_args
    Distribution.set_default_validate_args(before and device.type == "cpu")
    try:
        yield
    finally:
        Distribution.set_default_validate_args(before)


def to_device(tensor: th.Tensor, device: th.device) -> th.Tensor:
    """
    :param tensor: Tensor in host memory or on the device
    :param device: Target device
    :return: The tensor on the device. Host-to-device copies are asynchronous; device-to-host copies block
    """
    if device.type == "cuda" and tensor.device.type == "cpu":
        # A copy from pageable memory would wait for earlier work of the device
        tensor = tensor.pin_memory()
    return tensor.to(device, non_blocking=device.type != "cpu")


def free_memory(device: th.device) -> int | None:
    """
    :param device: A device
    :return: Free bytes of the device's own memory; None if it has no such memory or does not report it
    """
    if device.type == "cpu":
        return None
    tell = getattr(th.get_device_module(device), "mem_get_info", None)
    return None if tell is None else tell(device)[0]
