"""Wrappers for training settings (``env_wrapper``)."""

from typing import Any

import gymnasium as gym
import numpy as np

from softbody_envs.env import STATE_LIMIT


class ActionRepeat(gym.Wrapper[Any, np.ndarray, Any, np.ndarray], gym.utils.RecordConstructorArgs):
    """
    Scale each action and repeat it. Rewards of the repetitions are summed; the end of an episode ends the repetition.

    Random exploration moves farther in one direction, and returns have fewer steps. Scaling does not affect grasping, for
    which only the sign of the action counts.

    :param env: Environment with a ``Box`` action space
    :param repeat: Control steps per action, at least 1
    :param scale: Factor on the actions, above 0 and at most 1
    :raises ValueError: If ``repeat`` or ``scale`` is out of range
    """

    def __init__(self, env: gym.Env[Any, np.ndarray], repeat: int, scale: float = 1.0):
        gym.utils.RecordConstructorArgs.__init__(self, repeat=repeat, scale=scale)
        gym.Wrapper.__init__(self, env)
        if repeat < 1 or repeat != int(repeat):
            raise ValueError(f"repeat must be a whole number of at least 1, got {repeat!r}")
        if not 0.0 < scale <= 1.0:
            raise ValueError(f"scale must be above 0 and at most 1, got {scale!r}")
        self.repeat = int(repeat)
        self.scale = scale
        if "render_fps" in env.metadata:  # video recorders get one frame per repeated action
            self.metadata = env.metadata | {"render_fps": env.metadata["render_fps"] / self.repeat}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """
        See ``gymnasium.Env.step``. Observation and info are those of the last repetition.

        :raises ValueError: If the action has another shape than the space
        """
        space = self.action_space
        assert isinstance(space, gym.spaces.Box)
        if np.shape(action) != space.shape:
            raise ValueError(f"an action has the shape {space.shape}, got {np.shape(action)}")
        scaled = self.scale * np.clip(action, space.low, space.high)
        total = 0.0
        for _ in range(self.repeat):
            observation, reward, terminated, truncated, info = self.env.step(scaled.astype(np.float32))
            total += float(reward)
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, info


class ProgressReward(gym.Wrapper[Any, np.ndarray, Any, np.ndarray], gym.utils.RecordConstructorArgs):
    """
    Reward the change of ``info["normalized_performance"]`` instead of its level.

    SoftGym's rewards are levels: an episode that starts far from the goal pays for the distance at every step, whatever the
    agent does. The undiscounted sum of the progress is the final performance times ``scale``, which is the score of these
    tasks. With a discount gamma the return weighs early progress more: it is the level-based return of
    ``(1 - gamma) * performance``, plus a term for the end of the episode. In contrast to potential-based shaping, which adds
    ``gamma * potential' - potential`` to a reward and keeps its optimal policies, progress *replaces* the reward: an agent may
    prefer a quick half of the task to a slow whole one if gamma is small.

    :param env: Environment that reports ``info["normalized_performance"]`` at resets and steps
    :param scale: Factor on the change, above 0
    :raises ValueError: If ``scale`` is not above 0
    """

    def __init__(self, env: gym.Env[Any, np.ndarray], scale: float = 10.0):
        gym.utils.RecordConstructorArgs.__init__(self, scale=scale)
        gym.Wrapper.__init__(self, env)
        if not scale > 0.0:
            raise ValueError(f"scale must be above 0, got {scale!r}")
        self.scale = scale
        self._performance = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See ``gymnasium.Env.reset``."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._performance = _reported(info, "normalized_performance", self)
        return observation, info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See ``gymnasium.Env.step``; the reward is ``scale`` times the change of the normalized performance."""
        observation, _, terminated, truncated, info = self.env.step(action)
        change = info["normalized_performance"] - self._performance
        self._performance = info["normalized_performance"]
        return observation, self.scale * change, terminated, truncated, info


class ShowQuantity(gym.Wrapper[Any, np.ndarray, Any, np.ndarray], gym.utils.RecordConstructorArgs):
    """
    Add the true quantity to the image: ``{"image": ..., "quantity": ...}``, the input of an encoder that represents the
    quantity perfectly. What a policy gains from it bounds what a loss that teaches this quantity can add.

    :param env: Environment that observes images and reports the quantity in ``info`` at resets and steps
    :param key: Name of the quantity in ``info``: ``"monotone"`` is what POR would learn, ``"normalized_performance"`` the
        score
    :raises ValueError: If ``env`` does not observe images
    """

    def __init__(self, env: gym.Env[Any, np.ndarray], key: str = "monotone"):
        gym.utils.RecordConstructorArgs.__init__(self, key=key)
        gym.Wrapper.__init__(self, env)
        image = env.observation_space
        if not isinstance(image, gym.spaces.Box) or len(image.shape) != 3:
            raise ValueError(f"ShowQuantity needs an environment that observes images, got {image}")
        self.key = key
        quantity = gym.spaces.Box(-STATE_LIMIT, STATE_LIMIT, (1,), np.float32)
        self.observation_space = gym.spaces.Dict({"image": image, "quantity": quantity})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See ``gymnasium.Env.reset``."""
        image, info = self.env.reset(seed=seed, options=options)
        return self._with_quantity(image, info), info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See ``gymnasium.Env.step``."""
        image, reward, terminated, truncated, info = self.env.step(action)
        return self._with_quantity(image, info), float(reward), terminated, truncated, info

    def _with_quantity(self, image: Any, info: dict[str, Any]) -> dict[str, Any]:
        quantity = np.clip([_reported(info, self.key, self)], -STATE_LIMIT, STATE_LIMIT).astype(np.float32)
        return {"image": image, "quantity": quantity}


class SuccessReward(gym.Wrapper[Any, np.ndarray, Any, np.ndarray], gym.utils.RecordConstructorArgs):
    """
    Reward success alone: a sparse reward, ``scale`` at each step at which ``info["is_success"]`` holds, or the normalized
    performance is at least a threshold, else 0. Inside ``ActionRepeat`` every control step of a success counts, outside of it
    every action that ends in one.

    :param env: Environment that reports ``info["is_success"]``, or ``info["normalized_performance"]`` for a threshold
    :param scale: Reward of a step, above 0
    :param threshold: Smallest normalized performance of a success; 0 is that of the reset, 1 is perfect. None for the task's
        own ``is_success``
    :raises ValueError: If ``scale`` is not above 0, or ``threshold`` is not, so that doing nothing would be a success
    """

    def __init__(self, env: gym.Env[Any, np.ndarray], scale: float = 1.0, threshold: float | None = None):
        gym.utils.RecordConstructorArgs.__init__(self, scale=scale, threshold=threshold)
        gym.Wrapper.__init__(self, env)
        if not scale > 0.0:
            raise ValueError(f"scale must be above 0, got {scale!r}")
        if threshold is not None and not threshold > 0.0:
            raise ValueError(f"threshold must be above 0, got {threshold!r}")
        self.scale, self.threshold = scale, threshold

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See ``gymnasium.Env.step``."""
        observation, _, terminated, truncated, info = self.env.step(action)
        if self.threshold is None:
            success = _reported(info, "is_success", self)
        else:
            success = _reported(info, "normalized_performance", self) >= self.threshold
        return observation, self.scale * float(success), terminated, truncated, info


