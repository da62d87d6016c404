"""The model-based representation of MR.Q (https://arxiv.org/abs/2501.16142): predict latent dynamics and rewards."""

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_por.objectives.base import EncodedBatch, Objective

#: Size of the latent model's hidden layer, as in the paper.
MODEL_DIM = 512
#: The reward is predicted as a distribution over N_BINS values, evenly spaced in symlog units from -LIMIT to LIMIT: rewards up
#: to exp(10) fit, so their scale need not be known.
N_BINS, LIMIT = 65, 10.0
#: Weight of the reward's loss beside that of the dynamics, as in the paper.
REWARD_WEIGHT = 0.1


def two_hot(values: th.Tensor) -> th.Tensor:
    """
    :param values: Any numbers, shape ``(...)``
    :return: Weights of the two bins on either side of each number's symlog, which sum to 1, shape ``(..., N_BINS)``
    """
    symlog = values.sign() * values.abs().log1p()
    place = (symlog.clamp(-LIMIT, LIMIT) + LIMIT) * (N_BINS - 1) / (2 * LIMIT)
    return (1 - (place.unsqueeze(-1) - th.arange(N_BINS, device=values.device)).abs()).clamp(min=0.0)


class ModelBased(Objective):
    """
    Predict the momentum encoder's features of the next K frames, and the K rewards, from the first frame and the actions. A
    latent model is unrolled. The loss of a step is the mean squared error of the features plus 0.1 times the cross-entropy of
    the reward, summed over the K steps. Steps after the end of the episode do not count.

    What differs from MR.Q: its encoder learns from this loss alone, ours from the critic's, too; it also predicts the end of
    an episode, which these tasks do not have; its target encoder is copied at intervals, ours is a moving average.

    :param features_dim: Size n of the encoder's features
    :param action_dim: Size of an action
    :param horizon: Number K of steps to predict
    """

    name = "mrq"
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
            nn.Linear(MODEL_DIM, features_dim + N_BINS),
        )

    def loss(self, batch: EncodedBatch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :param batch: Encoded frames, with ``window``, ``window_actions``, ``window_rewards`` and ``window_mask``
        :return: The loss summed over the steps; per step, the error of the dynamics in units of that of predicting no change,
            and the cross-entropy of the reward
        """
        window, actions, rewards, mask = batch.window, batch.window_actions, batch.window_rewards, batch.window_mask
        assert window is not None and actions is not None and rewards is not None and mask is not None
        latent, latents, logits = batch.present, [], []
        for step in range(self.window):
            latent, of_reward = self.model(th.cat([latent, actions[:, step]], dim=1)).split([self.features_dim, N_BINS], dim=1)
            latents.append(latent)
            logits.append(of_reward)
        dynamics = (th.stack(latents, dim=1) - window).square().mean(dim=2)
        reward = F.cross_entropy(th.stack(logits, dim=1).flatten(0, 1), two_hot(rewards).flatten(0, 1), reduction="none")
        reward = reward.unflatten(0, mask.shape)
        loss = (mask * (dynamics + REWARD_WEIGHT * reward)).sum(dim=1).mean()
        with th.no_grad():
            still = (mask * (batch.present.unsqueeze(1) - window).square().mean(dim=2)).sum()
            metrics = {
                "dynamics_error": (mask * dynamics).sum() / still.clamp(min=1e-8),
                "reward_loss": (mask * reward).sum() / mask.sum(),
            }
        return loss, metrics
