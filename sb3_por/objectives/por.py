"""Partial-order representation (POR): learn which of two frames of an episode came first (the paper's Algorithm 1)."""

import torch as th
from torch.nn import functional as F

from sb3_por.objectives.base import EncodedBatch, Objective, mlp
from sb3_por.objectives.order_heads import ORDER_HEADS

PAIRINGS = ("paper", "swap", "sham")
#: Size of the hidden layers of g and c
HIDDEN_DIM = 256


class PartialOrder(Objective):
    """
    L_POR of the paper's equation (4). With s_t = f_o(o_t), s~_{t+k} = f_m(o_{t+k}), x = g(s), the classifier c is shown
    (x_t, x_{t+k}) with label 0 and (x_{t+k}, x_t) with label 1:

        L_POR = -log(1 - c(x_t, x_{t+k})) - log c(x_{t+k}, x_t)

    In this pairing the online encoder always has the earlier frame, so c can learn to tell the encoders apart instead of the
    times. ``pairing="swap"`` gives the online encoder the later frame in one half of the batch; the labels follow time. The
    batch is i.i.d., so a fixed half is a random half. In that half o_t is paired with o_{t-k}, which spares the online encoder
    a second pass; the first frame of an episode has no earlier one and stays paired with o_{t+k}.

    ``pairing="sham"`` is a control: swapped pairs whose order is drawn by chance, anew in each batch. There is nothing to
    learn, so an effect on the agent is one of the loss itself.

    :param features_dim: Size n of the encoder's features
    :param action_dim: Size of an action
    :param pairing: ``"paper"``, ``"swap"`` or ``"sham"``
    :param order_head: The classifier c: ``"mlp"`` (the paper's), ``"difference"`` or ``"coordinatewise"``
    :param order_dim: Size m < n of the physical quantities x; n // 2 by default
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
        self.past = None if pairing == "paper" else self.future
        self.g = mlp(features_dim, HIDDEN_DIM, order_dim)
        self.c = ORDER_HEADS[order_head](order_dim, HIDDEN_DIM)

    def loss(self, batch: EncodedBatch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :param batch: Encoded frames, with ``future``, and with ``past`` for swapped pairs
        :return: L_POR, and the loss per term (ln 2 at chance) with the classifier's accuracy (1/2 at chance)
        """
        s_t, s_tk = self.pairs(batch)
        x_t, x_tk = self.g(s_t), self.g(s_tk)
        logit_0, logit_1 = self.c(x_t, x_tk), self.c(x_tk, x_t)
        # -log(1 - sigmoid(l)) = softplus(l) and -log sigmoid(l) = softplus(-l)
        loss = (F.softplus(logit_0) + F.softplus(-logit_1)).mean()
        # A tie is half right
        accuracy = 0.5 + 0.25 * (th.sign(logit_1) - th.sign(logit_0)).mean()
        return loss, {"loss": loss.detach() / 2, "accuracy": accuracy.detach()}

    def pairs(self, batch: EncodedBatch) -> tuple[th.Tensor, th.Tensor]:
        """
        :param batch: Encoded frames
        :return: Features of the earlier and of the later frame of each pair, shape ``(batch, n)`` each
        """
        present, future, past, has_past = batch.present, batch.future, batch.past, batch.has_past
        assert future is not None
        if self.pairing == "paper":
            return present, future
        assert past is not None and has_past is not None
        half = len(past)
        s_t = th.cat([th.where(has_past, past, present[:half]), present[half:]])
        s_tk = th.cat([th.where(has_past, present[:half], future[:half]), future[half:]])
        if self.pairing == "sham":
            flipped = th.rand(len(s_t), 1, device=s_t.device) < 0.5
            s_t, s_tk = th.where(flipped, s_tk, s_t), th.where(flipped, s_t, s_tk)
        return s_t, s_tk

    def control(self, batch: EncodedBatch) -> dict[str, th.Tensor]:
        """
        Measure the encoder leak: the loss and the accuracy on pairs with k = 0. One frame has no order, so both must stay at
        chance (ln 2 per term and 1/2); otherwise the classifier tells the two encoders apart.

        :param batch: One frame of each transition, augmented independently, as ``present``, ``future`` and ``past``
        :return: ``leak_loss`` (per term) and ``leak_accuracy``
        """
        metrics = self.loss(batch)[1]
        return {f"leak_{name}": value for name, value in metrics.items()}

    def potential(self, features: th.Tensor) -> th.Tensor:
        """
        :param features: Encoded frames, shape ``(batch, n)``
        :return: A number for each frame that is larger the later it comes in the learned order, shape ``(batch,)``
        """
        return self.c.potential(self.g(features))
