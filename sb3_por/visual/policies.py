"""Policies whose critic owns the encoder; the actor sees the detached trunk through a projection of its own."""

import math
from typing import Any

import torch as th
from gymnasium import spaces
from sb3_contrib.tqc.policies import Critic as QuantileCritic
from sb3_contrib.tqc.policies import TQCPolicy
from stable_baselines3.common.policies import BaseModel, BasePolicy, ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim, is_image_space, preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn

from sb3_por.common.errors import UserError
from sb3_por.objectives.base import Objective
from sb3_por.visual.encoders import CombinedEncoder, ConvEncoder, Encoder, VectorEncoder, make_projection

#: Range of the actor's log standard deviation in CURL and DrQ
LOG_STD_MIN, LOG_STD_MAX = -10.0, 2.0


class VisualActor(Actor):
    """
    SAC's actor on trunk features, with a projection of its own and a tanh on the log standard deviation, as in CURL and DrQ.
    Takes the arguments of SB3's SAC actor.

    :param detach_trunk: Stop the gradient after the trunk, which belongs to the critic
    :param layer_norm: Use layer norm in the hidden layers
    """

    def __init__(self, *args: Any, detach_trunk: bool = True, layer_norm: bool = False, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.detach_trunk = detach_trunk
        self.layer_norm = layer_norm
        if layer_norm:
            self.latent_pi = with_layer_norm(self.latent_pi)
        self.projection = make_projection(self.features_extractor)
        if not self.use_sde:
            # Start with a standard deviation of about 1, as SB3 does, instead of e^-4, the middle of the range
            middle, half_range = 0.5 * (LOG_STD_MAX + LOG_STD_MIN), 0.5 * (LOG_STD_MAX - LOG_STD_MIN)
            assert isinstance(self.log_std, nn.Linear)
            nn.init.constant_(self.log_std.bias, math.atanh(-middle / half_range))

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = dict(detach_trunk=self.detach_trunk, layer_norm=self.layer_norm)
        return super()._get_constructor_parameters() | own

    def trunk(self, observations: PyTorchObs) -> th.Tensor:
        """
        :param observations: Preprocessed observations
        :return: Trunk features, shape ``(batch, trunk_dim)``
        """
        with th.set_grad_enabled(th.is_grad_enabled() and not self.detach_trunk):
            return self.features_extractor(observations)

    def get_action_dist_params(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        preprocessed = preprocess_obs(obs, self.observation_space, normalize_images=self.normalize_images)
        return self.dist_params(self.trunk(preprocessed))

    def dist_params(self, trunk_features: th.Tensor) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        """
        :param trunk_features: Shape ``(batch, trunk_dim)``
        :return: Mean, log standard deviation and optional keyword arguments of the action distribution
        """
        latent_pi = self.latent_pi(self.projection(trunk_features))
        mean_actions = self.mu(latent_pi)
        if self.use_sde:
            return mean_actions, self.log_std, dict(latent_sde=latent_pi)
        assert isinstance(self.log_std, nn.Module)
        log_std = th.tanh(self.log_std(latent_pi))
        return mean_actions, LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (log_std + 1), {}

    def action_log_prob_of(self, trunk_features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param trunk_features: Shape ``(batch, trunk_dim)``
        :return: Actions drawn for them and their log probabilities, shapes ``(batch, action_dim)`` and ``(batch, 1)``
        """
        mean_actions, log_std, kwargs = self.dist_params(trunk_features)
        actions, log_prob = self.action_dist.log_prob_from_params(mean_actions, log_std, **kwargs)
        return actions, log_prob.reshape(-1, 1)

    def own_parameters(self) -> list[nn.Parameter]:
        """
        :return: The parameters that the actor's loss trains
        """
        return [
            parameter
            for name, parameter in self.named_parameters()
            if not (self.detach_trunk and name.startswith("features_extractor"))
        ]


def with_layer_norm(network: nn.Sequential) -> nn.Sequential:
    """
    :param network: Linear layers with activations between them
    :return: The same with a layer norm between each hidden linear layer and its activation
    """
    layers: list[nn.Module] = []
    for layer in network:
        layers.append(layer)
        if isinstance(layer, nn.Linear) and layer is not network[-1]:
            layers.append(nn.LayerNorm(layer.out_features))
    return nn.Sequential(*layers)


class EncoderOwner(BaseModel):
    """
    A critic that owns an encoder: trunk (``features_extractor``) and ``projection`` together are f_o, and in the target
    critic f_m. A mixin for SB3's critics.

    :param layer_norm: Use layer norm in the Q networks
    """

    features_extractor: BaseFeaturesExtractor
    q_networks: list[Any]

    def __init__(self, *args: Any, layer_norm: bool = False, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.projection = make_projection(self.features_extractor)
        if layer_norm:
            self.q_networks = [with_layer_norm(network) for network in self.q_networks]
            for index, network in enumerate(self.q_networks):
                setattr(self, f"qf{index}", network)

    def trunk(self, frames: PyTorchObs) -> th.Tensor:
        """
        :param frames: Preprocessed observations
        :return: Trunk features, shape ``(batch, trunk_dim)``
        """
        return self.features_extractor(frames)

    def features(self, frames: PyTorchObs) -> th.Tensor:
        """
        :param frames: Preprocessed observations
        :return: The encoder's features, shape ``(batch, features_dim)``
        """
        return self.projection(self.trunk(frames))

    def encode(self, obs: PyTorchObs) -> th.Tensor:
        """
        :param obs: Observations as the environment returns them
        :return: The encoder's features, shape ``(batch, features_dim)``
        """
        return self.features(preprocess_obs(obs, self.observation_space, normalize_images=self.normalize_images))

    def encoder_parameters(self) -> list[nn.Parameter]:
        """
        :return: Parameters of trunk and projection
        """
        return [*self.features_extractor.parameters(), *self.projection.parameters()]

    def head_parameters(self) -> list[nn.Parameter]:
        """
        :return: Parameters of the Q networks
        """
        return [parameter for head in self.q_networks for parameter in head.parameters()]


class VisualCritic(EncoderOwner, ContinuousCritic):
    """SAC's critic, with an encoder."""

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        return self.q_values(self.encode(obs), actions)

    def q1_forward(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        with th.no_grad():
            features = self.encode(obs)
        return self.q_networks[0](th.cat([features, actions], dim=1))

    def q_values(self, features: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """
        :param features: Encoded observations, shape ``(batch, features_dim)``
        :param actions: Shape ``(batch, action_dim)``
        :return: The estimate of each Q network, shape ``(batch, 1)`` each
        """
        q_input = th.cat([features, actions], dim=1)
        return tuple(q_network(q_input) for q_network in self.q_networks)


class VisualQuantileCritic(EncoderOwner, QuantileCritic):
    """TQC's critic, with an encoder."""

    def forward(self, obs: PyTorchObs, action: th.Tensor) -> th.Tensor:
        return self.quantiles(self.encode(obs), action)

    def quantiles(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param features: Encoded observations, shape ``(batch, features_dim)``
        :param actions: Shape ``(batch, action_dim)``
        :return: Quantiles, shape ``(batch, n_critics, n_quantiles)``
        """
        q_input = th.cat([features, actions], dim=1)
        return th.stack([q_network(q_input) for q_network in self.q_networks], dim=1)


class VisualPolicy(BasePolicy):
    """
    A mixin for the policies of SAC and TQC. Takes their arguments, with the encoder as default features extractor, and

    :param share_features_extractor: The actor uses the critic's trunk, detached (default). Otherwise it has a trunk of
        its own, trained by its loss
    :param critic_layer_norm: Use layer norm in the Q networks: their hidden units stay alive, and values of unseen actions
        stay bounded (https://arxiv.org/abs/2302.02948)
    :param actor_layer_norm: Use layer norm in the actor's hidden layers
    :param objective_class: Auxiliary objective, trained together with the critic; None for none
    :param objective_kwargs: Keyword arguments of the objective
    """

    critic_class: type[Any]
    default_encoder: type[Encoder]
    # Attributes of both SAC's and TQC's policies
    actor: Any
    critic: Any
    critic_target: Any
    actor_kwargs: dict[str, Any]
    critic_kwargs: dict[str, Any]
    share_features_extractor: bool
    #: Whether the algorithm that owns the policy trains its objective: set by ``VisualAlgorithm``
    is_trained_here = False

    def __init__(
        self,
        *args: Any,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        share_features_extractor: bool = True,
        critic_layer_norm: bool = False,
        actor_layer_norm: bool = False,
        objective_class: type[Objective] | None = None,
        objective_kwargs: dict[str, Any] | None = None,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ):
        optimizer_kwargs = dict(optimizer_kwargs or {})
        if optimizer_class is th.optim.Adam and "foreach" not in optimizer_kwargs:
            # One pass over the parameters: on CPU a fifth of the time
            optimizer_kwargs.setdefault("fused", True)
        features_extractor_class = features_extractor_class or self.default_encoder
        features_extractor_kwargs = dict(features_extractor_kwargs or {})
        if not normalize_images and issubclass(features_extractor_class, (ConvEncoder, CombinedEncoder)):
            # As SB3 does for its own extractors: no check of type and bounds
            features_extractor_kwargs["normalized_image"] = True
        self.critic_layer_norm = critic_layer_norm
        self.actor_layer_norm = actor_layer_norm
        self.objective_class = objective_class
        self.objective_kwargs = objective_kwargs or {}
        super().__init__(
            *args,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=features_extractor_kwargs,
            normalize_images=normalize_images,
            share_features_extractor=share_features_extractor,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            **kwargs,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        self.critic = self.make_critic()
        self.critic_target = self.make_critic()
        self.critic_target.load_state_dict(self.critic.state_dict())
        self.critic_target.requires_grad_(False)
        self.critic_target.set_training_mode(False)
        self.actor = self.make_actor(self.critic.features_extractor if self.share_features_extractor else None)

        self.objective = None
        if self.objective_class is not None:
            action_dim = get_action_dim(self.action_space)
            self.objective = self.objective_class(
                self.critic.features_extractor.features_dim, action_dim, **self.objective_kwargs
            )

        optimizer_class: Any = self.optimizer_class

        def optimizer(parameters: list[nn.Parameter]) -> th.optim.Optimizer:
            return optimizer_class(parameters, lr=lr_schedule(1), **self.optimizer_kwargs)

        trained_with_critic = list(self.critic.parameters())
        self.objective_optimizer = None
        if self.objective is not None:
            own = [parameter for parameter in self.objective.parameters() if parameter.requires_grad]
            if self.objective.own_optimizer:
                self.objective_optimizer = optimizer(self.critic.encoder_parameters() + own)
            else:
                # One optimizer for one summed loss: L = lambda * L_objective + L_RL
                trained_with_critic += own
        self.critic.optimizer = optimizer(trained_with_critic)
        self.actor.optimizer = optimizer(self.actor.own_parameters())

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        actor_kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        own = dict(detach_trunk=features_extractor is not None, layer_norm=self.actor_layer_norm)
        return VisualActor(**actor_kwargs, **own).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        critic_kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return self.critic_class(**critic_kwargs, layer_norm=self.critic_layer_norm).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        # SB3 forgets share_features_extractor
        return dict(
            super()._get_constructor_parameters(),
            share_features_extractor=self.share_features_extractor,
            critic_layer_norm=self.critic_layer_norm,
            actor_layer_norm=self.actor_layer_norm,
            objective_class=self.objective_class,
            objective_kwargs=self.objective_kwargs,
        )

    def preprocess(self, observations: PyTorchObs) -> PyTorchObs:
        """
        :param observations: Observations as the environment returns them
        :return: Input of the trunks: float, images in [0, 1] with channels last in memory
        """
        if isinstance(observations, dict):
            assert isinstance(self.observation_space, spaces.Dict)
            return {key: self._preprocess(part, self.observation_space[key]) for key, part in observations.items()}
        return self._preprocess(observations, self.observation_space)

    def _preprocess(self, part: th.Tensor, space: spaces.Space) -> Any:
        if part.dim() == 4:
            # The layout of the trunks: images are rearranged once, while they are bytes
            part = part.contiguous(memory_format=th.channels_last)
        if self.normalize_images and part.dtype == th.uint8 and is_image_space(space):
            # As preprocess_obs does, without a second copy of floats
            return part.float().div_(255.0)
        return preprocess_obs(part, space, normalize_images=self.normalize_images)

    def set_training_mode(self, mode: bool) -> None:
        """
        :param mode: True before an update, False before an action
        :raises UserError: If another algorithm is about to update the policy: SB3's would train it without its objective and
            without augmentations. It may predict
        """
        if mode and not self.is_trained_here:
            named = "no objective" if self.objective_class is None else f"the objective {self.objective_class.__name__}"
            raise UserError(
                f"a {type(self).__name__} of sb3_por with {named} can predict in a class of Stable-Baselines3, not learn: "
                "use a class of sb3_por, such as the one that saved the model"
            )
        super().set_training_mode(mode)
        if self.objective is not None:
            self.objective.train(mode)


class VisualSACPolicy(VisualPolicy, SACPolicy):
    """
    SAC policy whose critic trains the encoder. For vectors: the encoder is a small MLP. See ``VisualPolicy`` and SB3's
    ``SACPolicy`` for the arguments.
    """

    critic_class = VisualCritic
    default_encoder: type[Encoder] = VectorEncoder


class CnnPolicy(VisualSACPolicy):
    """For images: the encoder is the convolutional encoder of CURL and DrQ."""

    default_encoder = ConvEncoder


class MultiInputPolicy(VisualSACPolicy):
    """For Dict observations."""

    default_encoder = CombinedEncoder


MlpPolicy = VisualSACPolicy


class VisualTQCPolicy(VisualPolicy, TQCPolicy):
    """
    TQC policy whose critic trains the encoder. For vectors: the encoder is a small MLP. See ``VisualPolicy`` and
    sb3-contrib's ``TQCPolicy`` for the arguments.
    """

    critic_class = VisualQuantileCritic
    default_encoder: type[Encoder] = VectorEncoder


class TQCCnnPolicy(VisualTQCPolicy):
    """For images: the encoder is the convolutional encoder of CURL and DrQ."""

    default_encoder = ConvEncoder


class TQCMultiInputPolicy(VisualTQCPolicy):
    """For Dict observations."""

    default_encoder = CombinedEncoder


TQCMlpPolicy = VisualTQCPolicy
