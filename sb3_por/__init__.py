"""Stable-Baselines3 algorithms that learn from pixels with a representation objective."""

from sb3_por.algorithms import ALGORITHMS, SACCURL, SACPOR, SACSPR, TQCPOR, SACDrQ
from sb3_por.visual.sac import VisualSAC
from sb3_por.visual.tqc import VisualTQC

__all__ = ["ALGORITHMS", "SACCURL", "SACPOR", "SACSPR", "TQCPOR", "SACDrQ", "VisualSAC", "VisualTQC"]
