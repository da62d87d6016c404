"""Scores, videos and reference policies on held-out scenes."""

from sb3_por.evaluation.evaluate import evaluate

__all__ = ["evaluate"]
