"""Partial-order representation (POR): learn which of two frames of an episode came first (the paper's Algorithm 1)."""

from abc import ABC, abstractmethod

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_por.objectives.base import Objective, mlp
from sb3_por.visual.views import Views


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
PAIRINGS = ("paper", "swap")


class PartialOrder(Objective):
    """
    L_POR of the paper's equation (4). With s_t = f_o(o_t), s~_{t+k} = f_m(o_{t+k}), x = g(s), the classifier c is shown
    (x_t, x_{t+k}) with label 0 and (x_{t+k}, x_t) with label 1:

        L_POR = -log(1 - c(x_t, x_{t+k})) - log c(x_{t+k}, x_t)

    In that pairing the online encoder always has the earlier frame, and c can tell the encoders apart instead of the
    times. ``pairing="swap"`` gives the online encoder the later frame in one half of the batch (the batch is i.i.d., so
    that a fixed half is a random half); labels follow time. There the pair of o_t is o_{t-k} instead of o_{t+k}, so that
    the online encoder has to encode no frames but those of the critic. Where o_t is the first of its episode its pair
    stays o_{t+k}; where the replay buffer cannot go back the encoders are swapped, (f_m(o_t), f_o(o_{t+k})).

    :param features_dim: Size n of the encoder's features
    :param action_dim: Size of an action
    :param pairing: ``"paper"`` or ``"swap"``
    :param order_head: The classifier c: ``"mlp"`` (the paper's), ``"difference"`` or ``"coordinatewise"``
    :param order_dim: Size m < n of the physical quantities x; n // 2 by default
    :param hidden_dim: Size of the hidden layers of g and c
    :param k: Distance of the two frames; k = 1 in the paper
    :param random_k: Draw the distance of each pair from 1..k
    """

    name = "por"

    def __init__(
        self,
        features_dim: int,
        action_dim: int,
        pairing: str = "swap",
        order_head: str = "mlp",
        order_dim: int | None = None,
        hidden_dim: int = 256,
        k: int = 1,
        random_k: bool = False,
    ):
        super().__init__(features_dim, action_dim)
        order_dim = features_dim // 2 if order_dim is None else order_dim
        if pairing not in PAIRINGS:
            raise ValueError(f"pairing must be one of {', '.join(PAIRINGS)}, not {pairing!r}.")
        if order_head not in ORDER_HEADS:
            raise ValueError(f"order_head must be one of {', '.join(ORDER_HEADS)}, not {order_head!r}.")
        if not 0 < order_dim < features_dim:
            raise ValueError(
                f"order_dim must be at least 1 and less than the encoder's {features_dim} features, not {order_dim}."
            )
        if k < 1:
            raise ValueError(f"k must be at least 1, not {k}.")
        self.pairing = pairing
        self.future = (1 if random_k else k, k)
        self.past = self.future if pairing == "swap" else None
        self.g = mlp(features_dim, hidden_dim, order_dim)
        self.c = ORDER_HEADS[order_head](order_dim, hidden_dim)

    def loss(self, views: Views) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :param views: The frames of the batch, among them ``"obs"`` and ``"future"``
        :return: L_POR, and the loss per term (chance is ln 2) with the classifier's accuracy
        """
        s_t, s_tk = self.pairs(views)
        x_t, x_tk = self.g(s_t), self.g(s_tk)
        logit_0, logit_1 = self.c(x_t, x_tk), self.c(x_tk, x_t)
        # -log(1 - sigmoid(l)) = softplus(l) and -log sigmoid(l) = softplus(-l)
        loss = (F.softplus(logit_0) + F.softplus(-logit_1)).mean()
        # A tie is half right
        accuracy = 0.5 + 0.25 * (th.sign(logit_1) - th.sign(logit_0)).mean()
        return loss, {"loss": loss.detach() / 2, "accuracy": accuracy.detach()}

    def pairs(self, views: Views) -> tuple[th.Tensor, th.Tensor]:
        """
        :param views: The frames of the batch, among them ``"obs"``, ``"future"`` and, if there are such, ``"past"``
        :return: Features of the earlier and of the later frame of each pair, shape ``(batch, n)`` each
        """
        if self.pairing == "paper":
            return views.online("obs"), views.momentum("future")
        half = views.batch_size // 2
        if "past" in views.frames:
            past, present, future = views.momentum("past"), views.online("obs"), views.momentum("future")
            has_past = views.data["past_gaps"][:, None] > 0
            s_t = th.cat([th.where(has_past, past, present[:half]), present[half:]])
            s_tk = th.cat([th.where(has_past, present[:half], future[:half]), future[half:]])
            return s_t, s_tk
        s_t = th.cat([views.momentum("obs", slice(half)), views.online("obs")[half:]])
        s_tk = th.cat([views.online("future", half), views.momentum("future", slice(half, None))])
        return s_t, s_tk

    def control(self, views: Views) -> dict[str, th.Tensor]:
        """
        The leak control: the loss and the accuracy on pairs with k = 0. There is no order in one frame, so that both
        must stay at chance (ln 2 per term and 1/2); where they do not, the classifier reads off the encoder.

        :param views: The same frame, augmented independently, as ``"obs"``, ``"future"`` and ``"past"``
        :return: ``leak_loss`` (per term) and ``leak_accuracy``
        """
        metrics = self.loss(views)[1]
        return {f"leak_{name}": value for name, value in metrics.items()}

    def potential(self, features: th.Tensor) -> th.Tensor:
        """
        :param features: Encoded frames, shape ``(batch, n)``
        :return: A number for each frame that is larger the later it comes in the learned order, shape ``(batch,)``
        """
        return self.c.potential(self.g(features))
