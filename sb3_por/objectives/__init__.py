"""Auxiliary objectives: losses that train an encoder beside the critic's."""

from sb3_por.objectives.base import Objective
from sb3_por.objectives.por import PartialOrder

__all__ = ["Objective", "PartialOrder"]
