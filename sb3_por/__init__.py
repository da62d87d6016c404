"""Stable-Baselines3 algorithms that learn from pixels with a representation objective."""

from sb3_por.algorithms import ALGORITHMS, SACPOR
from sb3_por.visual_sac import VisualSAC

__all__ = ["ALGORITHMS", "SACPOR", "VisualSAC"]
