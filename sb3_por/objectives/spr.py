"""Self-predictive representation (SPR, https://arxiv.org/abs/2007.05929), adapted to continuous actions."""

import copy

import torch as th
from stable_baselines3.common.utils import polyak_update
from torch import nn
from torch.nn import functional as F

from sb3_por.objectives.base import Objective, mlp
from sb3_por.visual.views import Views


class SelfPredictive(Objective):
    """
    Predict the momentum encoder's features of the next K frames from the first frame and the actions. A latent model is
    unrolled; projector and predictor follow each latent, the momentum projector each target; the loss of a step is
    2 - 2 cos, summed over the K steps. Steps after the end of the episode do not count.

    Sizes are those of SPR for SAC in PlayVirtual (https://arxiv.org/abs/2106.04152).

    :param features_dim: Size n of the encoder's features
    :param action_dim: Size of an action
    :param horizon: Number K of steps to predict
    :param model_dim: Size of the latent model's hidden layer
    :param projection_dim: Size of the hidden layers of projector and predictor
    """

    name = "spr"
    own_optimizer = True

    def __init__(self, features_dim: int, action_dim: int, horizon: int = 5, model_dim: int = 512, projection_dim: int = 100):
        super().__init__(features_dim, action_dim)
        if horizon < 1:
            raise ValueError(f"horizon must be at least 1, not {horizon}.")
        self.window = horizon
        self.model = nn.Sequential(
            nn.Linear(features_dim + action_dim, model_dim),
            nn.LayerNorm(model_dim),
            nn.ReLU(),
            nn.Linear(model_dim, features_dim),
        )
        self.projector = mlp(features_dim, projection_dim, features_dim)
        self.predictor = mlp(features_dim, projection_dim, features_dim)
        self.momentum_projector = copy.deepcopy(self.projector).requires_grad_(False)

    def loss(self, views: Views) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :param views: The frames of the batch, among them ``"obs"`` and ``"window"`` with actions and mask
        :return: The loss summed over the steps, its mean per step and the mean cosine
        """
        actions, mask = views.data["window_actions"], views.data["window_mask"]
        latent, predictions = views.online("obs"), []
        for step in range(self.window):
            latent = self.model(th.cat([latent, actions[:, step]], dim=1))
            predictions.append(self.predictor(self.projector(latent)))
        with th.no_grad():
            targets = self.momentum_projector(views.momentum("window")).unflatten(0, (-1, self.window))
        cosine = F.cosine_similarity(th.stack(predictions, dim=1), targets, dim=2)
        loss = (mask * (2 - 2 * cosine)).sum(dim=1).mean()
        n_steps = mask.sum()
        mean_cosine = (mask * cosine).sum().detach() / n_steps
        return loss, {"loss": 2 - 2 * mean_cosine, "cosine": mean_cosine}

    def update_momentum(self, tau: float) -> None:
        polyak_update(self.projector.parameters(), self.momentum_projector.parameters(), tau)
