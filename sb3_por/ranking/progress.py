"""The change of a ranker's potential as a reward."""

from typing import Any

import gymnasium as gym
import numpy as np

from sb3_por.common.checks import check_types
from sb3_por.common.errors import UserError
from sb3_por.ranking.images import find_image
from sb3_por.ranking.ranker import Ranker


class RankedProgress(gym.Wrapper[Any, np.ndarray, Any, np.ndarray], gym.utils.RecordConstructorArgs):
    """
    Add ``scale`` times the change of a ranker's potential to the reward. A video earns ``scale`` in total, as the whole task
    earns in ``ProgressReward``. ``info["potential"]`` has the potential.

    With ``gamma`` it is potential-based shaping (Ng, Harada and Russell, 1999): ``gamma * potential' - potential``, with a
    potential of 0 where an episode terminates. Shaping with the agent's own discount keeps the optimal policies of the task's
    reward; without ``gamma`` the plain difference weighs early progress more.

    The ranker sees the image in the observation, before frames are stacked; where there is none, the picture that
    ``render()`` returns.

    :param env: Environment with one image in its observations, or with ``render_mode="rgb_array"``
    :param ranker: File of the ranker, see ``python -m sb3_por rank``
    :param scale: Factor on the change, above 0
    :param gamma: Discount of potential-based shaping, above 0 and at most 1; None for the plain difference
    :raises UserError: If the ranker cannot be read, or there is no image
    :raises ValueError: If ``scale`` or ``gamma`` is out of range
    """

    def __init__(self, env: gym.Env[Any, np.ndarray], ranker: str, scale: float = 10.0, gamma: float | None = None):
        gym.utils.RecordConstructorArgs.__init__(self, ranker=str(ranker), scale=scale, gamma=gamma)
        gym.Wrapper.__init__(self, env)
        check_types(type(self), {"scale": scale, "gamma": gamma})
        if not scale > 0.0:
            raise ValueError(f"scale must be above 0, got {scale!r}")
        if gamma is not None and not 0.0 < gamma <= 1.0:
            raise ValueError(f"gamma must be above 0 and at most 1, got {gamma!r}")
        self.scale, self.gamma = scale, gamma
        self.ranker = Ranker.load(ranker)
        self._image = find_image(env.observation_space)
        if self._image is None and env.render_mode != "rgb_array":
            raise UserError(
                f"a ranker needs an image: there is not one in {env.observation_space}, and render_mode is not rgb_array "
                "(--env-kwargs render_mode:rgb_array)"
            )
        self._potential = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See ``gymnasium.Env.reset``."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._potential = self._measure(observation)
        return observation, info | {"potential": self._potential}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See ``gymnasium.Env.step``."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        before = self._potential
        if "sim_error" not in info:  # a task of ours draws a black picture then, which says nothing
            self._potential = self._measure(observation)
        if self.gamma is None:
            change = self._potential - before
        else:
            change = (0.0 if terminated else self.gamma * self._potential) - before
        info = info | {"potential": self._potential}
        return observation, float(reward) + self.scale * change, terminated, truncated, info

    def _measure(self, observation: Any) -> float:
        image = self.env.render() if self._image is None else self._image(observation)
        return float(self.ranker.potential(np.asarray(image)[None])[0])
