"""The training step that the visual algorithms share: critic and objective train the encoder, then the actor follows."""

import warnings
from abc import ABC, abstractmethod
from contextlib import nullcontext
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn, Schedule
from stable_baselines3.common.utils import polyak_update, update_learning_rate
from stable_baselines3.common.vec_env import VecEnv

from sb3_por.acceleration.allocator import keep_freed_memory
from sb3_por.acceleration.compile import CompiledNetworks
from sb3_por.acceleration.overlap import OverlappedEnv
from sb3_por.acceleration.precision import check_precision
from sb3_por.acceleration.transfer import without_waiting
from sb3_por.common.random_state import SavedRandomness
from sb3_por.common.running_means import Means
from sb3_por.objectives.base import Objective
from sb3_por.visual.preparation import Preparation
from sb3_por.visual.replay_buffer import SequenceReplayBuffer
from sb3_por.visual.views import Views


class VisualActorCritic(SavedRandomness, ABC):
    """
    A mixin for SB3's off-policy actor-critics (SAC, TQC). It takes their arguments, in their order, and the keyword
    arguments below; ``VisualSAC`` documents all of them.

    One update: encode each frame once per encoder; critic loss + coefficient * objective loss, one backward, one
    optimizer step over encoder, critic and objective (two, for objectives with an optimizer of their own); actor and
    temperature on the detached trunk features; moving averages last.

    :param encoder_tau: tau of the momentum encoder; ``encoder_tau_ratio`` times that of the Q networks (``tau``) by default
    :param actor_update_interval: Update actor and temperature every that many updates
    :param target_update_interval: Update the target networks every that many updates (SB3 counts within one call of
        ``train()``, SB3 #2158)
    :param ent_coef_lr_ratio: Learning rate of the temperature, in units of ``learning_rate``
    :param reward_scale: Factor on the rewards in the critic's target
    :param start_at_mean_reward: Let values begin at what the mean reward would be worth for ever, instead of at 0
    :param augmentation_pad: Random shift of images, in pixels; 0 for none
    :param n_augmentations: DrQ's M: augmentations of o_t whose critic losses are averaged
    :param n_target_augmentations: DrQ's K: augmentations of o_{t+1} whose targets are averaged
    :param diagnostics_interval: Log the objective's control and the losses' gradient norms every that many updates
    :param overlap: Train while the environments make the next step, which pays with worker processes
        (``SubprocVecEnv``). Updates that are due after a rollout are made in the first step of the next one, always
        between sending the actions and waiting for the results, so that runs stay reproducible
    :param precision: Of the updates: ``"float32"``, ``"tf32"`` (matrix products and convolutions of a GPU that has it;
        a setting of the whole process), or ``"bfloat16"`` (trunks only: Q values and probabilities need more)
    :param compile_mode: Compile the networks with this mode of ``torch.compile``, for example ``"default"`` or
        ``"reduce-overhead"`` (CUDA graphs); None for none
    """

    #: How much faster the momentum encoder follows than the Q networks, unless it is told.
    encoder_tau_ratio: ClassVar[float] = 1.0
    #: Learning rate of an objective that has an optimizer of its own, in units of ``learning_rate``.
    aux_lr_ratio: float = 1.0

    # What SAC and TQC have in common
    policy: Any
    actor: Any
    critic: Any
    critic_target: Any
    replay_buffer: Any
    ent_coef_optimizer: Any
    log_ent_coef: Any
    ent_coef_tensor: th.Tensor
    tau: float
    target_entropy: Any
    target_update_interval: int
    batch_norm_stats: list[th.Tensor]
    batch_norm_stats_target: list[th.Tensor]

    def __init__(
        self,
        policy: Any,
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 100_000,
        learning_starts: int = 100,
        batch_size: int = 128,
        *args: Any,
        encoder_tau: float | None = None,
        actor_update_interval: int = 1,
        target_update_interval: int = 1,
        ent_coef_lr_ratio: float = 1.0,
        reward_scale: float = 1.0,
        start_at_mean_reward: bool = False,
        augmentation_pad: int = 4,
        n_augmentations: int = 1,
        n_target_augmentations: int = 1,
        diagnostics_interval: int = 200,
        overlap: bool = False,
        precision: str = "float32",
        compile_mode: str | None = None,
        **kwargs: Any,
    ):
        check_precision(precision)
        self.precision = precision
        self.compile_mode = compile_mode
        self.encoder_tau = encoder_tau
        self.actor_update_interval = actor_update_interval
        self.ent_coef_lr_ratio = ent_coef_lr_ratio
        self.reward_scale = reward_scale
        self.start_at_mean_reward = start_at_mean_reward
        self.augmentation_pad = augmentation_pad
        self.n_augmentations = n_augmentations
        self.n_target_augmentations = n_target_augmentations
        self.diagnostics_interval = diagnostics_interval
        self.overlap = overlap
        self._defer, self._updates_due = False, 0
        self._metrics = Means()
        kwargs["target_update_interval"] = target_update_interval
        super().__init__(policy, env, learning_rate, buffer_size, learning_starts, batch_size, *args, **kwargs)
        if start_at_mean_reward and self.gamma >= 1.0:
            raise ValueError("start_at_mean_reward needs gamma < 1: a reward that goes on for ever has no finite value")

    def _objective(self) -> tuple[type[Objective] | None, dict[str, Any]]:
        """
        :return: Class and keyword arguments of the auxiliary objective; None for none
        """
        return None, {}

    @property
    def objective_coef(self) -> float:
        """
        :return: Weight lambda of the objective's loss
        """
        return 1.0

    def _setup_model(self) -> None:
        objective_class, objective_kwargs = self._objective()
        if objective_class is not None:
            self.policy_kwargs = dict(self.policy_kwargs, objective_class=objective_class, objective_kwargs=objective_kwargs)
        if self.replay_buffer_class is None:
            self.replay_buffer_class = SequenceReplayBuffer
        if issubclass(self.replay_buffer_class, SequenceReplayBuffer):
            self.replay_buffer_kwargs = dict(self.replay_buffer_kwargs, n_steps=self.n_steps, gamma=self.gamma)
        with warnings.catch_warnings():
            if issubclass(self.replay_buffer_class, SequenceReplayBuffer):
                # SB3 knows its own buffers only
                warnings.filterwarnings("ignore", message="`n_steps=")
            super()._setup_model()
        if isinstance(self.replay_buffer, SequenceReplayBuffer):
            # Set, it would make SB3 end the episode that a second learn() cuts off
            self.optimize_memory_usage = False
        self._check_buffer()
        if self.device.type == "cpu":
            keep_freed_memory()
        if self.precision == "tf32":
            th.set_float32_matmul_precision("high")
            th.backends.cudnn.allow_tf32 = True
        self._compiled = None if self.compile_mode is None else CompiledNetworks(self.policy, self.compile_mode)
        self._metrics = Means()
        self._preparation = Preparation(
            self.policy,
            self.augmentation_pad,
            self.n_augmentations,
            self.n_target_augmentations,
            bfloat16=self.precision == "bfloat16",
        )

    def _check_buffer(self) -> None:
        """The objective needs frames that only some buffers can sample."""
        objective = self.policy.objective
        buffer = self.replay_buffer
        if objective is None or isinstance(buffer, SequenceReplayBuffer):
            return
        next_is_future = not (isinstance(buffer, NStepReplayBuffer) and buffer.n_steps > 1)
        has_future = objective.future is None or (objective.future == (1, 1) and next_is_future)
        if objective.window > 0 or not has_future:
            raise ValueError(
                f"{type(buffer).__name__} cannot sample the later frames that {type(self).__name__} needs with these "
                "settings: use the default replay_buffer_class, SequenceReplayBuffer."
            )

    @abstractmethod
    def _next_values(self, features: th.Tensor, actions: th.Tensor, entropy_term: th.Tensor) -> th.Tensor:
        """
        :param features: f_m of the next observations, shape ``(batch, features_dim)``
        :param actions: The actor's actions there
        :param entropy_term: Temperature times the log probability of these actions, shape ``(batch, 1)``
        :return: Values of the next observations, shape ``(batch, 1 or number of quantiles)``
        """

    @abstractmethod
    def _critic_loss(self, features: th.Tensor, actions: th.Tensor, target: th.Tensor) -> th.Tensor:
        """
        :param features: f_o of the observations, shape ``(batch, features_dim)``
        :param actions: Actions from the replay buffer
        :param target: Target of the critic, shaped as ``_next_values`` returns it
        :return: The critic's loss, a scalar
        """

    @abstractmethod
    def _actor_values(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param features: f_o of the observations, detached
        :param actions: The actor's actions there, with gradient
        :return: Values that the actor maximizes, shape ``(batch, 1)``
        """

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """
        :param gradient_steps: Number of updates
        :param batch_size: Transitions per update
        """
        if self._defer:
            self._defer, self._updates_due = False, self._updates_due + gradient_steps
            return
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        learning_rate = self.lr_schedule(self._current_progress_remaining)
        if self.ent_coef_optimizer is not None:
            update_learning_rate(self.ent_coef_optimizer, self.ent_coef_lr_ratio * learning_rate)
        if self.policy.objective_optimizer is not None:
            update_learning_rate(self.policy.objective_optimizer, self.aux_lr_ratio * learning_rate)

        compiled = nullcontext() if self._compiled is None else self._compiled.in_place()
        with without_waiting(self.device), compiled:
            for _ in range(gradient_steps):
                self._n_updates += 1
                self._update(batch_size)

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if self.device.type == "cpu":
            self._record_metrics()

    def _update(self, batch_size: int) -> None:
        """
        :param batch_size: Transitions of this update
        """
        if self.compile_mode is not None:
            # CUDA graphs keep what they return until the next update: trunk features are used again
            th.compiler.cudagraph_mark_step_begin()
        replay_data = self._sample(batch_size)
        if self.use_sde:
            # log_std may have changed since the last update
            self.actor.reset_noise()
        if self.start_at_mean_reward and self._n_updates == 1:
            self._start_values(replay_data)
        views = self._preparation.views(replay_data)
        ent_coef = self.ent_coef_tensor if self.log_ent_coef is None else th.exp(self.log_ent_coef.detach())
        critic_loss, objective_loss = self._encoder_losses(replay_data, views, ent_coef)
        self._diagnose(replay_data, critic_loss, objective_loss)
        self._update_encoder(critic_loss, objective_loss)

        if self._n_updates % self.actor_update_interval == 0:
            self._update_actor(views, ent_coef)
        # After the encoder's step, so that the targets' batch norm statistics are the current ones
        if self._n_updates % self.target_update_interval == 0:
            self._update_targets()

        self._metrics.add("ent_coef", ent_coef)
        self._metrics.add("critic_loss", critic_loss)

    def _update_encoder(self, critic_loss: th.Tensor, objective_loss: th.Tensor) -> None:
        """One step of critic, encoder and objective, or one for each loss."""
        own_optimizer = self.policy.objective_optimizer
        self.critic.optimizer.zero_grad()
        if own_optimizer is None:
            (critic_loss + objective_loss).backward()
            self.critic.optimizer.step()
            return
        parameters = [parameter for group in own_optimizer.param_groups for parameter in group["params"]]
        # Before the critic's step changes what this gradient was computed with
        gradients = th.autograd.grad(objective_loss, parameters, retain_graph=True, allow_unused=True)
        critic_loss.backward()
        self.critic.optimizer.step()
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        own_optimizer.step()

    def _encoder_losses(self, replay_data: Any, views: Views, ent_coef: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """L_RL and lambda * L_objective: the two losses that train the encoder."""
        for name in self._preparation.next_names:
            # All rows at once, before the objective asks for some of them
            views.momentum(name)
        objective_loss = self._objective_loss(views)
        discounts = self._discounts(replay_data)
        with th.no_grad():
            next_values = [self._value_of(views, name, ent_coef) for name in self._preparation.next_names]
            target = self.reward_scale * replay_data.rewards
            target = target + (1 - replay_data.dones) * discounts * sum(next_values) / len(next_values)
        critic_losses = [
            self._critic_loss(views.online(name), replay_data.actions, target) for name in self._preparation.obs_names
        ]
        return th.stack(critic_losses).mean(), objective_loss

    def _discounts(self, replay_data: Any) -> th.Tensor | float:
        """gamma, or for n-step replay gamma**n_steps (when no early termination)."""
        return replay_data.discounts if replay_data.discounts is not None else self.gamma

    def _start_values(self, replay_data: Any) -> None:
        """Move the last biases of all Q networks by the value of this batch's mean reward."""
        reward = self.reward_scale * replay_data.rewards.mean()
        goes_on = ((1 - replay_data.dones) * self._discounts(replay_data)).mean()
        with th.no_grad():
            for head in [*self.critic.q_networks, *self.critic_target.q_networks]:
                head[-1].bias += reward / (1 - goes_on)

    def _sample(self, batch_size: int) -> Any:
        """A batch from the replay buffer with what the objective asks for."""
        normalizer = self._vec_normalize_env
        if not isinstance(self.replay_buffer, SequenceReplayBuffer):
            return self.replay_buffer.sample(batch_size, env=normalizer)
        objective = self.policy.objective
        if objective is None:
            return self.replay_buffer.sample(batch_size, env=normalizer)
        # One step later is next_observations already
        future = None if objective.future == (1, 1) and self.n_steps == 1 else objective.future
        return self.replay_buffer.sample(batch_size, normalizer, future, objective.past, objective.window)

    def _objective_loss(self, views: Views) -> th.Tensor:
        """The objective's weighted loss."""
        objective = self.policy.objective
        if objective is None:
            return th.zeros((), device=self.device)
        loss, metrics = objective.loss(views)
        self._log_objective(metrics)
        return self.objective_coef * loss

    def _log_objective(self, metrics: dict[str, th.Tensor]) -> None:
        for name, value in metrics.items():
            self._metrics.add(f"{self.policy.objective.name}_{name}", value)

    def _actor_input(self, views: Views, name: str) -> th.Tensor:
        """Trunk features for the actor: the critic's, detached, unless the actor has a trunk of its own."""
        return views.trunk(name) if self.actor.detach_trunk else views.trunk_of(self.actor, views.frames[name])

    def _value_of(self, views: Views, name: str, ent_coef: th.Tensor) -> th.Tensor:
        """Value of one augmentation of the next observations under the target critic."""
        actions, log_prob = self.actor.action_log_prob_of(self._actor_input(views, name))
        return self._next_values(views.momentum(name), actions, ent_coef * log_prob)

    def _update_actor(self, views: Views, ent_coef: th.Tensor) -> None:
        """One step of actor and temperature. No gradient reaches critic and encoder."""
        actions, log_prob = self.actor.action_log_prob_of(self._actor_input(views, "obs"))
        with th.no_grad():
            features = self.critic.projection(views.trunk("obs"))
        actor_loss = (ent_coef * log_prob - self._actor_values(features, actions)).mean()
        self.actor.optimizer.zero_grad()
        # Named inputs: the critic's weights get no gradient, and none is computed for them
        actor_loss.backward(inputs=[p for group in self.actor.optimizer.param_groups for p in group["params"]])
        self.actor.optimizer.step()
        self._metrics.add("actor_loss", actor_loss)
        self._metrics.add("entropy", -log_prob.mean())

        if self.ent_coef_optimizer is not None:
            ent_coef_loss = -(self.log_ent_coef * (log_prob + self.target_entropy).detach()).mean()
            self.ent_coef_optimizer.zero_grad()
            ent_coef_loss.backward()
            self.ent_coef_optimizer.step()
            self._metrics.add("ent_coef_loss", ent_coef_loss)

    @property
    def momentum_tau(self) -> float:
        """
        :return: tau of the momentum encoder: ``encoder_tau``, or what follows from ``tau`` as it is now
        """
        return min(self.encoder_tau_ratio * self.tau, 1.0) if self.encoder_tau is None else self.encoder_tau

    def _update_targets(self) -> None:
        """theta_m <- tau theta_o + (1 - tau) theta_m for encoder and Q networks, each with its tau."""
        polyak_update(self.critic.encoder_parameters(), self.critic_target.encoder_parameters(), self.momentum_tau)
        polyak_update(self.critic.head_parameters(), self.critic_target.head_parameters(), self.tau)
        if self.policy.objective is not None:
            self.policy.objective.update_momentum(self.momentum_tau)
        # Copy running stats, see SB3 #996
        polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)

    def _diagnose(self, replay_data: Any, critic_loss: th.Tensor, objective_loss: th.Tensor) -> None:
        """Now and then: the objective's control, and how hard each loss pulls at the encoder."""
        objective = self.policy.objective
        if objective is None or self._n_updates % self.diagnostics_interval != 0:
            return
        for name, norm in self._encoder_grad_norms(critic_loss, objective_loss).items():
            self._metrics.add(f"encoder_grad_norm_{name}", norm)
        with th.no_grad():
            self._log_objective(objective.control(self._preparation.control_views(replay_data)))

    def _encoder_grad_norms(self, critic_loss: th.Tensor, objective_loss: th.Tensor) -> dict[str, th.Tensor]:
        """How hard each loss pulls at the encoder; keeps the graph."""
        parameters = self.critic.encoder_parameters()
        norms = {}
        for name, loss in (("critic", critic_loss), (self.policy.objective.name, objective_loss)):
            gradients = th.autograd.grad(loss, parameters, retain_graph=True, allow_unused=True)
            parts = [gradient.norm() for gradient in gradients if gradient is not None]
            norms[name] = th.stack(parts).norm() if parts else loss.new_zeros(())
        return norms

    def _record_metrics(self) -> None:
        """Hand the means since the last time to the logger, which averages them until it writes: the one place that waits."""
        for name, mean in self._metrics.take().items():
            self.logger.record_mean(f"train/{name}", mean)

    def dump_logs(self) -> None:
        self._record_metrics()
        super().dump_logs()

    def collect_rollouts(self, env: VecEnv, *args: Any, **kwargs: Any) -> RolloutReturn:
        """See SB3. With ``overlap`` the updates that the last rollout left are made in the first step of this one."""
        if not self.overlap:
            return super().collect_rollouts(env, *args, **kwargs)
        rollout = super().collect_rollouts(OverlappedEnv(env, self._train_due), *args, **kwargs)
        # The updates that SB3 asks for next
        self._defer = True
        return rollout

    def _train_due(self) -> None:
        """Make the updates that are due; the policy goes on acting in evaluation mode."""
        self._defer = False
        if self._updates_due > 0:
            updates, self._updates_due = self._updates_due, 0
            self.train(updates, self.batch_size)
            self.policy.set_training_mode(False)

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Any:
        """
        :param total_timesteps: Number of environment steps
        :param callback: Called at every step
        :param log_interval: Log every that many episodes
        :param tb_log_name: Name of the run in TensorBoard; the name of the class by default
        :param reset_num_timesteps: Start counting from zero; False goes on, for a loaded model as if it had never stopped
        :param progress_bar: Show a progress bar
        :return: The model
        """
        name = type(self).__name__ if tb_log_name is None else tb_log_name
        super().learn(total_timesteps, callback, log_interval, name, reset_num_timesteps, progress_bar)
        self._train_due()
        return self

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        own = [] if self.policy.objective_optimizer is None else ["policy.objective_optimizer"]
        return [*state_dicts, *own], tensors

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_metrics", "_preparation", "_compiled"]
