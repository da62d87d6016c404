"""One update of the visual algorithms: critic and objective train the encoder, then the actor follows (Algorithm 1)."""

import math
from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import polyak_update, update_learning_rate
from torch.nn import functional as F

from sb3_por.common.errors import UserError
from sb3_por.visual.algorithm import VisualAlgorithm
from sb3_por.visual.balance import EncoderGradients
from sb3_por.visual.batch import Frames, demonstrated, encode, interleave, repeat, take
from sb3_por.visual.replay_buffer import SequenceReplayBuffer
from sb3_por.visual.symmetries import turned


class Losses(NamedTuple):
    """
    The losses of one batch that train the encoder, and what the actor's update uses again.

    :param critic: L_RL, a scalar
    :param objective: L_objective, a scalar, without its weight lambda; 0 without an objective
    :param cloning: The cloning loss, a scalar, with its weight; 0 if it does not train the critic's trunk
    :param metrics: Detached scalars of the objective, to log
    :param present: First augmentation of o_t, preprocessed
    :param trunk_t: The critic's trunk features of it, detached, shape ``(batch, trunk_dim)``
    """

    critic: th.Tensor
    objective: th.Tensor
    cloning: th.Tensor
    metrics: dict[str, th.Tensor]
    present: PyTorchObs
    trunk_t: th.Tensor