class Distraction(gym.Wrapper[Any, np.ndarray, Any, np.ndarray], gym.utils.RecordConstructorArgs):
    """
    Blend each image with a coarse texture that moves whatever the agent does, and let the camera shake. The texture and its
    motion follow from the scene (``info["variation"]``), so that held-out episodes look the same in every evaluation.

    :param env: Environment that observes images and reports ``info["variation"]`` at resets
    :param motion: ``"swing"``, to and fro: reversible in time, so that the order of two frames cannot be told from it; or
        ``"drift"``, steadily to the right: an arrow of time that has nothing to do with the task
    :param strength: Weight of the texture, from 0 to 1
    :param jitter: Largest random shift of the picture in each direction, pixels
    :raises ValueError: If an argument is out of range, or ``env`` does not observe square RGB images of uint8
    """

    #: Steps of a swing to and fro
    period = 8
    #: Pixels of a texture's element, and of its motion in a step
    element, speed = 8, 3

    def __init__(self, env: gym.Env[Any, np.ndarray], motion: str, strength: float = 0.4, jitter: int = 0):
        gym.utils.RecordConstructorArgs.__init__(self, motion=motion, strength=strength, jitter=jitter)
        gym.Wrapper.__init__(self, env)
        space = env.observation_space
        if space.shape is None or space.dtype != np.uint8 or space.shape != (*space.shape[:1] * 2, 3):
            raise ValueError(f"Distraction needs square RGB images of uint8, channels last, got {space}")
        if motion not in ("swing", "drift"):
            raise ValueError(f"motion must be 'swing' or 'drift', got {motion!r}")
        if not 0.0 <= strength <= 1.0 or jitter < 0:
            raise ValueError(f"strength must be from 0 to 1 and jitter at least 0, got {strength!r} and {jitter!r}")
        self.motion, self.strength, self.jitter = motion, strength, int(jitter)
        self._size = space.shape[0]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See ``gymnasium.Env.reset``."""
        image, info = self.env.reset(seed=seed, options=options)
        self._rng = np.random.default_rng(_reported(info, "variation", self))
        n = -(-self._size // self.element)
        coarse = self._rng.integers(0, 256, (n, n, 3), dtype=np.uint8)
        self._texture = coarse.repeat(self.element, axis=0).repeat(self.element, axis=1)[: self._size, : self._size]
        self._start, self._steps = self._rng.uniform(), 0
        return self._distract(image), info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See ``gymnasium.Env.step``."""
        image, reward, terminated, truncated, info = self.env.step(action)
        self._steps += 1
        return self._distract(image), float(reward), terminated, truncated, info

    def _distract(self, image: np.ndarray) -> np.ndarray:
        """Blend the image with the texture at its place in this step, and shift the result at random."""
        if self.motion == "drift":
            place = self._start * self._size + self.speed * self._steps
        else:
            place = 2 * self.speed * np.sin(2 * np.pi * (self._start + self._steps / self.period))
        texture = np.roll(self._texture, round(place), axis=1)
        blended = np.rint((1 - self.strength) * image + self.strength * texture).astype(np.uint8)
        y, x = self._rng.integers(0, 2 * self.jitter + 1, 2)
        padded = np.pad(blended, ((self.jitter,) * 2, (self.jitter,) * 2, (0, 0)), mode="edge")
        return padded[y : y + self._size, x : x + self._size].copy()


def _reported(info: dict[str, Any], key: str, wrapper: gym.Wrapper[Any, Any, Any, Any]) -> Any:
    """
    :raises gymnasium.error.Error: If the environment does not report it
    """
    if key not in info:
        raise gym.error.Error(f"{type(wrapper).__name__} needs info[{key!r}], which {wrapper.unwrapped} does not report")
    return info[key]
