"""Stable-Baselines3 algorithms that learn from pixels with a representation objective."""

from sb3_por.algorithms import ALGORITHMS
from sb3_por.algorithms.sac_curl import SACCURL
from sb3_por.algorithms.sac_drq import SACDrQ
from sb3_por.algorithms.sac_por import SACPOR
from sb3_por.algorithms.sac_spr import SACSPR
from sb3_por.algorithms.tqc_por import TQCPOR
from sb3_por.visual.sac import VisualSAC
from sb3_por.visual.tqc import VisualTQC

__all__ = ["ALGORITHMS", "SACCURL", "SACPOR", "SACSPR", "TQCPOR", "SACDrQ", "VisualSAC", "VisualTQC"]
