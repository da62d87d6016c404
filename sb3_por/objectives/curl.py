"""Contrastive representation (CURL, https://arxiv.org/abs/2004.04136): recognize a frame under another augmentation."""

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_por.objectives.base import EncodedBatch, Objective


class Contrastive(Objective):
    """
    InfoNCE with a bilinear similarity: among the momentum encoder's features of the batch, pick those of the same frame
    under another augmentation.

        logits = f_o(o) W f_m(o')^T,  the label of row i is i

    :param features_dim: Size n of the encoder's features
    :param action_dim: Size of an action
    """

    name = "curl"
    positive = True
    own_optimizer = True
    kept = False

    def __init__(self, features_dim: int, action_dim: int):
        super().__init__(features_dim, action_dim)
        self.weight = nn.Parameter(th.rand(features_dim, features_dim))

    def loss(self, batch: EncodedBatch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :param batch: Encoded frames, with ``positive``
        :return: The cross entropy (chance is the logarithm of the batch size), and the accuracy of the pick
        """
        assert batch.positive is not None
        logits = batch.present @ self.weight @ batch.positive.T
        labels = th.arange(len(logits), device=logits.device)
        loss = F.cross_entropy(logits, labels)
        accuracy = (logits.argmax(dim=1) == labels).float().mean()
        return loss, {"loss": loss.detach(), "accuracy": accuracy}
