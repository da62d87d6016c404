"""Base class of all tasks: spaces, seeding, variations, info, images and failed simulations."""

import copy
from abc import ABC, abstractmethod
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.utils import EzPickle

from softbody_envs.rendering import Camera, Renderer
from softbody_envs.sim.world import CONTROL_PERIOD, World
from softbody_envs.variations import SPLITS, check_variation, variation_rng
from softbody_envs.window import Window

OBS_TYPES = ("pixels", "state", "dict")
#: Largest height and width of images, pixels. Bullet ends the process when it has no memory for one.
MAX_SIZE = 4096
#: Bound of every element of a state vector, in the units of the task's page. Values are clipped to it.
STATE_LIMIT = 10.0
#: Tolerance of the success test: a rounding error must not decide it.
TOLERANCE = 1e-9


class SoftbodyEnv(gym.Env, EzPickle, ABC):
    """
    Base class of the tasks. A task defines its camera, action size and state vector, builds its scene and scores it.

    Actions are float32 in [-1, 1]. Episodes end by truncation at the registered horizon, never by termination.

    :param obs_type: ``"pixels"`` (uint8 image, height x width x 3), ``"state"`` (float32 vector) or ``"dict"``
        (``{"image": ..., "state": ...}``)
    :param image_size: height and width of the observed image, pixels
    :param split: variations that ``reset`` draws from: ``"train"`` (0-799) or ``"eval"`` (800-999)
    :param renderer: ``"tiny"`` (any machine) or ``"egl"`` (graphics driver)
    :param render_mode: ``None``, ``"rgb_array"`` (``render`` returns an image) or ``"human"`` (a window shows every step in
        real time; needs the extra ``human``)
    :param render_size: height and width of the rendered image, pixels
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 1 / CONTROL_PERIOD}  # noqa: RUF012

    #: Name that seeds the variations. Subclasses inherit it: the same task with another reward has the same scenes.
    scenes: ClassVar[str]
    #: Entry point of the scripted expert, ``"module:class"``, if there is one.
    expert: ClassVar[str | None] = None
    #: Camera of the images.
    camera: ClassVar[Camera]
    #: Number of elements of an action.
    action_size: ClassVar[int]
    #: One name for each element of ``state()``.
    state_names: ClassVar[tuple[str, ...]]
    #: Performance of a perfect solution: 1 on the normalized scale.
    best_performance: ClassVar[float]
    #: Normalized performance from which ``info["is_success"]`` holds.
    success_threshold: ClassVar[float]
    #: Simulation steps in one control step.
    steps_per_control: ClassVar[int]
    #: Whether the world holds cloth.
    deformable: ClassVar[bool] = False

    def __init__(
        self,
        obs_type: str = "pixels",
        image_size: int = 84,
        split: str = "train",
        renderer: str = "tiny",
        render_mode: str | None = None,
        render_size: int = 480,
    ) -> None:
        EzPickle.__init__(self, obs_type, image_size, split, renderer, render_mode, render_size)
        if obs_type not in OBS_TYPES:
            raise ValueError(f"obs_type must be one of {', '.join(OBS_TYPES)}, got {obs_type!r}")
        if split not in tuple(SPLITS):  # a list, too, can be refused by name
            raise ValueError(f"split must be one of {', '.join(SPLITS)}, got {split!r}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None, 'rgb_array' or 'human', got {render_mode!r}")
        for name, size in (("image_size", image_size), ("render_size", render_size)):
            if isinstance(size, bool) or not isinstance(size, (int, np.integer)) or not 1 <= size <= MAX_SIZE:
                raise ValueError(f"{name} must be a number of pixels from 1 to {MAX_SIZE}, got {size!r}")
        self.obs_type = obs_type
        self.image_size = image_size
        self.split = split
        self.render_mode = render_mode
        self.render_size = render_size
        self.renderer = Renderer(renderer)
        self._window = Window(self.metadata["render_fps"]) if render_mode == "human" else None

        image = gym.spaces.Box(0, 255, (image_size, image_size, 3), np.uint8)
        state = gym.spaces.Box(-STATE_LIMIT, STATE_LIMIT, (len(self.state_names),), np.float32)
        spaces: dict[str, gym.Space[Any]] = {
            "pixels": image,
            "state": state,
            "dict": gym.spaces.Dict({"image": image, "state": state}),
        }
        self.observation_space = spaces[obs_type]
        self.action_space = gym.spaces.Box(-1.0, 1.0, (self.action_size,), np.float32)

        self._world: World | None = None
        self._faulty = False
        self.variation = -1  # none before the first reset
        self._initial_performance = 0.0

    # -- defined by each task --------------------------------------------------------------------------------------

    @abstractmethod
    def _build(self, world: World, rng: np.random.Generator) -> None:
        """Build the scene of one variation, at rest, in an empty world. ``rng`` draws everything that varies."""

    @abstractmethod
    def _control(self, action: np.ndarray) -> None:
        """Apply one action, clipped to [-1, 1], and advance the world by one control step."""

    @abstractmethod
    def _measure(self) -> np.ndarray:
        """Return the elements of ``state_names``, in the units of the task's page."""

    @abstractmethod
    def performance(self) -> float:
        """Performance in the present state, in SoftGym's units."""

    @abstractmethod
    def monotone(self) -> float:
        """Physical quantity that rises while the task is being solved."""

    def reward(self) -> float:
        """Reward of the present state (SoftGym: the performance)."""
        return self.performance()

    def fault(self) -> str | None:
        """Describe why the simulation has failed, or return ``None``. Checked after every control step."""
        return None

    def _image(self, size: int) -> np.ndarray:
        """Render a new RGB image, uint8 ``(size, size, 3)``."""
        return self.renderer.render(self.world, self.camera, size)[0]

    # -- Gymnasium -------------------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        Start an episode in a variation drawn from the split, or in the one given by ``options={"variation": i}``.

        :param seed: seed of the random generator that draws variations
        :param options: ``{"variation": i}`` with i in 0..999, or nothing
        :raises ValueError: if an option is unknown, the index is out of range, or the variation starts solved
        """
        super().reset(seed=seed)
        options = {} if options is None else options
        if not isinstance(options, dict):
            raise ValueError(f'options must be a dict such as {{"variation": 3}}, got {options!r}')
        if unknown := set(options) - {"variation"}:
            raise ValueError(f'reset knows the option "variation" only, got {", ".join(sorted(map(repr, unknown)))}')
        if "variation" in options:
            self.variation = check_variation(options["variation"])
        else:
            split = SPLITS[self.split]
            self.variation = int(self.np_random.integers(split.start, split.stop))
        if self._world is None:
            self._world = self._open()
        self._faulty = False
        self.world.clear()
        self._build(self.world, variation_rng(self.scenes, self.variation))
        self._initial_performance = self.performance()
        if not self._initial_performance < self.best_performance:
            raise ValueError(
                f"variation {self.variation} starts solved, so that its score is undefined: performance() is "
                f"{self._initial_performance:.3g} at reset, and best_performance is {self.best_performance:.3g}"
            )
        observation, _, info = self._outcome()
        if self._window is not None:
            self.render()
        return observation, info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """
        Advance by one control step of 0.08 s. Actions are clipped to [-1, 1].

        :raises ValueError: if the action has the wrong shape or is not finite; the state is unchanged then
        """
        if self._world is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self.action_space.shape:
            raise ValueError(f"action must have shape {self.action_space.shape}, got {action.shape}")
        if not np.isfinite(action).all():
            raise ValueError(f"action must be finite, got {action}")
        self._control(np.clip(action, -1.0, 1.0))
        fault = self.fault()
        if fault is None:
            observation, reward, info = self._outcome()
        else:
            # Positions are meaningless now: return the last valid outcome, end the episode, and start the next one in a
            # new world.
            self._disconnect()
            self._faulty = True
            observation, reward, info = self._last_valid
            info = info | {"sim_error": fault}
        if self._window is not None:
            self.render()
        return observation, reward, False, fault is not None, info

    def render(self) -> np.ndarray | None:
        """
        Render the present state. The image is black if the simulation has failed.

        :return: an RGB image, uint8 ``(render_size, render_size, 3)``, if ``render_mode`` is ``"rgb_array"``
        """
        if self.render_mode is None:
            gym.logger.warn('render() does nothing without a render mode: make the environment with render_mode="rgb_array"')
            return None
        size = self.render_size
        frame = np.zeros((size, size, 3), np.uint8) if self._faulty else self._image(size)
        if self._window is None:
            return frame
        self._window.show(frame)
        return None

    def close(self) -> None:
        """Close the window and free the simulation. ``reset`` starts a new one."""
        self._disconnect()
        if self._window is not None:
            self._window.close()

    def _disconnect(self) -> None:
        if self._world is not None:
            self._world.close()
            self._world = None

    @property
    def world(self) -> World:
        """
        Bullet world of the episode.

        :raises gymnasium.error.ResetNeeded: before the first ``reset`` and after ``close``
        """
        if self._world is None:
            raise gym.error.ResetNeeded("call reset() first")
        return self._world

    def _open(self) -> World:
        """Make a world that the renderer can draw."""
        world = World(self.steps_per_control, self.deformable)
        try:
            self.renderer.attach(world)
        except BaseException:
            world.close()
            raise
        return world

    # -- derived ---------------------------------------------------------------------------------------------------

    def state(self) -> np.ndarray:
        """State vector, float32, for any observation type. Its elements are ``state_names``."""
        return np.clip(self._measure(), -STATE_LIMIT, STATE_LIMIT).astype(np.float32)

    def normalized_performance(self) -> float:
        """Performance on a scale from 0 (as at reset) to 1 (perfect)."""
        span = self.best_performance - self._initial_performance
        return (self.performance() - self._initial_performance) / span

    def _observation(self) -> Any:
        if self.obs_type == "state":
            return self.state()
        image = self._image(self.image_size)
        return image if self.obs_type == "pixels" else {"image": image, "state": self.state()}

    def _outcome(self) -> tuple[Any, float, dict[str, Any]]:
        """Return observation, reward and info of the present state, and keep a copy in case the next step fails."""
        outcome = self._observation(), float(self.reward()), self._info()
        self._last_valid = copy.deepcopy(outcome)  # callers may modify what they get
        return outcome

    def _info(self) -> dict[str, Any]:
        normalized = float(self.normalized_performance())
        return {
            "performance": float(self.performance()),
            "normalized_performance": normalized,
            "is_success": bool(normalized >= self.success_threshold - TOLERANCE),
            "monotone": float(self.monotone()),
            "variation": self.variation,
        }
