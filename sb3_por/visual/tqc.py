"""Truncated quantile critics from pixels."""

from typing import Any, ClassVar

import torch as th
from sb3_contrib import TQC
from sb3_contrib.common.utils import quantile_huber_loss
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_por.visual.actor_critic import VisualActorCritic
from sb3_por.visual.policies import TQCCnnPolicy, TQCMlpPolicy, TQCMultiInputPolicy, VisualQuantileCritic, VisualTQCPolicy


class VisualTQC(VisualActorCritic, TQC):
    """
    Truncated quantile critics (TQC) for images: sb3-contrib's TQC with the update, the encoder, the augmentation and the
        replay
    buffer of ``VisualSAC``.

    Arguments are TQC's in TQC's order, then the keywords of ``VisualSAC``.

    :param policy: ``"CnnPolicy"``, ``"MultiInputPolicy"`` (Dict observations), ``"MlpPolicy"`` (vectors), or a class
    :param env: The environment to learn from, or the id of one
    :param learning_rate: Learning rate of all optimizers; may be a function of the remaining progress (from 1 to 0)
    :param buffer_size: Size of the replay buffer in transitions
    :param learning_starts: Steps with random actions before learning starts
    :param batch_size: Transitions per update
    :param tau: Soft update coefficient of the target Q networks
    :param gamma: Discount factor
    :param train_freq: Update the model every ``train_freq`` steps, or a tuple such as ``(1, "episode")``
    :param gradient_steps: Updates after each rollout; -1 for as many as there were steps
    :param action_noise: Action noise
    :param replay_buffer_class: ``SequenceReplayBuffer`` by default
    :param replay_buffer_kwargs: Keyword arguments of the replay buffer
    :param optimize_memory_usage: No effect with the default replay buffer, which always stores each frame once
    :param n_steps: Steps of the returns; works for Dict observations too, with the default replay buffer
    :param ent_coef: Temperature; ``"auto"`` to learn it, ``"auto_0.1"`` to start from 0.1
    :param target_update_interval: Update the target networks every ``target_update_interval`` updates, counted over the whole
        training (SB3 counts within one call of ``train()``, SB3 #2158)
    :param target_entropy: Target entropy for learning the temperature
    :param top_quantiles_to_drop_per_net: Quantiles of each critic that the target leaves out, the largest ones
    :param use_sde: Use generalized state-dependent exploration (gSDE)
    :param sde_sample_freq: Sample a new gSDE noise matrix every ``sde_sample_freq`` steps; -1 for only at the start of a
        rollout
    :param use_sde_at_warmup: Use gSDE instead of random actions before learning starts
    :param stats_window_size: Episodes over which the logged statistics are averaged
    :param tensorboard_log: Log folder for TensorBoard
    :param policy_kwargs: Arguments of the policy, see ``sb3_por.visual.policies``
    :param verbose: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed of the random generators
    :param device: PyTorch device
    :param _init_setup_model: Whether to build the networks at the creation of the instance
    :param encoder_tau: Soft update coefficient of the momentum encoder; ``encoder_tau_ratio`` times ``tau`` by default: the
        same as ``tau``, or 5 times as much (at most 1) where an objective learns from the momentum encoder
    :param actor_update_interval: Update the actor and the temperature every ``actor_update_interval`` updates
    :param ent_coef_lr_ratio: Learning rate of the temperature, in units of ``learning_rate``. Large rewards need a large
        temperature; if it lags behind, the policy's entropy falls below its target
    :param reward_scale: Factor on the rewards in the critic's target
    :param start_at_mean_reward: Start values at the discounted sum of the first batch's mean reward instead of at 0. Starting
        at 0, far from the true values, saturates or kills the critic's hidden units
    :param augmentation_pad: Largest random shift of images in pixels; 0 for none
    :param n_augmentations: Augmentations of each observation, whose critic losses are averaged (DrQ's M)
    :param n_target_augmentations: Augmentations of each next observation, whose targets are averaged (DrQ's K)
    :param planar_actions: Pairs of elements of an action of which one points right in the image and one points up, as in
        ``[[0, 1], [4, 5]]``, for tasks that are the same in a turned and in a mirrored picture: batches are turned and
        mirrored at random, and these elements with them (Lin et al. 2020, arXiv 1909.10707). None turns nothing
    :param diagnostics_interval: Log the objective's control and the gradient norm of each loss with respect to the encoder
        every ``diagnostics_interval`` updates
    :param demos: Folder of demonstrations in Minari's format, from which half of each batch is drawn; ``learn()`` reads it
    :param bc_coef: Weight of the behaviour-cloning loss on the demonstrations at the start of training, in units of the
        standard deviation of the values in a batch. It falls linearly with the remaining progress, to 0 at the end
    :param overlap: Train while the environments step; pays with worker processes (``SubprocVecEnv``)
    :param precision: Precision of the updates: ``"float32"``, ``"tf32"`` (matrix products and convolutions of a GPU; a
        setting of the whole process) or ``"bfloat16"`` (trunks only: Q values and probabilities need more)
    :param compile_mode: Compile the networks with this mode of ``torch.compile``, such as ``"default"`` or
        ``"reduce-overhead"`` (CUDA graphs); None to compile nothing
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": TQCMlpPolicy,
        "CnnPolicy": TQCCnnPolicy,
        "MultiInputPolicy": TQCMultiInputPolicy,
    }
    policy: VisualTQCPolicy
    critic: VisualQuantileCritic
    critic_target: VisualQuantileCritic

    def __init__(
        self,
        policy: str | type[VisualTQCPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 100_000,
        learning_starts: int = 100,
        batch_size: int = 128,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        top_quantiles_to_drop_per_net: int = 2,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        use_sde_at_warmup: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        *,
        encoder_tau: float | None = None,
        actor_update_interval: int = 1,
        ent_coef_lr_ratio: float = 1.0,
        reward_scale: float = 1.0,
        start_at_mean_reward: bool = False,
        augmentation_pad: int = 4,
        n_augmentations: int = 1,
        n_target_augmentations: int = 1,
        planar_actions: list[Any] | None = None,
        diagnostics_interval: int = 200,
        demos: str | None = None,
        bc_coef: float = 0.0,
        overlap: bool = False,
        precision: str = "float32",
        compile_mode: str | None = None,
    ):
        self.encoder_tau = encoder_tau
        self.actor_update_interval = actor_update_interval
        self.ent_coef_lr_ratio = ent_coef_lr_ratio
        self.reward_scale = reward_scale
        self.start_at_mean_reward = start_at_mean_reward
        self.augmentation_pad = augmentation_pad
        self.n_augmentations = n_augmentations
        self.n_target_augmentations = n_target_augmentations
        self.planar_actions = planar_actions
        self.diagnostics_interval = diagnostics_interval
        self.demos = demos
        self.bc_coef = bc_coef
        self.overlap = overlap
        self.precision = precision
        self.compile_mode = compile_mode
        super().__init__(
            policy=policy,
            env=env,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            target_entropy=target_entropy,
            top_quantiles_to_drop_per_net=top_quantiles_to_drop_per_net,
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            use_sde_at_warmup=use_sde_at_warmup,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )

    def _setup_model(self) -> None:
        super()._setup_model()
        n_quantiles = self.critic.n_quantiles
        if not 0 <= self.top_quantiles_to_drop_per_net < n_quantiles:
            raise ValueError(
                f"top_quantiles_to_drop_per_net must be at least 0 and below the {n_quantiles} quantiles of a network, "
                f"got {self.top_quantiles_to_drop_per_net}"
            )

    def _next_values(self, features: th.Tensor, actions: th.Tensor, entropy_term: th.Tensor) -> th.Tensor:
        quantiles = self.critic_target.quantiles(features, actions).flatten(start_dim=1)
        n_kept = self.critic.quantiles_total - self.top_quantiles_to_drop_per_net * self.critic.n_critics
        return quantiles.sort(dim=1).values[:, :n_kept] - entropy_term

    def _critic_loss(self, features: th.Tensor, actions: th.Tensor, target: th.Tensor) -> th.Tensor:
        quantiles = self.critic.quantiles(features, actions)
        return quantile_huber_loss(quantiles, target.unsqueeze(1), sum_over_quantiles=False)

    def _actor_values(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return self.critic.quantiles(features, actions).mean(dim=2).mean(dim=1, keepdim=True)
