"""From a sampled batch to what the losses take: augmented, cast to float, encoded."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_por.objectives.base import EncodedBatch, Objective
from sb3_por.visual.augmentations import RandomShift


@dataclass(frozen=True)
class Frames:
    """
    The frames of a batch, each augmented independently and preprocessed; None where the objective does not ask for them.

    :param present: o_t, ``n_augmentations * batch`` rows: one augmentation of the whole batch after the other
    :param next: o_{t+1}, ``n_target_augmentations * batch`` rows
    :param future: o_{t+k}; None where that is ``next``
    :param past: o_{t-k} of the first half of the batch
    :param positive: Another augmentation of o_t
    :param window: o_{t+1}, ..., o_{t+K}, ``batch * K`` rows
    """

    present: PyTorchObs
    next: PyTorchObs
    future: PyTorchObs | None = None
    past: PyTorchObs | None = None
    positive: PyTorchObs | None = None
    window: PyTorchObs | None = None


class Augmentation:
    """
    Augment every frame of a batch independently, and cast it to float.

    :param policy: A visual policy; knows which observations are images and how to preprocess them
    :param pad: Largest random shift of images in pixels; 0 for none
    """

    def __init__(self, policy: Any, pad: int):
        self._preprocess: Callable[[PyTorchObs], PyTorchObs] = policy.preprocess
        self._shift = RandomShift(pad)
        space = policy.observation_space
        parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
        normalized = not policy.normalize_images
        self._image_keys = [key for key, part in parts.items() if is_image_space(part, normalized_image=normalized)]

    def __call__(self, observations: PyTorchObs, n: int = 1) -> PyTorchObs:
        """
        :param observations: A batch of observations, a tensor or a dict of tensors
        :param n: Number of augmentations of each
        :return: ``n * batch`` rows, images shifted at random, all of it preprocessed
        """
        repeated = _apply(lambda rows: repeat(rows, n), observations)
        if isinstance(repeated, dict):
            images = {key: self._shift(repeated[key]) for key in self._image_keys}
            return self._preprocess({**repeated, **images})
        return self._preprocess(self._shift(repeated) if self._image_keys else repeated)

    def frames(self, batch: Any, objective: Objective | None, n_present: int, n_next: int) -> Frames:
        """
        :param batch: Samples of the replay buffer
        :param objective: The objective, which declares the frames that it uses; None for none
        :param n_present: Number of augmentations of o_t
        :param n_next: Number of augmentations of o_{t+1}
        :return: The frames that an update needs
        """
        present, following = self(batch.observations, n_present), self(batch.next_observations, n_next)
        if objective is None:
            return Frames(present, following)
        future, past = getattr(batch, "future_observations", None), getattr(batch, "past_observations", None)
        return Frames(
            present,
            following,
            future=None if future is None else self(future),
            past=None if past is None else self(take(past, len(batch.actions) // 2)),
            positive=self(batch.observations) if objective.positive else None,
            window=self(_apply(lambda rows: rows.flatten(0, 1), batch.window_observations)) if objective.window > 0 else None,
        )


def encode(frames: Frames, batch: Any, objective: Objective, s_t: th.Tensor, s_next: th.Tensor, policy: Any) -> EncodedBatch:
    """
    Encode the frames that the objective uses besides the critic's.

    :param frames: Augmented frames
    :param batch: The samples that the frames are from
    :param objective: The objective
    :param s_t: f_o of the first augmentation of o_t, with gradient, shape ``(batch, features_dim)``
    :param s_next: f_m of the first augmentation of o_{t+1}, shape ``(batch, features_dim)``
    :param policy: A visual policy, which owns both encoders
    :return: The objective's input
    """
    f_o, f_m = policy.critic.features, policy.critic_target.features
    half = len(s_t) // 2
    present, past, has_past = s_t, None, None
    with th.no_grad():
        future = s_next if frames.future is None else f_m(frames.future)
        positive = None if frames.positive is None else f_m(frames.positive)
        window = None if frames.window is None else f_m(frames.window).unflatten(0, (len(s_t), -1))
    if objective.past is not None and frames.past is not None:
        with th.no_grad():
            past, has_past = f_m(frames.past), batch.past_gaps[:half, None] > 0
    elif objective.past is not None:
        # The replay buffer cannot go back: in the first half o_{t+k} is the present and o_t the past
        with th.no_grad():
            past = f_m(take(frames.present, half))
        has_past = th.ones(half, 1, dtype=th.bool, device=s_t.device)
        later = frames.next if frames.future is None else frames.future
        present = th.cat([f_o(take(later, half)), s_t[half:]])
    return EncodedBatch(
        present=present,
        future=future,
        past=past,
        has_past=has_past,
        positive=positive,
        window=window,
        window_actions=getattr(batch, "window_actions", None),
        window_rewards=getattr(batch, "window_rewards", None),
        window_mask=getattr(batch, "window_mask", None),
    )


def interleave(own: Any, demos: Any) -> Any:
    """
    :param own: Samples of the agent's own replay buffer, a named tuple
    :param demos: Samples of the demonstrations, as many or one less
    :return: One batch with rows of both in turn, so that either half of it holds both in equal parts
    """

    def both(one: Any, other: Any) -> Any:
        if one is None:
            return None
        if isinstance(one, dict):
            return {key: both(one[key], other[key]) for key in one}
        # Images keep their layout in memory
        rows = one.new_empty_strided((len(one) + len(other), *one.shape[1:]), one.stride())
        rows[0::2], rows[1::2] = one, other
        return rows

    return type(own)(*map(both, own, demos))


def demonstrated(rows: th.Tensor) -> th.Tensor:
    """
    :param rows: A tensor with a row for each sample of :func:`interleave`
    :return: The rows of the demonstrations
    """
    return rows[1::2]


def take(observations: PyTorchObs, n: int) -> PyTorchObs:
    """
    :param observations: A tensor, or a dict of tensors
    :param n: Number of rows
    :return: The first ``n`` rows
    """
    return _apply(lambda rows: rows[:n], observations)


def repeat(rows: th.Tensor, n: int) -> th.Tensor:
    """
    :param rows: A tensor
    :param n: Number of repetitions
    :return: The whole tensor ``n`` times, one after the other
    """
    return rows if n == 1 else rows.repeat(n, *[1] * (rows.dim() - 1))


def _apply(function: Callable[[th.Tensor], th.Tensor], observations: PyTorchObs) -> PyTorchObs:
    """The function of a tensor, or of every tensor of a dict."""
    if isinstance(observations, dict):
        return {key: function(value) for key, value in observations.items()}
    return function(observations)
