"""The algorithms that users choose from: a visual actor-critic and an objective each."""

from typing import TYPE_CHECKING, Any

from sb3_por.actor_critic import VisualActorCritic
from sb3_por.objectives import Contrastive, Objective, PartialOrder, SelfPredictive
from sb3_por.visual_sac import VisualSAC
from sb3_por.visual_tqc import VisualTQC

if TYPE_CHECKING:
    Mixed = VisualActorCritic  # what the mixins below are mixed into
else:
    Mixed = object


class ReferenceSettings(Mixed):
    """
    Defaults of the references, CURL and DrQ, where they differ from SB3's. A mixin; all of it can be set.

    :param actor_update_interval: Update actor and temperature every that many updates
    :param target_update_interval: Update the target networks every that many updates
    :param encoder_tau: Soft update coefficient of the momentum encoder f_m; five times ``tau`` by default, at most 1
    :param tau: Soft update coefficient of the target Q networks
    """

    def __init__(
        self,
        *args: Any,
        actor_update_interval: int = 2,
        target_update_interval: int = 2,
        encoder_tau: float | None = None,
        tau: float = 0.01,
        **kwargs: Any,
    ):
        encoder_tau = min(5 * tau, 1.0) if encoder_tau is None else encoder_tau
        super().__init__(
            *args,
            actor_update_interval=actor_update_interval,
            target_update_interval=target_update_interval,
            encoder_tau=encoder_tau,
            tau=tau,
            **kwargs,
        )


class WithPartialOrder(ReferenceSettings):
    """
    Adds the POR objective to a visual actor-critic. A mixin; takes the arguments of the algorithm and

    :param por_coef: Weight lambda of the POR loss
    :param pairing: ``"paper"``, or ``"swap"``, which keeps the classifier from telling the two encoders apart
    :param order_head: The classifier: ``"mlp"`` (the paper's), ``"difference"`` or ``"coordinatewise"``
    :param order_dim: Size m of the physical quantities; half the encoder's features by default
    :param order_hidden_dim: Size of the hidden layers of g and c
    :param k: Steps between the two frames of a pair
    :param random_k: Draw these steps from 1..k for each pair
    """

    def __init__(
        self,
        *args: Any,
        por_coef: float = 0.1,
        pairing: str = "swap",
        order_head: str = "mlp",
        order_dim: int | None = None,
        order_hidden_dim: int = 256,
        k: int = 1,
        random_k: bool = False,
        **kwargs: Any,
    ):
        self.por_coef = por_coef
        self.pairing = pairing
        self.order_head = order_head
        self.order_dim = order_dim
        self.order_hidden_dim = order_hidden_dim
        self.k = k
        self.random_k = random_k
        super().__init__(*args, **kwargs)

    def _objective(self) -> tuple[type[Objective], dict[str, Any]]:
        return PartialOrder, dict(
            pairing=self.pairing,
            order_head=self.order_head,
            order_dim=self.order_dim,
            hidden_dim=self.order_hidden_dim,
            k=self.k,
            random_k=self.random_k,
        )

    @property
    def objective_coef(self) -> float:
        return self.por_coef


class SACPOR(WithPartialOrder, VisualSAC):
    """
    SAC from pixels with a partial-order representation (POR). Arguments: those of ``VisualSAC``, and those of
    ``WithPartialOrder`` by keyword.
    """


class TQCPOR(WithPartialOrder, VisualTQC):
    """
    TQC from pixels with a partial-order representation (POR). Arguments: those of ``VisualTQC``, and those of
    ``WithPartialOrder`` by keyword.
    """


class SACDrQ(ReferenceSettings, VisualSAC):
    """
    DrQ (https://arxiv.org/abs/2004.13649): SAC from pixels with [K, M] random shifts and nothing else. Losses are
    averaged over the M augmentations; DrQ sums them, which Adam does not notice. Arguments: those of ``VisualSAC``.

    :param n_augmentations: DrQ's M
    :param n_target_augmentations: DrQ's K
    :param encoder_tau: ``tau`` by default: DrQ has one for all
    """

    def __init__(
        self,
        *args: Any,
        n_augmentations: int = 2,
        n_target_augmentations: int = 2,
        encoder_tau: float | None = None,
        tau: float = 0.01,
        **kwargs: Any,
    ):
        super().__init__(
            *args,
            n_augmentations=n_augmentations,
            n_target_augmentations=n_target_augmentations,
            encoder_tau=tau if encoder_tau is None else encoder_tau,
            tau=tau,
            **kwargs,
        )


class SACCURL(ReferenceSettings, VisualSAC):
    """
    CURL: SAC from pixels with a contrastive objective. Arguments: those of ``VisualSAC`` and

    :param curl_coef: Weight of the contrastive loss
    """

    def __init__(self, *args: Any, curl_coef: float = 1.0, **kwargs: Any):
        self.curl_coef = curl_coef
        super().__init__(*args, **kwargs)

    def _objective(self) -> tuple[type[Objective], dict[str, Any]]:
        return Contrastive, {}

    @property
    def objective_coef(self) -> float:
        return self.curl_coef


class SACSPR(ReferenceSettings, VisualSAC):
    """
    SPR: SAC from pixels with a self-predictive objective. Arguments: those of ``VisualSAC`` and

    :param spr_coef: Weight of the loss, which is summed over the steps
    :param horizon: Number K of steps to predict
    """

    def __init__(self, *args: Any, spr_coef: float = 1.0, horizon: int = 5, **kwargs: Any):
        self.spr_coef = spr_coef
        self.horizon = horizon
        super().__init__(*args, **kwargs)

    def _objective(self) -> tuple[type[Objective], dict[str, Any]]:
        return SelfPredictive, dict(horizon=self.horizon)

    @property
    def objective_coef(self) -> float:
        return self.spr_coef


ALGORITHMS: dict[str, type[VisualActorCritic]] = {
    "sac_por": SACPOR,
    "sac_drq": SACDrQ,
    "sac_curl": SACCURL,
    "sac_spr": SACSPR,
    "tqc_por": TQCPOR,
}
