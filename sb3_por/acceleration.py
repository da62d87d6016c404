"""What makes updates faster on a GPU: lower precision, compiled networks, no waiting. It works on a CPU, and seldom pays."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch as th
from torch import nn
from torch.distributions import Distribution

PRECISIONS = ("float32", "tf32", "bfloat16")


def check_precision(precision: str) -> None:
    """
    :raises ValueError: If there is no such precision
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be one of {', '.join(PRECISIONS)}, not {precision!r}.")


class CompiledNetworks:
    """
    Compiled forms of the modules in which an update spends its time. They stand in for the modules during updates alone:
    acting, evaluation and diagnostics, with batches of other sizes, neither compile anew nor record CUDA graphs.

    :param policy: A visual policy
    :param mode: Of ``torch.compile``
    """

    def __init__(self, policy: Any, mode: str):
        from torch._functorch import config as functorch_config

        # Gradient norms and objectives with optimizers of their own go twice through one graph
        functorch_config.donated_buffer = False
        modules: list[nn.Module] = [policy.actor.latent_pi]
        for critic in (policy.critic, policy.critic_target):
            modules += [critic.features_extractor, *critic.q_networks]
        if policy.objective is not None:
            modules += policy.objective.children()
        # Not module.compile(), which passes over the containers of PyTorch
        self._forwards = [(module, th.compile(module.forward, mode=mode)) for module in modules]

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """The modules compute with their compiled forms."""
        for module, forward in self._forwards:
            module.forward = forward  # type: ignore[method-assign]
        try:
            yield
        finally:
            for module, _ in self._forwards:
                del module.forward


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
