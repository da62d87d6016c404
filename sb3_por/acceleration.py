"""What makes updates faster on a GPU: lower precision and compiled networks. On a CPU all of it works, and seldom pays."""

from typing import Any

import torch as th
from torch import nn

PRECISIONS = ("float32", "tf32", "bfloat16")


def check_precision(precision: str) -> None:
    """
    :raises ValueError: If there is no such precision
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be one of {', '.join(PRECISIONS)}, not {precision!r}.")


def compile_networks(policy: Any, mode: str) -> None:
    """
    Compile, in place, the modules in which an update spends its time. Names of parameters stay, so that saved models load
    with and without.

    :param policy: A visual policy
    :param mode: Of ``torch.compile``
    """
    modules: list[nn.Module] = [policy.actor.latent_pi]
    for critic in (policy.critic, policy.critic_target):
        modules += [critic.features_extractor, *critic.q_networks]
    if policy.objective is not None:
        modules += policy.objective.children()
    from torch._functorch import config as functorch_config

    # Gradient norms and objectives with optimizers of their own go twice through one graph
    functorch_config.donated_buffer = False
    for module in modules:
        # Not module.compile(), which passes over the containers of PyTorch
        module.forward = th.compile(module.forward, mode=mode)  # type: ignore[method-assign]
