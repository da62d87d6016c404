"""A context manager for updates: lower precision, compiled networks, and no waiting for the device."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch as th
from torch import nn

from sb3_por.acceleration.allocator import keep_freed_memory
from sb3_por.acceleration.compile import compiled_forwards
from sb3_por.acceleration.precision import allow_tf32, in_bfloat16
from sb3_por.acceleration.threads import use_one_thread
from sb3_por.acceleration.transfer import without_waiting


class AcceleratedUpdates:
    """
    Changes how updates compute. Acting, evaluation and diagnostics are left alone: with batches of other sizes they would
    compile the networks again, or record more CUDA graphs.

    :param policy: A visual policy
    :param precision: ``"float32"``, ``"tf32"`` or ``"bfloat16"``, see ``VisualSAC``
    :param compile_mode: Mode of ``torch.compile``; None to compile nothing
    """

    def __init__(self, policy: Any, precision: str, compile_mode: str | None):
        self._device: th.device = policy.device
        self._compiles = compile_mode is not None
        # Module: its forward function during updates
        self._forwards: dict[nn.Module, Callable[..., Any]] = {}
        if self._device.type == "cpu":
            use_one_thread()
            keep_freed_memory()
        if precision == "tf32":
            allow_tf32()
        if compile_mode is not None:
            self._forwards.update(compiled_forwards(policy, compile_mode))
        if precision == "bfloat16":
            # A set: the actor may share the critic's trunk
            for trunk in {network.features_extractor for network in (policy.critic, policy.critic_target, policy.actor)}:
                self._forwards[trunk] = in_bfloat16(self._forwards.get(trunk, trunk.forward), self._device)

    @contextmanager
    def update(self) -> Iterator[None]:
        """A context around one update."""
        if self._compiles:
            # Results of CUDA graphs stay valid until the next update: trunk features are used twice
            th.compiler.cudagraph_mark_step_begin()
        for module, forward in self._forwards.items():
            module.forward = forward  # type: ignore[method-assign]  # not module.compile(), which skips PyTorch's containers
        try:
            with without_waiting(self._device):
                yield
        finally:
            for module in self._forwards:
                del module.forward
