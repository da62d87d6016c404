"""Heads of the partial-order classifier c: which of two vectors of physical quantities comes later."""

from abc import ABC, abstractmethod

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_por.objectives.base import mlp


class OrderHead(nn.Module, ABC):
    """The classifier c: ``forward`` gives the logit of "the first argument is the later one" (label 1)."""

    @abstractmethod
    def forward(self, first: th.Tensor, second: th.Tensor) -> th.Tensor:
        """
        :param first: Physical quantities, shape ``(batch, order_dim)``
        :param second: Physical quantities, shape ``(batch, order_dim)``
        :return: Logits, shape ``(batch,)``; ``c(first, second)`` is their sigmoid
        """

    @abstractmethod
    def potential(self, quantities: th.Tensor) -> th.Tensor:
        """
        :param quantities: Shape ``(batch, order_dim)``
        :return: A number for each that is larger the later it comes in the learned order, shape ``(batch,)``
        """


class MlpHead(OrderHead):
    """
    An MLP on the concatenation, as in the paper. Nothing makes it antisymmetric or transitive; its potential is a Borda
    count: how far, on average, one is judged later than the others of the batch.
    """

    def __init__(self, order_dim: int, hidden_dim: int):
        super().__init__()
        self.net = mlp(2 * order_dim, hidden_dim, 1)

    def forward(self, first: th.Tensor, second: th.Tensor) -> th.Tensor:
        return self.net(th.cat([first, second], dim=1)).squeeze(1)

    def potential(self, quantities: th.Tensor) -> th.Tensor:
        n = len(quantities)
        return th.stack(
            [(self(one.expand(n, -1), quantities) - self(quantities, one.expand(n, -1))).mean() for one in quantities]
        )


class DifferenceHead(OrderHead):
    """Antisymmetric: ``logit = h(first) - h(second)``; h is a potential that grows with time (a total order)."""

    def __init__(self, order_dim: int, hidden_dim: int):
        super().__init__()
        self.net = mlp(order_dim, hidden_dim, 1)

    def forward(self, first: th.Tensor, second: th.Tensor) -> th.Tensor:
        return self.potential(first) - self.potential(second)

    def potential(self, quantities: th.Tensor) -> th.Tensor:
        return self.net(quantities).squeeze(1)


class CoordinatewiseHead(OrderHead):
    """
    A true partial order, as in order embeddings (https://arxiv.org/abs/1511.06361): ``first`` comes before ``second``
    if no coordinate of it is larger. The logit is the squared violation of that, scaled, minus a learned threshold;
    where each of two is larger in some coordinate, neither comes first. The potential is the sum of the coordinates.
    """

    def __init__(self, order_dim: int, hidden_dim: int):
        super().__init__()
        self.log_scale = nn.Parameter(th.zeros(1))
        self.log_threshold = nn.Parameter(th.zeros(1))

    def forward(self, first: th.Tensor, second: th.Tensor) -> th.Tensor:
        violation = F.relu(first - second).square().sum(dim=1)
        return self.log_scale.exp() * violation - self.log_threshold.exp()

    def potential(self, quantities: th.Tensor) -> th.Tensor:
        return quantities.sum(dim=1)


ORDER_HEADS: dict[str, type[OrderHead]] = {
    "mlp": MlpHead,
    "difference": DifferenceHead,
    "coordinatewise": CoordinatewiseHead,
}
