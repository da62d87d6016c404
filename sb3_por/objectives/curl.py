"""Contrastive representation (CURL, https://arxiv.org/abs/2004.04136): recognise a frame under another augmentation."""

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_por.objectives.base import Objective
from sb3_por.visual.views import Views


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

    def __init__(self, features_dim: int, action_dim: int):
        super().__init__(features_dim, action_dim)
        self.weight = nn.Parameter(th.rand(features_dim, features_dim))

    def loss(self, views: Views) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :param views: The frames of the batch, among them ``"obs"`` and ``"positive"``
        :return: The cross entropy (chance is the logarithm of the batch size), and how often the pick is right
        """
        logits = views.online("obs") @ self.weight @ views.momentum("positive").T
        labels = th.arange(len(logits), device=logits.device)
        loss = F.cross_entropy(logits, labels)
        accuracy = (logits.argmax(dim=1) == labels).float().mean()
        return loss, {"loss": loss.detach(), "accuracy": accuracy}
