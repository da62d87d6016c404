"""Scores, videos and reference policies on held-out scenes."""

from sb3_por.evaluation.evaluate import evaluate
from sb3_por.evaluation.safe_loading import load_safe

__all__ = ["evaluate", "load_safe"]
