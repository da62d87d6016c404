"""A replay buffer that stores every frame once and samples transitions, later frames and windows of an episode."""

from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import TensorDict
from stable_baselines3.common.vec_env import VecNormalize

from sb3_por.acceleration.transfer import free_memory, to_device
from sb3_por.common.memory import available_memory

Observations = th.Tensor | TensorDict


class SequenceSamples(NamedTuple):
    """
    A batch of transitions, as SB3's ``ReplayBufferSamples``, and other frames of their episodes. Frames that were not
    requested are None.

    :param observations: o_t
    :param actions: a_t, of shape ``(batch, action_dim)``
    :param next_observations: o_{t+n} for n-step returns, n smaller where the episode ended earlier
    :param dones: 1 where the episode terminated within these n steps (truncation does not count), ``(batch, 1)``
    :param rewards: Discounted sum of the n rewards, ``(batch, 1)``
    :param discounts: gamma ** n, ``(batch, 1)``; None for n = 1
    :param future_observations: o_{t+k}
    :param gaps: k of each sample, ``(batch,)``; smaller than requested near the end of the episode
    :param past_observations: o_{t-k}
    :param past_gaps: k of each sample, ``(batch,)``; smaller than requested near the start of the episode, 0 for its
        first frame
    :param window_observations: o_{t+1} .. o_{t+K}, ``(batch, K, ...)``
    :param window_actions: a_t .. a_{t+K-1}, ``(batch, K, action_dim)``
    :param window_rewards: r_t .. r_{t+K-1}, ``(batch, K)``
    :param window_mask: 1 where a step of the window belongs to the episode, ``(batch, K)``; the others repeat the last
    """

    observations: Observations
    actions: th.Tensor
    next_observations: Observations
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None = None
    future_observations: Observations | None = None
    gaps: th.Tensor | None = None
    past_observations: Observations | None = None
    past_gaps: th.Tensor | None = None
    window_observations: Observations | None = None
    window_actions: th.Tensor | None = None
    window_rewards: th.Tensor | None = None
    window_mask: th.Tensor | None = None


class FrameStore:
    """
    Frames addressed by row numbers: a ring of fixed size, then loose rows for the frames outside of the ring (the last frame
    of each episode and the newest frame of each environment). Images have channels last in memory, the layout of augmentation
    and convolutions.

    :param n_ring: Rows of the ring
    :param n_loose: Initial number of loose rows; it grows
    :param shape: Shape of one frame
    :param dtype: Type of the frames
    :param device: Device of the frames
    """

    def __init__(self, n_ring: int, n_loose: int, shape: tuple[int, ...], dtype: np.dtype, device: th.device):
        self.n_ring = n_ring
        self.shape = shape
        self.is_image = len(shape) == 3
        in_memory = (*shape[1:], shape[0]) if self.is_image else shape
        # numpy's zeros take no memory until they are written to
        self.ring = th.from_numpy(np.zeros((n_ring, *in_memory), dtype)).to(device)
        self.loose = th.from_numpy(np.zeros((n_loose, *in_memory), dtype)).to(device)
        self.n_written = 0

    def _as_shape(self, frames: th.Tensor) -> th.Tensor:
        """A view of frames in memory with the axes of their shape."""
        return frames.movedim(-1, -3) if self.is_image else frames

    def write(self, first_row: int, frames: np.ndarray) -> None:
        """
        :param first_row: First of the consecutive rows to write, all of them in the ring or all of them loose
        :param frames: Shape ``(rows, *frame shape)``
        """
        if first_row < self.n_ring:
            target = self.ring
            self.n_written = max(self.n_written, first_row + len(frames))
        else:
            target, first_row = self.loose, first_row - self.n_ring
        rows = self._as_shape(target[first_row : first_row + len(frames)])
        rows.copy_(to_device(th.from_numpy(np.ascontiguousarray(frames)), target.device))

    def copy_loose(self, source: int, target: int) -> None:
        """
        :param source: Loose row to copy from
        :param target: Loose row to copy to; the number of loose rows doubles if it is beyond the last
        """
        if target - self.n_ring >= len(self.loose):
            self.loose = th.cat([self.loose, th.zeros_like(self.loose)])
        self.loose[target - self.n_ring] = self.loose[source - self.n_ring]

    def gather(self, rows: np.ndarray) -> th.Tensor:
        """
        :param rows: Row numbers of any shape
        :return: New tensor of shape ``(*rows.shape, *frame shape)`` on the device of the frames
        """
        flat = rows.reshape(-1)
        is_loose = np.flatnonzero(flat >= self.n_ring)
        ring_rows = np.where(flat < self.n_ring, flat, 0)
        device = self.ring.device
        if device.type == "cpu":
            # numpy copies whole rows: faster than torch's index_select on uint8
            frames = th.from_numpy(self.ring.numpy()[ring_rows])
        else:
            frames = self.ring[to_device(th.from_numpy(ring_rows), device)]
        if len(is_loose) > 0:
            loose_rows = to_device(th.from_numpy(flat[is_loose] - self.n_ring), device)
            frames[to_device(th.from_numpy(is_loose), device)] = self.loose[loose_rows]
        return self._as_shape(frames.reshape(*rows.shape, *frames.shape[1:]))

    def in_ring(self) -> np.ndarray:
        """
        :return: Shape ``(rows of the ring, *frame shape)``; a view of the ring while that is not on a GPU
        """
        return self._as_shape(self.ring).cpu().numpy()

    def __getstate__(self) -> dict[str, Any]:
        # Rows that were written, in host memory: a buffer from a GPU can be read without one
        ring, loose = self.ring[: self.n_written].cpu().numpy(), self.loose.cpu().numpy()
        return dict(n_ring=self.n_ring, shape=self.shape, ring=ring, loose=loose, device=str(self.ring.device))

    def __setstate__(self, state: dict[str, Any]) -> None:
        device = th.device(state["device"] if th.cuda.is_available() else "cpu")
        written, loose = state["ring"], state["loose"]
        FrameStore.__init__(self, state["n_ring"], len(loose), state["shape"], written.dtype, device)
        self.n_written = len(written)
        self.ring[: self.n_written] = th.from_numpy(written)
        self.loose[:] = th.from_numpy(loose)


