"""Ranking: a potential of images that grows along videos of a task, and its change as a reward."""

from sb3_por.ranking.progress import RankedProgress
from sb3_por.ranking.ranker import Ranker
from sb3_por.ranking.training import train_ranker
from sb3_por.ranking.videos import read_videos

__all__ = ["RankedProgress", "Ranker", "read_videos", "train_ranker"]
