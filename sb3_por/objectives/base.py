"""What an auxiliary objective is: a small module that turns encoded frames into a loss."""

from abc import ABC, abstractmethod

import torch as th
from torch import nn

from sb3_por.visual.views import Views


class Objective(nn.Module, ABC):
    """
    An auxiliary loss for the encoder, with networks of its own. It sees frames, their encodings and actions, and knows
    nothing of the algorithm that trains it.

    :param features_dim: Size n of the encoder's features
    :param action_dim: Size of an action
    """

    #: The logger's name of the objective: its metrics appear as ``train/<name>_<metric>``
    name: str
    #: Range of k if the objective needs ``"future"``, the frame k steps later
    future: tuple[int, int] | None = None
    #: Range of k if the objective wants ``"past"``, for the first half of the batch the frame k steps earlier, and
    #: ``"past_gaps"``, these k; a replay buffer that has no such frames gives neither
    past: tuple[int, int] | None = None
    #: Length K of ``"window"``, the next K frames with their actions; 0 if the objective does not need it
    window: int = 0
    #: Whether the objective needs ``"positive"``, another augmentation of the observation
    positive: bool = False
    #: Whether an optimizer of its own steps the encoder and the objective; otherwise its weighted loss is added to the
    #: critic's. Adam's steps do not know how large a loss is, so that the critic cannot drown out an objective that has one
    own_optimizer: bool = False

    def __init__(self, features_dim: int, action_dim: int):
        super().__init__()
        self.features_dim = features_dim
        self.action_dim = action_dim

    @abstractmethod
    def loss(self, views: Views) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :param views: The frames of the batch
        :return: The loss (a scalar), and detached scalars to log
        """

    def control(self, views: Views) -> dict[str, th.Tensor]:
        """
        Measure what the objective could do without the structure that it is meant to find. Called now and then,
        without gradient.

        :param views: The same frame, augmented independently, as ``"obs"``, ``"future"`` and ``"past"``
        :return: Scalars to log; none if the objective has no such control
        """
        return {}

    def update_momentum(self, tau: float) -> None:
        """
        Update networks of the objective that are moving averages; called together with the momentum encoder's update.

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
