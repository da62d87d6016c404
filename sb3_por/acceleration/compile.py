"""Compiled forms of the networks in which an update spends its time."""

from collections.abc import Callable
from typing import Any

import torch as th
from torch import nn


def compiled_forwards(policy: Any, mode: str) -> dict[nn.Module, Callable[..., Any]]:
    """
    :param policy: A visual policy
    :param mode: Mode of ``torch.compile``
    :return: Module: its compiled forward function
    """
    from torch._functorch import config as functorch_config

    # Gradient norms and objectives with optimizers of their own go twice through one graph. A setting of the whole process
    functorch_config.donated_buffer = False
    modules: list[nn.Module] = [policy.actor.latent_pi]
    for critic in (policy.critic, policy.critic_target):
        modules += [critic.features_extractor, *critic.q_networks]
    if policy.objective is not None:
        modules += policy.objective.children()
    return {module: th.compile(module.forward, mode=mode) for module in modules}
