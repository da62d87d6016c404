"""Training of a ranker on pairs of frames."""

from collections.abc import Sequence

import numpy as np
import torch as th
from stable_baselines3.common.utils import get_device
from torch.nn import functional as F

from sb3_por.acceleration.threads import use_one_thread
from sb3_por.common.errors import UserError, check_known
from sb3_por.ranking.images import resize
from sb3_por.ranking.ranker import Ranker, as_tensor
from sb3_por.visual.augmentations import RandomShift

TARGETS = ("order", "distance")


def train_ranker(
    videos: Sequence[np.ndarray],
    negatives: Sequence[np.ndarray] = (),
    target: str = "order",
    updates: int = 1500,
    batch_size: int = 32,
    learning_rate: float = 1e-3,
    image_size: int = 64,
    seed: int = 0,
    device: th.device | str = "auto",
) -> Ranker:
    """
    Train a ranker on pairs of frames of one video, and on pairs of a negative and a frame of a video.

    The gap between two frames of a video is drawn with a probability that falls like 1 / gap: most pairs are close in time,
    as the frames are between which a change of the potential is a reward. A negative is what other behaviour looks like; it
    counts as time 0, so that frames off the videos' way do not rank high.

    With the target ``"order"`` the head learns the probability of the later frame being the later one (Rank2Reward,
    https://arxiv.org/abs/2404.14735), with ``"distance"`` the signed distance in time, in units of the video's length
    (TimeRewarder, https://arxiv.org/abs/2509.26627).

    :param videos: Frames of each video, uint8, shape ``(n, height, width, channels)``, from the start of the task to its end
    :param negatives: Frames of other behaviour in the same scenes, as many arrays as there were episodes
    :param target: ``"order"`` or ``"distance"``
    :param updates: Number of updates
    :param batch_size: Pairs of each kind in an update
    :param learning_rate: Learning rate of Adam
    :param image_size: Height and width in pixels to which images are resized
    :param seed: Seed of weights, pairs and augmentations; the generators of the process are left as they are
    :param device: PyTorch device
    :return: The ranker, in units of these videos (``Ranker.calibrate``)
    :raises UserError: If there is no video of at least two frames, or nothing could be learned
    """
    check_known("target", target, TARGETS)
    videos = [resize(video, image_size) for video in videos if len(video) > 1]
    if not videos:
        raise UserError("there are no videos of at least two frames to learn from")
    use_one_thread()
    pairs = _Pairs(videos, [resize(frames, image_size) for frames in negatives], seed)
    with th.random.fork_rng(devices=range(th.cuda.device_count())):
        th.manual_seed(seed)
        ranker = Ranker(image_size).to(get_device(device))
        frames, augment = pairs.frames.to(get_device(device)), RandomShift()
        optimizer = th.optim.Adam(ranker.parameters(), lr=learning_rate)
        for _ in range(updates):
            earlier, later, distance = (th.as_tensor(part).to(frames.device) for part in pairs.sample(batch_size))
            potential_earlier, potential_later = ranker(augment(frames[th.cat([earlier, later])])).chunk(2)
            difference = potential_later - potential_earlier  # the head's logit
            loss = F.softplus(-difference).mean() if target == "order" else F.mse_loss(difference, distance)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    ranker.calibrate(videos)
    ranker.facts = {"target": target, "n_videos": len(videos), "n_negatives": pairs.n_negatives, "updates": updates}
    return ranker


class _Pairs:
    """Draws pairs of frames: (index of the earlier frame, index of the later frame, distance in lengths of the video)."""

    def __init__(self, videos: list[np.ndarray], negatives: list[np.ndarray], seed: int) -> None:
        self.frames = as_tensor(np.concatenate([*videos, *negatives]))
        self.n_negatives = sum(map(len, negatives))
        self._lengths = np.array([len(video) for video in videos])
        self._starts = np.cumsum(self._lengths) - self._lengths
        self._rng = np.random.default_rng(seed)

    def sample(self, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw n pairs of each kind."""
        video = self._rng.integers(len(self._lengths), size=n)
        last = self._lengths[video] - 1
        gap = np.floor(np.exp(self._rng.uniform(size=n) * np.log(last + 1))).astype(int).clip(1, last)
        earlier = self._rng.integers(last - gap + 1)
        pairs = [(self._starts[video] + earlier, self._starts[video] + earlier + gap, gap / last)]
        if self.n_negatives:
            video = self._rng.integers(len(self._lengths), size=n)
            last = self._lengths[video] - 1
            time = self._rng.integers(1, last + 1)
            negative = self._lengths.sum() + self._rng.integers(self.n_negatives, size=n)
            pairs.append((negative, self._starts[video] + time, time / last))
        first, second, distance = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
        return first, second, distance.astype(np.float32)
