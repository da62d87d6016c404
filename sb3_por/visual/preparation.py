"""From a batch of the replay buffer to the views that the losses need: augmented, cast to float, named."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

from sb3_por.visual.augmentations import RandomShift
from sb3_por.visual.views import Views, take_rows


class Preparation:
    """
    Augments every frame of a batch independently and casts it to float, once.

    :param policy: Owner of the critics and of the objective
    :param augmentation_pad: Random shift of images, in pixels; 0 for none
    :param n_augmentations: Augmentations of each observation
    :param n_target_augmentations: Augmentations of each next observation
    :param bfloat16: The trunks compute in lower precision
    """

    def __init__(
        self,
        policy: Any,
        augmentation_pad: int,
        n_augmentations: int,
        n_target_augmentations: int,
        bfloat16: bool = False,
    ):
        self._policy = policy
        self._bfloat16 = bfloat16
        self._augment = RandomShift(augmentation_pad)
        self._image_keys = _find_image_keys(policy)
        #: Names of the augmentations of o_t and of o_{t+1}
        self.obs_names = ["obs", *(f"obs_{i}" for i in range(1, n_augmentations))]
        self.next_names = ["next", *(f"next_{i}" for i in range(1, n_target_augmentations))]

    def views(self, replay_data: Any) -> Views:
        """
        :param replay_data: A batch of the replay buffer, with what the objective asks for
        :return: Its frames and other tensors by name
        """
        frames = {name: self.prepare(replay_data.observations) for name in self.obs_names}
        frames.update((name, self.prepare(replay_data.next_observations)) for name in self.next_names)
        data = {"actions": replay_data.actions}
        objective = self._policy.objective
        if objective is not None:
            future = getattr(replay_data, "future_observations", None)
            frames["future"] = frames["next"] if future is None else self.prepare(future)
            self._add_past(frames, data, replay_data, getattr(replay_data, "past_observations", None))
            if objective.positive:
                frames["positive"] = self.prepare(replay_data.observations)
            if objective.window > 0:
                frames["window"] = self.prepare(_flatten_window(replay_data.window_observations))
                data.update(window_actions=replay_data.window_actions, window_mask=replay_data.window_mask)
        return self._views(frames, data)

    def control_views(self, replay_data: Any) -> Views:
        """
        :param replay_data: A batch of the replay buffer
        :return: Its observations in all places, augmented independently: what an objective's control is shown
        """
        frames = {name: self.prepare(replay_data.observations) for name in ("obs", "future")}
        data: dict[str, th.Tensor] = {}
        self._add_past(frames, data, replay_data, replay_data.observations)
        return self._views(frames, data)

    def prepare(self, observations: Any) -> Any:
        """
        :param observations: One set of observations, a tensor or a dict of tensors
        :return: The same, images shifted at random, all of it preprocessed
        """
        augmented: Any
        if isinstance(observations, dict):
            augmented = {
                key: self._augment(value) if key in self._image_keys else value for key, value in observations.items()
            }
        else:
            augmented = self._augment(observations) if self._image_keys else observations
        return self._policy.preprocess(augmented)

    def _add_past(self, frames: dict[str, Any], data: dict[str, th.Tensor], replay_data: Any, past: Any) -> None:
        """Add these earlier frames of the first half of the batch, if the replay buffer has any."""
        if getattr(replay_data, "past_gaps", None) is not None:
            frames["past"] = self.prepare(_first_half(past))
            data["past_gaps"] = _first_half(replay_data.past_gaps)

    def _views(self, frames: dict[str, Any], data: dict[str, th.Tensor]) -> Views:
        return Views(self._policy.critic, self._policy.critic_target, frames, data, self._bfloat16)


def _find_image_keys(policy: Any) -> list[str]:
    """Keys of the image observations, "" for an observation that is one image."""
    space = policy.observation_space
    parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    return [key for key, part in parts.items() if is_image_space(part, normalized_image=not policy.normalize_images)]


def _first_half(rows: Any) -> Any:
    """The first half of a batch, also of a dict of them."""
    n = len(next(iter(rows.values())) if isinstance(rows, dict) else rows)
    return take_rows(rows, slice(n // 2))


def _flatten_window(observations: Any) -> Any:
    """From shape ``(batch, K, ...)`` to ``(batch * K, ...)``."""
    if isinstance(observations, dict):
        return {key: value.flatten(0, 1) for key, value in observations.items()}
    return observations.flatten(0, 1)
