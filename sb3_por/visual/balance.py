"""The weight of an auxiliary loss that keeps its gradient at a fixed ratio to the critic's (``"auto_0.1"``)."""

from typing import NamedTuple

import torch as th

#: Updates from one measurement of the gradients to the next
INTERVAL = 10
#: Weight of a new measurement in the moving averages of the norms
SMOOTHING = 0.1
#: Ratio of ``"auto"``
RATIO = 0.1


class EncoderGradients(NamedTuple):
    """
    Gradients of the two losses of a batch with respect to the encoder, flattened.

    :param critic: Of L_RL, shape ``(number of parameters,)``
    :param objective: Of L_objective, without its weight, same shape
    """

    critic: th.Tensor
    objective: th.Tensor

    def cosine(self) -> th.Tensor:
        """
        :return: Cosine of the angle between the two: below 0 where one loss undoes what the other does; 0 if one is 0
        """
        return th.nn.functional.cosine_similarity(self.critic, self.objective, dim=0)


def gradient_ratio(coef: str | float, name: str) -> float | None:
    """
    :param coef: Weight of an objective: a number, ``"auto"``, or ``"auto_0.1"`` for another ratio than ``RATIO``
    :param name: Name of the argument, for the message
    :return: The ratio rho of the gradients' norms; None if the weight is a number
    :raises ValueError: If the text is neither, or the ratio is not above 0
    """
    if not isinstance(coef, str):
        return None
    start, _, number = coef.partition("_")
    try:
        ratio = float(number) if number else RATIO
    except ValueError:
        ratio = 0.0
    if start != "auto" or coef == "auto_" or not 0.0 < ratio < float("inf"):
        raise ValueError(f"{name} must be a number, 'auto', or a ratio of gradients above 0 such as 'auto_0.1', got {coef!r}")
    return ratio


class GradientBalance:
    """
    Moving averages of the norms of the two gradients, of which the weight follows:
    lambda = rho |grad L_RL| / |grad L_objective|, both with respect to the encoder.

    The averages are of the norms and not of their quotient, which one batch with a small gradient would dominate.

    :param ratio: rho; None for a fixed weight
    :param device: PyTorch device
    """

    def __init__(self, ratio: float | None, device: th.device):
        self.ratio = ratio
        #: Averages of the norms of critic and objective; NaN before the first measurement. Saved with the model
        self.norms = th.full((2,), th.nan, device=device)
        self._measured = False

    def is_due(self, update: int) -> bool:
        """
        :param update: Number of the update, from 1
        :return: Whether to measure at it: every ``INTERVAL`` updates, and where there is no measurement yet, as in a model
            that was trained with a fixed weight
        """
        if self.ratio is None:
            return False
        # A device is asked once: norms may have come from a file
        self._measured = self._measured or not self.norms.isnan().any().item()
        return not self._measured or (update - 1) % INTERVAL == 0

    def measure(self, gradients: EncoderGradients) -> None:
        """
        :param gradients: Gradients of one batch
        """
        norms = th.stack([gradients.critic.norm(), gradients.objective.norm()])
        # One that overflows would stay in the averages; it is left out, and the losses tell whether training has diverged
        norms = th.where(norms.isfinite().all(), norms, self.norms)
        # From 0, unlike from the first measurement, which would count ten times as much as the second. The bias of both
        # averages, which Adam corrects, cancels in their quotient
        self.norms = self.norms.nan_to_num(0.0).lerp(norms, SMOOTHING)

    @property
    def weight(self) -> th.Tensor:
        """
        :return: lambda, a scalar; 0 for an objective without a gradient, NaN before the first measurement
        """
        assert self.ratio is not None
        critic, objective = self.norms
        return th.where(objective == 0, 0.0, self.ratio * critic / objective)