class SequenceReplayBuffer(NStepReplayBuffer):
    """
    Replay buffer for learning from pixels. Each frame is kept once, in its own type (uint8 for images), so that
    100 000 frames of 84x84 pixels take 2.1 GB; the frame after the last action of an episode is kept too, so that
    time limits bootstrap from the right frame (SB3's ``optimize_memory_usage`` cannot do that, SB3 #934).

    Samples are transitions (with n-step returns if ``n_steps > 1``) and, on request, the frames k steps later and k steps
    earlier and the window of the next K steps. None crosses the end of an episode, a reset or the write head.
    Indices are drawn from numpy's global generator, as in SB3.

    :param buffer_size: Number of transitions, of all environments together
    :param observation_space: Observation space, also ``Dict``
    :param action_space: Action space
    :param device: PyTorch device of the samples
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: No effect: each frame is always stored once
    :param handle_timeout_termination: Treat time limits as truncation instead of termination
    :param n_steps: Number of steps of the returns
    :param gamma: Discount factor of the n-step returns
    :param storage: Memory of the frames: ``"cpu"``, ``"cuda"``, or ``"auto"``: that of the GPU if the samples go there and the
        frames take no more than 40 % of its free memory
    :raises ValueError: If the frames do not fit into memory
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        n_steps: int = 1,
        gamma: float = 0.99,
        storage: str = "auto",
    ):
        # Not the parents' __init__, which allocate every frame twice
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.optimize_memory_usage = optimize_memory_usage
        self.handle_timeout_termination = handle_timeout_termination
        self.n_steps = n_steps
        self.gamma = gamma

        # Internally, any other space is a Dict with one entry
        self.is_dict = isinstance(observation_space, spaces.Dict)
        shapes: Any = self.obs_shape
        self._spaces: dict[str, Any] = (
            dict(observation_space.spaces) if isinstance(observation_space, spaces.Dict) else {"": observation_space}
        )
        self._shapes: dict[str, Any] = dict(shapes) if self.is_dict else {"": shapes}
        n_ring = self.buffer_size * n_envs
        storage_device = self._choose_storage(storage, n_ring)
        self._frames = {
            key: FrameStore(n_ring, 2 * n_envs, shape, self._spaces[key].dtype, storage_device)
            for key, shape in self._shapes.items()
        }
        size = (self.buffer_size, n_envs)
        self.actions = np.zeros((*size, self.action_dim), dtype=self._maybe_cast_dtype(action_space.dtype))
        self.rewards = np.zeros(size, dtype=np.float32)
        self.dones = np.zeros(size, dtype=np.float32)
        self.timeouts = np.zeros(size, dtype=np.float32)
        #: Whether the next slot of the environment belongs to another episode
        self.ended = np.zeros(size, dtype=bool)
        #: Row of the frame after the last action of an episode, -1 elsewhere
        self.last_rows = np.full(size, -1, dtype=np.int64)
        self._free_rows: list[int] = []
        self._n_loose = n_envs
        self._newest_obs: dict[str, np.ndarray] = {}

    def _choose_storage(self, storage: str, n_frames: int) -> th.device:
        if storage not in ("auto", "cpu", "cuda"):
            raise ValueError(f"storage must be 'auto', 'cpu' or 'cuda', not {storage!r}.")
        frame_bytes = sum(int(np.prod(shape)) * self._spaces[key].dtype.itemsize for key, shape in self._shapes.items())
        needed = n_frames * (frame_bytes + self.action_dim * 4 + 21)
        if storage == "cuda" and self.device.type != "cuda":
            raise ValueError("storage='cuda' needs a model on a CUDA device: use device='cuda', or storage='auto'.")
        free = free_memory(self.device)
        if free is not None and storage != "cpu" and (storage == "cuda" or needed <= 0.4 * free):
            self._check_memory(needed, free, n_frames, "GPU memory")
            return self.device
        self._check_memory(needed, available_memory(), n_frames, "memory")
        return th.device("cpu")

    def _check_memory(self, needed: int, available: int, n_frames: int, kind: str) -> None:
        if needed > available:
            raise ValueError(
                f"The replay buffer needs {needed / 2**30:.1f} GiB for {n_frames} frames, and {available / 2**30:.1f} GiB "
                f"of {kind} are available: use a buffer_size of at most {int(0.9 * n_frames * available / needed)}, "
                "or smaller images."
            )

    @property
    def observations(self) -> Any:  # type: ignore[override]  # an attribute in SB3
        """
        :return: o_t of every slot, shape ``(buffer_size, n_envs, ...)`` (a dict of them for ``Dict`` observations);
            a view of the buffer's memory while that is not on a GPU
        """
        size = (self.buffer_size, self.n_envs)
        views = {key: frames.in_ring().reshape(*size, *self._shapes[key]) for key, frames in self._frames.items()}
        return self._unwrap(views)

    def _wrap(self, obs: Any) -> dict[str, np.ndarray]:
        """
        Give every observation the form of a Dict observation, with the type and shape of the store.

        :raises ValueError: If an observation has another shape, or a type that cannot be cast without loss of its kind
        """
        parts = self._as_dict(obs)
        return {key: self._check(np.asarray(parts[key]), key) for key in self._shapes}

    def _check(self, part: np.ndarray, key: str) -> np.ndarray:
        space, shape = self._spaces[key], (self.n_envs, *self._shapes[key])
        if not isinstance(space, spaces.Box) and part.size == np.prod(shape):
            part = part.reshape(shape)  # Discrete: one number without an axis of its own, as in SB3
        if part.shape != shape or not np.can_cast(part.dtype, space.dtype, "same_kind"):
            name = f"the observation {key!r}" if key else "an observation"
            raise ValueError(
                f"{name} of shape {part.shape} and type {part.dtype} does not fit into a replay buffer for "
                f"{self.n_envs} environments with {space}: is there a wrapper that changes observations around VecNormalize, "
                "or a buffer of other environments?"
            )
        return part.astype(space.dtype)

    def _as_dict(self, observations: Any) -> dict[str, Any]:
        return observations if self.is_dict else {"": observations}

    def _unwrap(self, parts: dict[str, Any]) -> Any:
        return parts if self.is_dict else parts[""]

    def add(
        self,
        obs: Any,
        next_obs: Any,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        frames, next_frames = self._wrap(obs), self._wrap(next_obs)
        if self.size() > 0:
            self._end_interrupted_episodes(frames)
        for env in np.flatnonzero(self.last_rows[self.pos] >= 0):
            self._free_rows.append(int(self.last_rows[self.pos, env]))
        self.last_rows[self.pos] = -1

        for key, store in self._frames.items():
            store.write(self.pos * self.n_envs, frames[key])
            store.write(store.n_ring, next_frames[key])
        self._newest_obs = next_frames
        self.actions[self.pos] = action.reshape((self.n_envs, self.action_dim))
        self.rewards[self.pos] = reward
        self.dones[self.pos] = done
        if self.handle_timeout_termination:
            self.timeouts[self.pos] = np.array([info.get("TimeLimit.truncated", False) for info in infos]).reshape(-1)
        self.ended[self.pos] = False
        for env in np.flatnonzero(done):
            self._end_episode(self.pos, int(env))

        self.pos += 1
        if self.pos == self.buffer_size:
            self.full = True
            self.pos = 0

    def _end_interrupted_episodes(self, frames: dict[str, np.ndarray]) -> None:
        """An environment that does not continue from its newest frame was reset in between, for example by ``learn()``."""
        for env in np.flatnonzero(~self.ended[self.pos - 1]):
            if not all(np.array_equal(frames[key][env], self._newest_obs[key][env]) for key in frames):
                self._end_episode(self.pos - 1, int(env))

    def _end_episode(self, slot: int, env: int) -> None:
        """Keep the environment's newest frame as the last one of the episode that ends with this slot."""
        if self._free_rows:
            row = self._free_rows.pop()
        else:
            row = self.buffer_size * self.n_envs + self._n_loose
            self._n_loose += 1
        for store in self._frames.values():
            store.copy_loose(store.n_ring + env, row)
        self.last_rows[slot, env] = row
        self.ended[slot, env] = True

    def _next_rows(self, slots: np.ndarray, envs: np.ndarray) -> np.ndarray:
        """Rows of the frames that follow these slots."""
        rows = ((slots + 1) % self.buffer_size) * self.n_envs + envs
        rows = np.where(slots == (self.pos - 1) % self.buffer_size, self.buffer_size * self.n_envs + envs, rows)
        last_rows = self.last_rows[slots, envs]
        return np.where(last_rows >= 0, last_rows, rows)

    def _steps_left(self, slots: np.ndarray, envs: np.ndarray, max_steps: int) -> np.ndarray:
        """Number of stored steps from each slot to the end of its episode or to the newest slot, at most ``max_steps``."""
        steps = (slots[:, None] + np.arange(max_steps)) % self.buffer_size
        is_last = self.ended[steps, envs[:, None]] | (steps == (self.pos - 1) % self.buffer_size)
        return np.where(is_last.any(axis=1), is_last.argmax(axis=1) + 1, max_steps)

    def _steps_before(self, slots: np.ndarray, envs: np.ndarray, max_steps: int) -> np.ndarray:
        """Number of stored steps from the start of its episode or the oldest slot to each slot, at most ``max_steps``."""
        steps = (slots[:, None] - np.arange(max_steps)) % self.buffer_size
        oldest = self.pos if self.full else 0
        is_first = self.ended[steps - 1, envs[:, None]] | (steps == oldest)
        return np.where(is_first.any(axis=1), is_first.argmax(axis=1), max_steps)

    def sample(  # type: ignore[override]  # samples hold more than SB3's
        self,
        batch_size: int,
        env: VecNormalize | None = None,
        future: tuple[int, int] | None = None,
        past: tuple[int, int] | None = None,
        window: int = 0,
    ) -> SequenceSamples:
        """
        :param batch_size: Number of transitions, drawn uniformly with replacement
        :param env: Associated VecNormalize, to normalize observations and rewards
        :param future: Also sample the frame k steps later, with k drawn uniformly from this closed range; the last
            frame of the episode where it ends earlier
        :param past: Also sample the frame k steps earlier; the first frame of the episode where it begins later
        :param window: Also sample this number of following frames, and the actions and rewards before each of them
        :return: The samples, on ``device``
        """
        slots = np.random.randint(0, self.size(), size=batch_size)
        envs = np.random.randint(0, self.n_envs, size=batch_size)
        gaps, past_gaps = (
            None if limits is None else np.random.randint(limits[0], limits[1] + 1, size=batch_size)
            for limits in (future, past)
        )
        return self._samples(slots, envs, gaps, past_gaps, window, env)

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> Any:
        return self._samples(batch_inds, np.random.randint(0, self.n_envs, size=len(batch_inds)), None, None, 0, env)

    def _samples(
        self,
        slots: np.ndarray,
        envs: np.ndarray,
        gaps: np.ndarray | None,
        past_gaps: np.ndarray | None,
        window: int,
        env: VecNormalize | None,
    ) -> SequenceSamples:
        steps_left = self._steps_left(slots, envs, self.n_steps)
        last_slots = (slots + steps_left - 1) % self.buffer_size
        extra: dict[str, Any] = {}
        if self.n_steps > 1:
            extra["discounts"] = self.to_torch((self.gamma**steps_left).astype(np.float32)[:, None], copy=False)
        if gaps is not None:
            gaps = np.minimum(gaps, self._steps_left(slots, envs, int(gaps.max())))
            future_rows = self._next_rows((slots + gaps - 1) % self.buffer_size, envs)
            extra.update(future_observations=self._gather(future_rows, env), gaps=self.to_torch(gaps, copy=False))
        if past_gaps is not None:
            past_gaps = np.minimum(past_gaps, self._steps_before(slots, envs, int(past_gaps.max())))
            past_rows = (slots - past_gaps) % self.buffer_size * self.n_envs + envs
            extra.update(past_observations=self._gather(past_rows, env), past_gaps=self.to_torch(past_gaps, copy=False))
        if window > 0:
            extra.update(self._window(slots, envs, window, env))
        return SequenceSamples(
            observations=self._gather(slots * self.n_envs + envs, env),
            actions=self.to_torch(self.actions[slots, envs], copy=False),
            next_observations=self._gather(self._next_rows(last_slots, envs), env),
            # Only use dones that are not due to timeouts
            dones=self.to_torch((self.dones[last_slots, envs] * (1 - self.timeouts[last_slots, envs]))[:, None], copy=False),
            rewards=self.to_torch(self._returns(slots, envs, steps_left, env)[:, None], copy=False),
            **extra,
        )

    def _returns(self, slots: np.ndarray, envs: np.ndarray, steps_left: np.ndarray, env: VecNormalize | None) -> np.ndarray:
        """Discounted sums of the next ``n_steps`` rewards within the episode, shape ``(batch,)``."""
        steps = np.arange(self.n_steps)
        rewards = self.rewards[(slots[:, None] + steps) % self.buffer_size, envs[:, None]]
        discounts = (self.gamma**steps * (steps < steps_left[:, None])).astype(np.float32)
        return (self._normalize_reward(rewards, env) * discounts).sum(axis=1)

    def _window(self, slots: np.ndarray, envs: np.ndarray, length: int, env: VecNormalize | None) -> dict[str, Any]:
        """The next ``length`` frames, the actions and rewards before them, and which of them belong to the episode."""
        steps_left = self._steps_left(slots, envs, length)[:, None]
        steps = np.arange(length)
        window_slots = (slots[:, None] + np.minimum(steps, steps_left - 1)) % self.buffer_size
        window_envs = np.broadcast_to(envs[:, None], window_slots.shape)
        return dict(
            window_observations=self._gather(self._next_rows(window_slots, window_envs), env),
            window_actions=self.to_torch(self.actions[window_slots, window_envs], copy=False),
            window_rewards=self.to_torch(self._normalize_reward(self.rewards[window_slots, window_envs], env), copy=False),
            window_mask=self.to_torch((steps < steps_left).astype(np.float32), copy=False),
        )

    def to_torch(self, array: np.ndarray, copy: bool = True) -> th.Tensor:
        """
        :param array: Any array
        :param copy: Whether the tensor must not share the array's memory
        :return: The array on the device of the samples
        """
        return to_device(th.tensor(array) if copy else th.as_tensor(array), self.device)

    def _gather(self, rows: np.ndarray, env: VecNormalize | None) -> Observations:
        """Frames of these rows, normalized, on the device of the samples."""
        parts: dict[str, Any] = {key: store.gather(rows) for key, store in self._frames.items()}
        if env is not None:
            observations = self._normalize_obs(self._unwrap({key: part.cpu().numpy() for key, part in parts.items()}), env)
            parts = {key: th.as_tensor(part) for key, part in self._as_dict(observations).items()}
        return self._unwrap({key: to_device(part, self.device) for key, part in parts.items()})
