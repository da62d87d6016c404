"""Heads of POR on frozen features: judge frames with a trained head, and train a fresh one as a control."""

import numpy as np
import torch as th

from sb3_por.analysis.controls import Belief
from sb3_por.common.errors import UserError
from sb3_por.objectives.base import EncodedBatch
from sb3_por.objectives.order_heads import OrderHead
from sb3_por.objectives.por import PartialOrder

#: Pairs that are judged at once.
CHUNK = 16384
#: Training of a fresh head: number of updates, pairs in each, Adam's learning rate.
N_UPDATES, BATCH_SIZE, LEARNING_RATE = 1000, 256, 1e-3


def judgement(objective: PartialOrder, features: th.Tensor) -> tuple[np.ndarray, Belief]:
    """
    Judge frames that one encoder has encoded, so that the classifier cannot tell encoders apart instead of times.

    :param objective: owner of g and c
    :param features: encoded frames, shape ``(frames, features_dim)``
    :return: potential of each frame, and the classifier's judgement of pairs
    """
    with th.no_grad():
        potential = objective.potential(features).cpu().numpy()
        quantities = objective.g(features)

    def belief(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        pairs = th.as_tensor(np.stack([first, second]), device=features.device)
        with th.no_grad():
            return th.cat([_belief(objective.c, *quantities[chunk]) for chunk in pairs.split(CHUNK, dim=1)]).cpu().numpy()

    return potential, belief


def train_head(
    objective: PartialOrder, features: th.Tensor, earlier: np.ndarray, later: np.ndarray, sham: bool = False
) -> PartialOrder:
    """
    Train a fresh head on frozen features.

    :param objective: a new objective with ``pairing="paper"``: a single encoder needs no exchange of encoders
    :param features: encoded frames, shape ``(frames, features_dim)``
    :param earlier: indices of the earlier frame of each pair
    :param later: indices of the later frame of each pair
    :param sham: draw the order of each pair by chance, once: the chance level of this procedure
    :return: the same objective, trained
    :raises UserError: if there are no pairs
    """
    if not len(earlier):
        raise UserError("no episode is long enough for a pair of frames")
    device = features.device
    pairs = th.as_tensor(np.stack([earlier, later]), device=device)
    if sham:
        pairs = th.where((th.rand(pairs.shape[1]) < 0.5).to(device), pairs, pairs.flip(0))
    optimizer = th.optim.Adam(objective.parameters(), lr=LEARNING_RATE)
    for _ in range(N_UPDATES):
        rows = th.randint(pairs.shape[1], (BATCH_SIZE,)).to(device)
        present, future = features[pairs[0, rows]], features[pairs[1, rows]]
        loss, _ = objective.loss(EncodedBatch(present=present, future=future))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return objective


def _belief(c: OrderHead, first: th.Tensor, second: th.Tensor) -> th.Tensor:
    """1 where both logits of c call the second one later, 0 where both call it earlier; a tie is half right."""
    return 0.5 + 0.25 * (th.sign(c(second, first)) - th.sign(c(first, second)))
