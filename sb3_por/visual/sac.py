"""Soft actor-critic from pixels."""

from typing import ClassVar

import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.policies import BasePolicy
from torch.nn import functional as F

from sb3_por.visual.actor_critic import VisualActorCritic
from sb3_por.visual.policies import CnnPolicy, MlpPolicy, MultiInputPolicy, VisualCritic, VisualSACPolicy


class VisualSAC(VisualActorCritic, SAC):
    """
    Soft actor-critic for images (and everything else that SB3's SAC takes), with the conventions of CURL and DrQ: the
    critic's loss trains the encoder, the actor sees detached convolutional features through a projection of its own,
    images are shifted at random, frames are stored once.

    It takes SB3's arguments in SB3's order, then its own by keyword. Subclasses add an auxiliary objective.

    :param policy: ``"CnnPolicy"``, ``"MultiInputPolicy"`` (Dict observations), ``"MlpPolicy"`` (vectors), or a class
    :param env: The environment to learn from
    :param learning_rate: Learning rate of all optimizers; may be a function of the remaining progress (from 1 to 0)
    :param buffer_size: Size of the replay buffer in transitions
    :param learning_starts: Steps with random actions before learning starts
    :param batch_size: Transitions per update
    :param tau: Soft update coefficient of the target Q networks
    :param gamma: Discount factor
    :param train_freq: Update the model every ``train_freq`` steps, or a tuple such as ``(1, "episode")``
    :param gradient_steps: Updates after each rollout; -1 for as many as steps were done
    :param action_noise: Action noise
    :param replay_buffer_class: ``SequenceReplayBuffer`` by default
    :param replay_buffer_kwargs: Keyword arguments of the replay buffer
    :param optimize_memory_usage: Changes nothing for the default replay buffer, which always does
    :param n_steps: Steps of the returns; with the default replay buffer for Dict observations too
    :param ent_coef: Temperature; ``"auto"`` to learn it, ``"auto_0.1"`` to start from 0.1
    :param target_entropy: Target entropy for learning the temperature
    :param use_sde: Use generalized state dependent exploration (gSDE)
    :param sde_sample_freq: Sample a new gSDE noise matrix every n steps; -1 only at the start of a rollout
    :param use_sde_at_warmup: Use gSDE instead of random actions before learning starts
    :param stats_window_size: Episodes over which the logged statistics are averaged
    :param tensorboard_log: Log folder for TensorBoard
    :param policy_kwargs: Arguments of the policy, see ``sb3_por.visual.policies``
    :param verbose: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed of the random generators
    :param device: PyTorch device
    :param encoder_tau: Soft update coefficient of the momentum encoder; ``encoder_tau_ratio`` times ``tau`` by default:
        once for this class, 5 times (at most 1) where an objective learns from the momentum encoder
    :param actor_update_interval: Update actor and temperature every that many updates
    :param target_update_interval: Update the target networks every that many updates, counted over the whole training
    :param ent_coef_lr_ratio: Learning rate of the temperature, in units of ``learning_rate``. The larger rewards are, the
        farther the temperature has to go; where it comes too late, the policy's entropy falls below its target
    :param reward_scale: Factor on the rewards in the critic's target
    :param start_at_mean_reward: Let values begin at what the mean reward of the first batch would be worth for ever,
        instead of at 0. Where rewards are far from 0 on average, a critic that begins at 0 hurries there for so long that
        its hidden units end up always active or never, and values nearly linear in features and actions
    :param augmentation_pad: Largest random shift of images in pixels; 0 for none
    :param n_augmentations: Augmentations of each observation, whose critic losses are averaged (DrQ's M)
    :param n_target_augmentations: Augmentations of each next observation, whose targets are averaged (DrQ's K)
    :param diagnostics_interval: Log the objective's control and the losses' gradient norms every that many updates
    :param overlap: Train while the environments make the next step; pays with worker processes (``SubprocVecEnv``)
    :param precision: Of the updates: ``"float32"``, ``"tf32"`` or ``"bfloat16"`` (trunks only)
    :param compile_mode: Compile the networks with this mode of ``torch.compile``; None for none
    :param _init_setup_model: Whether to build the networks at the creation of the instance
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: VisualSACPolicy
    critic: VisualCritic
    critic_target: VisualCritic

    def _next_values(self, features: th.Tensor, actions: th.Tensor, entropy_term: th.Tensor) -> th.Tensor:
        q_values = th.cat(self.critic_target.q_values(features, actions), dim=1)
        return q_values.min(dim=1, keepdim=True).values - entropy_term

    def _critic_loss(self, features: th.Tensor, actions: th.Tensor, target: th.Tensor) -> th.Tensor:
        return 0.5 * th.stack([F.mse_loss(q_values, target) for q_values in self.critic.q_values(features, actions)]).sum()

    def _actor_values(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return th.cat(self.critic.q_values(features, actions), dim=1).min(dim=1, keepdim=True).values
