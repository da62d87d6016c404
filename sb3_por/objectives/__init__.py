"""Auxiliary objectives: losses that train an encoder beside the critic's."""

from sb3_por.objectives.base import EncodedBatch, Objective
from sb3_por.objectives.curl import Contrastive
from sb3_por.objectives.mrq import ModelBased
from sb3_por.objectives.por import PartialOrder
from sb3_por.objectives.spr import SelfPredictive

__all__ = ["Contrastive", "EncodedBatch", "ModelBased", "Objective", "PartialOrder", "SelfPredictive"]
