"""What makes updates faster on a GPU: lower precision, compiled networks, no waiting. It works on a CPU, and seldom pays."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch as th
from torch import nn


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
