"""Self-predictive representation (SPR, https://arxiv.org/abs/2007.05929), adapted to continuous actions."""

import copy

import torch as th
from stable_baselines3.common.utils import polyak_update
from torch import nn
from torch.nn import functional as F

from sb3_por.objectives.base import EncodedBatch, Objective, mlp

#: Sizes of the hidden layers of the latent model, and of projector and predictor: those of SPR for SAC in PlayVirtual
#: (https://arxiv.org/abs/2106.04152)
MODEL_DIM, PROJECTION_DIM = 512, 100


class SelfPredictive(Objective):
    """
    Predict the momentum encoder's features of the next K frames from the first frame and the actions. A latent model is
    unrolled; projector and predictor follow each latent, the momentum projector each target; the loss of a step is
    2 - 2 cos, summed over the K steps. Steps after the end of the episode do not count.

    :param features_dim: Size n of the encoder's features
    :param action_dim: Size of an action
    :param horizon: Number K of steps to predict
    """

    name = "spr"
    own_optimizer = True
    kept = False

    def __init__(self, features_dim: int, action_dim: int, horizon: int = 5):
        super().__init__(features_dim, action_dim)
        if horizon < 1:
            raise ValueError(f"horizon must be at least 1, not {horizon}.")
        self.window = horizon
        self.model = nn.Sequential(
            nn.Linear(features_dim + action_dim, MODEL_DIM),
            nn.LayerNorm(MODEL_DIM),
            nn.ReLU(),
            nn.Linear(MODEL_DIM, features_dim),
        )
        self.projector = mlp(features_dim, PROJECTION_DIM, features_dim)
        self.predictor = mlp(features_dim, PROJECTION_DIM, features_dim)
        self.momentum_projector = copy.deepcopy(self.projector).requires_grad_(False)

    def loss(self, batch: EncodedBatch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :param batch: Encoded frames, with ``window``, ``window_actions`` and ``window_mask``
        :return: The loss summed over the steps, its mean per step and the mean cosine
        """
        window, actions, mask = batch.window, batch.window_actions, batch.window_mask
        assert window is not None and actions is not None and mask is not None
        latent, predictions = batch.present, []
        for step in range(self.window):
            latent = self.model(th.cat([latent, actions[:, step]], dim=1))
            predictions.append(self.predictor(self.projector(latent)))
        with th.no_grad():
            targets = self.momentum_projector(window.flatten(0, 1)).unflatten(0, (-1, self.window))
        cosine = F.cosine_similarity(th.stack(predictions, dim=1), targets, dim=2)
        loss = (mask * (2 - 2 * cosine)).sum(dim=1).mean()
        n_steps = mask.sum()
        mean_cosine = (mask * cosine).sum().detach() / n_steps
        return loss, {"loss": 2 - 2 * mean_cosine, "cosine": mean_cosine}

    def update_momentum(self, tau: float) -> None:
        polyak_update(self.projector.parameters(), self.momentum_projector.parameters(), tau)
