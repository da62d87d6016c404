"""Truncated quantile critics from pixels."""

from typing import ClassVar

import torch as th
from sb3_contrib import TQC
from sb3_contrib.common.utils import quantile_huber_loss
from stable_baselines3.common.policies import BasePolicy

from sb3_por.visual.actor_critic import VisualActorCritic
from sb3_por.visual.policies import TQCCnnPolicy, TQCMlpPolicy, TQCMultiInputPolicy, VisualQuantileCritic, VisualTQCPolicy


class VisualTQC(VisualActorCritic, TQC):
    """
    Truncated quantile critics (TQC) for images: sb3-contrib's TQC with the training step, the encoder, the augmentation
    and the replay buffer of ``VisualSAC``.

    It takes TQC's arguments in TQC's order, then by keyword those of ``VisualSAC`` from ``encoder_tau`` on.

    :param top_quantiles_to_drop_per_net: Quantiles of each critic that the target leaves out
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": TQCMlpPolicy,
        "CnnPolicy": TQCCnnPolicy,
        "MultiInputPolicy": TQCMultiInputPolicy,
    }
    policy: VisualTQCPolicy
    critic: VisualQuantileCritic
    critic_target: VisualQuantileCritic

    def _next_values(self, features: th.Tensor, actions: th.Tensor, entropy_term: th.Tensor) -> th.Tensor:
        quantiles = self.critic_target.quantiles(features, actions).flatten(start_dim=1)
        n_kept = self.critic.quantiles_total - self.top_quantiles_to_drop_per_net * self.critic.n_critics
        return quantiles.sort(dim=1).values[:, :n_kept] - entropy_term

    def _critic_loss(self, features: th.Tensor, actions: th.Tensor, target: th.Tensor) -> th.Tensor:
        quantiles = self.critic.quantiles(features, actions)
        return quantile_huber_loss(quantiles, target.unsqueeze(1), sum_over_quantiles=False)

    def _actor_values(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return self.critic.quantiles(features, actions).mean(dim=2).mean(dim=1, keepdim=True)