class VisualActorCritic(VisualAlgorithm, ABC):
    """
    A mixin for SB3's off-policy actor-critics (SAC, TQC). One update: encode each frame once per encoder; critic loss +
    lambda * objective loss, and the cloning loss where there are demonstrations, one backward pass, one optimizer step over
    encoder, critic and objective (two steps, for objectives with an optimizer of their own); actor and temperature on the
    detached trunk features; moving averages last.

    A subclass defines how its critic measures values: ``_next_values``, ``_critic_loss`` and ``_actor_values``.
    """

    # -- defined by a subclass ------------------------------------------------------------------------------------

    @abstractmethod
    def _next_values(self, features: th.Tensor, actions: th.Tensor, entropy_term: th.Tensor) -> th.Tensor:
        """
        :param features: f_m of the next observations, shape ``(rows, features_dim)``
        :param actions: The actor's actions there
        :param entropy_term: Temperature times the log probability of these actions, shape ``(rows, 1)``
        :return: Values of the next observations, shape ``(rows, 1 or number of quantiles)``
        """

    @abstractmethod
    def _critic_loss(self, features: th.Tensor, actions: th.Tensor, target: th.Tensor) -> th.Tensor:
        """
        :param features: f_o of the observations, shape ``(rows, features_dim)``
        :param actions: Actions from the replay buffer, shape ``(rows, action_dim)``
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

    # -- one update -----------------------------------------------------------------------------------------------

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """
        :param gradient_steps: Number of updates
        :param batch_size: Transitions per update
        """
        if self._defer(gradient_steps):
            return
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        learning_rate = self.lr_schedule(self._current_progress_remaining)
        if self.ent_coef_optimizer is not None:
            update_learning_rate(self.ent_coef_optimizer, self.ent_coef_lr_ratio * learning_rate)
        if self.policy.objective_optimizer is not None:
            update_learning_rate(self.policy.objective_optimizer, self.aux_lr_ratio * learning_rate)

        for _ in range(gradient_steps):
            self._n_updates += 1
            with self._acceleration.update():
                self._update(batch_size)

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if self.device.type == "cpu":
            self._record_metrics()

    def _update(self, batch_size: int) -> None:
        """
        :param batch_size: Transitions of this update
        """
        batch = self.sample(batch_size)
        if self.use_sde:
            # log_std may have changed since the last update
            self.actor.reset_noise()
        if self.start_at_mean_reward and self._n_updates == 1:
            self._start_values(batch)
        losses = self.losses(batch)
        self._metrics.add("ent_coef", self.temperature)
        self._metrics.add("critic_loss", losses.critic)
        if self.policy.objective is not None:
            if self._balance.is_due(self._n_updates):
                self._balance.measure(self.encoder_gradients(losses))
            self._log_objective(losses.metrics)
            if self.policy.objective_optimizer is None:
                self._log_objective({"coef": th.as_tensor(self.objective_weight)})
            if self._n_updates % self.diagnostics_interval == 0:
                self._log_diagnostics(batch, losses)

        self._step_encoder(losses)
        if self._n_updates % self.actor_update_interval == 0:
            self._step_actor(batch, losses)
        # After the encoder's step, so that the targets' batch norm statistics are the current ones
        if self._n_updates % self.target_update_interval == 0:
            self._update_targets()

    def losses(self, batch: Any) -> Losses:
        """
        :param batch: Samples of the replay buffer
        :return: L_RL and L_objective
        """
        objective, batch_size = self.policy.objective, len(batch.actions)
        # Every frame is augmented independently. M augmentations of o_t and K of o_{t+1} are rows of one batch (DrQ)
        frames = self._augmentation.frames(batch, objective, self.n_augmentations, self.n_target_augmentations)

        # s_t = f_o(o_t) with gradient, s_{t+1} = f_m(o_{t+1}) without
        trunk_t = self.critic.trunk(frames.present)
        s_t = self.critic.projection(trunk_t)
        with th.no_grad():
            s_next = self.critic_target.features(frames.next)

        # L_objective
        objective_loss, metrics = s_t.new_zeros(()), {}
        if objective is not None:
            encoded = encode(frames, batch, objective, s_t[:batch_size], s_next[:batch_size], self.policy)
            objective_loss, metrics = objective.loss(encoded)

        # L_RL: the target is the mean over the K augmentations, the loss that over the M
        with th.no_grad():
            next_actions, next_log_prob = self.actor.action_log_prob_of(self._actor_trunk(frames.next))
            next_values = self._next_values(s_next, next_actions, self.temperature * next_log_prob)
            next_values = next_values.unflatten(0, (-1, batch_size)).mean(dim=0)
            target = self.reward_scale * batch.rewards + (1 - batch.dones) * self._discounts(batch) * next_values
        m = self.n_augmentations
        critic_loss = self._critic_loss(s_t, repeat(batch.actions, m), repeat(target, m))
        trunk_t = trunk_t[:batch_size]
        cloning = s_t.new_zeros(())
        if self._clones and self.actor.detach_trunk:
            cloning = self._cloning_weight(target) * self._cloning_loss(batch, trunk_t)
        return Losses(critic_loss, objective_loss, cloning, metrics, take(frames.present, batch_size), trunk_t.detach())

    def _step_encoder(self, losses: Losses) -> None:
        """One step of critic, encoder and objective on the sum of the losses, or one step for each loss."""
        own_optimizer = self.policy.objective_optimizer
        weighted = self.objective_weight * losses.objective
        others = losses.critic + losses.cloning
        self.critic.optimizer.zero_grad()
        if own_optimizer is None:
            (others + weighted).backward()
            self.critic.optimizer.step()
            return
        parameters = [parameter for group in own_optimizer.param_groups for parameter in group["params"]]
        # Before the critic's step changes what this gradient was computed with
        gradients = th.autograd.grad(weighted, parameters, retain_graph=True, allow_unused=True)
        others.backward()
        self.critic.optimizer.step()
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        own_optimizer.step()

    def _step_actor(self, batch: Any, losses: Losses) -> None:
        """One step of actor and temperature. No gradient reaches critic and encoder."""
        # The encoder has changed since its loss, the trunk's features are those of before
        trunk = losses.trunk_t if self.actor.detach_trunk else self.actor.trunk(losses.present)
        actions, log_prob = self.actor.action_log_prob_of(trunk)
        with th.no_grad():
            features = self.critic.projection(losses.trunk_t)
        temperature = self.temperature
        values = self._actor_values(features, actions)
        actor_loss = (temperature * log_prob - values).mean()
        if self._clones:
            cloning_loss = self._cloning_loss(batch, trunk)
            actor_loss = actor_loss + self._cloning_weight(values) * cloning_loss
            self._metrics.add("cloning_loss", cloning_loss)
        self.actor.optimizer.zero_grad()
        # Named inputs: the critic's weights get no gradient, and none is computed for them
        actor_loss.backward(inputs=[p for group in self.actor.optimizer.param_groups for p in group["params"]])
        self.actor.optimizer.step()
        self._metrics.add("actor_loss", actor_loss)
        self._metrics.add("entropy", -log_prob.mean())
        # The last distribution would keep this update's graph, and a policy with a graph cannot be copied
        for name in vars(self.actor.action_dist).keys() & {"distribution", "gaussian_actions"}:
            setattr(self.actor.action_dist, name, None)

        if self.ent_coef_optimizer is not None:
            ent_coef_loss = -(self.log_ent_coef * (log_prob + self.target_entropy).detach()).mean()
            self.ent_coef_optimizer.zero_grad()
            ent_coef_loss.backward()
            self.ent_coef_optimizer.step()
            self._metrics.add("ent_coef_loss", ent_coef_loss)

    @property
    def _clones(self) -> bool:
        return self.demo_buffer is not None and self.bc_coef > 0

    def _cloning_weight(self, values: th.Tensor) -> th.Tensor:
        """In units of the values, so that one coefficient fits all scales of rewards; fades to 0 at the end of training."""
        return self.bc_coef * self._current_progress_remaining * values.detach().std()

    def _cloning_loss(self, batch: Any, trunk: th.Tensor) -> th.Tensor:
        """Mean squared error of the deterministic action in the batch's demonstrations."""
        mean, log_std, kwargs = self.actor.dist_params(demonstrated(trunk))
        actions = self.actor.action_dist.actions_from_params(mean, log_std, deterministic=True, **kwargs)
        return F.mse_loss(actions, demonstrated(batch.actions))

    def _update_targets(self) -> None:
        """theta_m <- tau theta_o + (1 - tau) theta_m for encoder and Q networks, each with its tau."""
        polyak_update(self.critic.encoder_parameters(), self.critic_target.encoder_parameters(), self.momentum_tau)
        polyak_update(self.critic.head_parameters(), self.critic_target.head_parameters(), self.tau)
        if self.policy.objective is not None:
            self.policy.objective.update_momentum(self.momentum_tau)
        # Copy running stats, see SB3 #996
        polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)

    @property
    def momentum_tau(self) -> float:
        """
        :return: tau of the momentum encoder: ``encoder_tau``, or what follows from ``tau`` as it is now
        """
        return min(self.encoder_tau_ratio * self.tau, 1.0) if self.encoder_tau is None else self.encoder_tau

    @property
    def temperature(self) -> th.Tensor:
        """
        :return: Entropy coefficient, a scalar without gradient
        """
        return self.ent_coef_tensor if self.log_ent_coef is None else th.exp(self.log_ent_coef.detach())

    def _discounts(self, batch: Any) -> th.Tensor | float:
        """gamma, or gamma**n for n-step replay (n is smaller at the end of an episode)."""
        return batch.discounts if batch.discounts is not None else self.gamma

    def _actor_trunk(self, frames: PyTorchObs) -> th.Tensor:
        """Trunk features for the actor: those of the critic's trunk, unless the actor has a trunk of its own."""
        return (self.critic if self.actor.detach_trunk else self.actor).trunk(frames)

    def _start_values(self, batch: Any) -> None:
        """Move the last biases of all Q networks by the value of this batch's mean reward."""
        reward = self.reward_scale * batch.rewards.mean()
        continues = ((1 - batch.dones) * self._discounts(batch)).mean()
        with th.no_grad():
            for head in [*self.critic.q_networks, *self.critic_target.q_networks]:
                head[-1].bias += reward / (1 - continues)

    # -- measurements ---------------------------------------------------------------------------------------------

    def sample(self, batch_size: int, replay_buffer: Any = None) -> Any:
        """
        :param batch_size: Number of transitions
        :param replay_buffer: Buffer to sample from; by default the model's own, and the demonstrations for every second row
        :return: Samples with the frames that the objective uses, turned if ``planar_actions`` says so
        """
        if replay_buffer is not None or self.demo_buffer is None:
            batch = self._sample(batch_size, self.replay_buffer if replay_buffer is None else replay_buffer)
        else:
            n_demos = batch_size // 2
            own = self._sample(batch_size - n_demos, self.replay_buffer)
            batch = interleave(own, self._sample(n_demos, self.demo_buffer))
        return batch if self.planar_actions is None else turned(batch, self.planar_actions)

    def _sample(self, batch_size: int, buffer: Any) -> Any:
        """Samples of one buffer."""
        normalizer, objective = self._vec_normalize_env, self.policy.objective
        if objective is None or not isinstance(buffer, SequenceReplayBuffer):
            return buffer.sample(batch_size, env=normalizer)
        # One step later is next_observations already
        future = None if objective.future == (1, 1) and self.n_steps == 1 else objective.future
        return buffer.sample(batch_size, normalizer, future, objective.past, objective.window)

    def objective_metrics(self, batch: Any) -> dict[str, th.Tensor]:
        """
        :param batch: From ``sample()``
        :return: The objective's metrics on freshly augmented frames of the batch
        """
        with th.no_grad():
            return self.losses(batch).metrics

    def control_metrics(self, batch: Any) -> dict[str, th.Tensor]:
        """
        :param batch: From ``sample()``
        :return: The objective's metrics on o_t in the place of all frames, augmented independently: no time passes there
        """
        with th.no_grad():
            augment, o_t = self._augmentation, batch.observations
            # Where the replay buffer can go back, o_t stands for the past, too
            has_past = getattr(batch, "past_observations", None) is not None
            frames = Frames(
                present=augment(o_t),
                next=augment(o_t),
                past=augment(take(o_t, len(batch.actions) // 2)) if has_past else None,
            )
            s_t, s_next = self.critic.features(frames.present), self.critic_target.features(frames.next)
            encoded = encode(frames, batch, self.policy.objective, s_t, s_next, self.policy)
            return self.policy.objective.control(encoded)

    @property
    def objective_weight(self) -> float | th.Tensor:
        """
        :return: Weight lambda of the objective's loss as it is now: ``objective_coef``, or what balances the gradients
        """
        coef = self.objective_coef
        return self._balance.weight if isinstance(coef, str) else coef

    def encoder_gradients(self, losses: Losses) -> EncoderGradients:
        """
        :param losses: Losses of one batch; their graph is kept
        :return: Gradient of each loss with respect to the encoder
        """
        parameters = self.critic.encoder_parameters()

        def gradient(loss: th.Tensor) -> th.Tensor:
            parts = th.autograd.grad(loss, parameters, retain_graph=True, allow_unused=True)
            return th.cat(
                [(th.zeros_like(p) if part is None else part).flatten() for p, part in zip(parameters, parts, strict=True)]
            )

        return EncoderGradients(gradient(losses.critic), gradient(losses.objective))

    def encoder_grad_norms(self, losses: Losses) -> dict[str, th.Tensor]:
        """
        :param losses: Losses of one batch; their graph is kept
        :return: Norm of the gradients of L_RL and of lambda * L_objective with respect to the encoder, by the name of the loss
        """
        return self._norms(self.encoder_gradients(losses))

    def _norms(self, gradients: EncoderGradients) -> dict[str, th.Tensor]:
        return {
            "critic": gradients.critic.norm(),
            self.policy.objective.name: self.objective_weight * gradients.objective.norm(),
        }

    # -- logging --------------------------------------------------------------------------------------------------

    def _log_objective(self, metrics: dict[str, th.Tensor]) -> None:
        for name, value in metrics.items():
            self._metrics.add(f"{self.policy.objective.name}_{name}", value)

    def _log_diagnostics(self, batch: Any, losses: Losses) -> None:
        """Log norms and cosine of the gradients of the losses with respect to the encoder, and the objective's control."""
        gradients = self.encoder_gradients(losses)
        for name, norm in self._norms(gradients).items():
            self._metrics.add(f"encoder_grad_norm_{name}", norm)
        self._metrics.add("encoder_grad_cosine", gradients.cosine())
        self._log_objective(self.control_metrics(batch))

    def _record_metrics(self) -> None:
        """
        Hand the running means to the logger, which averages them until it writes. Nothing else waits for the device.

        :raises UserError: If a loss is not finite
        """
        for name, mean in self._metrics.take().items():
            if name.endswith("loss") and not math.isfinite(mean):
                raise UserError(
                    f"{name} is {mean} at update {self._n_updates}: lower the learning_rate, or load an earlier model"
                )
            self.logger.record_mean(f"train/{name}", mean)

    def dump_logs(self) -> None:
        self._record_metrics()
        super().dump_logs()
