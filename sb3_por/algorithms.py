"""The algorithms that users choose from: a visual actor-critic and an objective each."""

from typing import TYPE_CHECKING, Any, ClassVar

from sb3_por.objectives import Contrastive, Objective, PartialOrder, SelfPredictive
from sb3_por.visual.actor_critic import VisualActorCritic
from sb3_por.visual.sac import VisualSAC
from sb3_por.visual.tqc import VisualTQC

if TYPE_CHECKING:
    Mixed = VisualActorCritic  # what the mixin below is mixed into
else:
    Mixed = object


#: CURL's, SPR's and the paper's momentum encoder: 0.05 where the Q networks have 0.01.
MOMENTUM_TAU_RATIO = 5.0


class WithPartialOrder(Mixed):
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

    encoder_tau_ratio: ClassVar[float] = MOMENTUM_TAU_RATIO

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


class SACDrQ(VisualSAC):
    """
    DrQ (https://arxiv.org/abs/2004.13649): SAC from pixels with [K, M] random shifts and nothing else. Losses are
    averaged over the M augmentations; DrQ sums them, which Adam does not notice. One ``tau`` moves all targets. Arguments:
    those of ``VisualSAC``.

    :param n_augmentations: DrQ's M
    :param n_target_augmentations: DrQ's K
    """

    def __init__(self, *args: Any, n_augmentations: int = 2, n_target_augmentations: int = 2, **kwargs: Any):
        super().__init__(*args, n_augmentations=n_augmentations, n_target_augmentations=n_target_augmentations, **kwargs)


class SACCURL(VisualSAC):
    """
    CURL: SAC from pixels with a contrastive objective, which has an optimizer of its own. Arguments: those of ``VisualSAC``
    and

    :param aux_lr_ratio: Learning rate of the objective's optimizer, in units of ``learning_rate``
    """

    encoder_tau_ratio: ClassVar[float] = MOMENTUM_TAU_RATIO

    def __init__(self, *args: Any, aux_lr_ratio: float = 1.0, **kwargs: Any):
        self.aux_lr_ratio = aux_lr_ratio
        super().__init__(*args, **kwargs)

    def _objective(self) -> tuple[type[Objective], dict[str, Any]]:
        return Contrastive, {}


class SACSPR(VisualSAC):
    """
    SPR: SAC from pixels with a self-predictive objective, which has an optimizer of its own. Arguments: those of
    ``VisualSAC`` and

    :param aux_lr_ratio: Learning rate of the objective's optimizer, in units of ``learning_rate``
    :param horizon: Number K of steps to predict
    """

    encoder_tau_ratio: ClassVar[float] = MOMENTUM_TAU_RATIO

    def __init__(self, *args: Any, aux_lr_ratio: float = 1.0, horizon: int = 5, **kwargs: Any):
        self.aux_lr_ratio = aux_lr_ratio
        self.horizon = horizon
        super().__init__(*args, **kwargs)

    def _objective(self) -> tuple[type[Objective], dict[str, Any]]:
        return SelfPredictive, dict(horizon=self.horizon)


ALGORITHMS: dict[str, type[VisualActorCritic]] = {
    "sac_por": SACPOR,
    "sac_drq": SACDrQ,
    "sac_curl": SACCURL,
    "sac_spr": SACSPR,
    "tqc_por": TQCPOR,
}
