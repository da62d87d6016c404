"""The interface of an auxiliary objective: a small module that turns encoded frames into a loss."""

import inspect
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch as th
from torch import nn


@dataclass(frozen=True)
class EncodedBatch:
    """
    The frames of a batch of transitions after the encoders, and the actions between them.

    f_o is the online encoder, whose features carry gradients; f_m is the momentum encoder, whose features carry none. A field
    that the objective did not ask for is None.

    :param present: f_o(o_t), shape ``(batch, features_dim)``
    :param future: f_m(o_{t+k}), shape ``(batch, features_dim)``; k is at most the number of steps left in the episode
    :param past: f_m(o_{t-k}) for the first half of the batch, shape ``(batch // 2, features_dim)``
    :param has_past: Whether o_t has an earlier frame in its episode, bool, shape ``(batch // 2, 1)``; ``past`` is f_m(o_t)
        where it has none
    :param positive: f_m of another augmentation of o_t, shape ``(batch, features_dim)``
    :param window: f_m(o_{t+1}), ..., f_m(o_{t+K}), shape ``(batch, K, features_dim)``
    :param window_actions: a_t, ..., a_{t+K-1}, shape ``(batch, K, action_dim)``
    :param window_rewards: r_t, ..., r_{t+K-1}, shape ``(batch, K)``
    :param window_mask: 1 where a step of the window belongs to the episode, else 0, shape ``(batch, K)``
    """

    present: th.Tensor
    future: th.Tensor | None = None
    past: th.Tensor | None = None
    has_past: th.Tensor | None = None
    positive: th.Tensor | None = None
    window: th.Tensor | None = None
    window_actions: th.Tensor | None = None
    window_rewards: th.Tensor | None = None
    window_mask: th.Tensor | None = None


class Objective(nn.Module, ABC):
    """
    An auxiliary loss for the encoder, with networks of its own. It sees encoded frames and actions, and knows nothing of the
    algorithm that trains it.

    :param features_dim: Size n of the encoder's features
    :param action_dim: Size of an action
    """

    #: Name in the logs: metrics appear as ``train/<name>_<metric>``
    name: str
    #: Smallest and largest k of ``EncodedBatch.future``; None if the objective does not use that field
    future: tuple[int, int] | None = None
    #: Smallest and largest k of ``EncodedBatch.past``; None if the objective does not use that field
    past: tuple[int, int] | None = None
    #: Length K of ``EncodedBatch.window``; 0 if the objective does not use that field
    window: int = 0
    #: Whether the objective uses ``EncodedBatch.positive``
    positive: bool = False
    #: Whether an optimizer of its own steps the encoder and the objective; else the weighted loss is added to the critic's.
    #: Adam's step size does not depend on the scale of a loss, so the critic cannot drown out an objective with an optimizer
    own_optimizer: bool = False
    #: Whether a trained objective tells something about frames, as an order does; else exported agents go without it
    kept: bool = True

    def __init__(self, features_dim: int, action_dim: int):
        super().__init__()
        self.features_dim = features_dim
        self.action_dim = action_dim

    @classmethod
    def arguments(cls) -> list[str]:
        """
        :return: Names of the constructor's arguments besides the sizes: the settings of the objective
        """
        return [name for name in inspect.signature(cls).parameters if name not in ("features_dim", "action_dim")]

    @abstractmethod
    def loss(self, batch: EncodedBatch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :param batch: Encoded frames
        :return: The loss (a scalar), and detached scalars to log
        """

    def control(self, batch: EncodedBatch) -> dict[str, th.Tensor]:
        """
        Measure the objective on data without the structure that it should find. Called every ``diagnostics_interval`` updates,
        without gradient.

        :param batch: One frame of each transition, augmented independently, as ``present``, ``future`` and ``past``
        :return: Scalars to log; empty if the objective has no control
        """
        return {}

    def update_momentum(self, tau: float) -> None:
        """
        Update the objective's own moving averages. Called right after the update of the momentum encoder.

        :param tau: Soft update coefficient of the momentum encoder
        """


def mlp(in_dim: int, hidden_dim: int, out_dim: int) -> nn.Sequential:
    """
    :param in_dim: Size of the input
    :param hidden_dim: Size of the hidden layer
    :param out_dim: Size of the output
    :return: Linear -> ReLU -> Linear
    """
    return nn.Sequential(nn.Linear(in_dim, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, out_dim))
