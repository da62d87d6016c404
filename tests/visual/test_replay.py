"""The sequence buffer against a naive list of episodes."""

import pickle

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_por.visual.replay_buffer import SequenceReplayBuffer

GAMMA = 0.9
BOX = spaces.Box(0, 255, (3, 8, 8), np.uint8)
DICT = spaces.Dict({"image": BOX, "state": spaces.Box(-np.inf, np.inf, (2,), np.float32)})
ACTION = spaces.Box(-1, 1, (2,), np.float32)


class NaiveBuffer:
    """Whole episodes as lists; a frame is a number. ``steps[env]`` holds (episode, t) of every transition, oldest first."""

    def __init__(self, n_envs):
        self.steps = [[] for _ in range(n_envs)]
        self.episodes = []

    def start(self, env, frame):
        self.episodes.append(dict(frames=[frame], actions=[], rewards=[], terminated=False))
        return len(self.episodes) - 1

    def add(self, env, episode, action, reward, frame, terminated):
        record = self.episodes[episode]
        self.steps[env].append((episode, len(record["actions"])))
        record["actions"].append(action)
        record["rewards"].append(reward)
        record["frames"].append(frame)
        record["terminated"] = terminated


def encode(frames, space):
    """Observations from frame numbers, one for each environment."""
    image = np.stack([np.full((3, 8, 8), frame % 251, np.uint8) for frame in frames])
    image[:, 0, 0, 0] = np.array(frames) // 251
    if isinstance(space, spaces.Dict):
        return {"image": image, "state": np.array([[frame, -frame] for frame in frames], np.float32)}
    return image


def decode(observations):
    """Frame numbers from (a batch of any shape of) observations."""
    if isinstance(observations, dict):
        numbers = decode(observations["image"])
        assert np.array_equal(numbers, observations["state"][..., 0].numpy())
        return numbers
    return observations[..., 1, 1, 1].numpy().astype(int) + 251 * observations[..., 0, 0, 0].numpy().astype(int)


def fill(buffer, space, n_steps, seed=0, interrupt=False):
    """Play random episodes into the buffer and the naive list: endings, time limits and, if asked, unannounced resets."""
    rng = np.random.default_rng(seed)
    naive = NaiveBuffer(buffer.n_envs)
    counter = 0

    def new_frame():
        nonlocal counter
        counter += 1
        return counter

    frames = [new_frame() for _ in range(buffer.n_envs)]
    episodes = [naive.start(env, frame) for env, frame in enumerate(frames)]
    for _ in range(n_steps):
        if interrupt and rng.random() < 0.1:
            frames = [new_frame() for _ in frames]
            episodes = [naive.start(env, frame) for env, frame in enumerate(frames)]
        next_frames = [new_frame() for _ in frames]
        actions = rng.uniform(-1, 1, (buffer.n_envs, 2)).astype(np.float32)
        rewards = rng.normal(size=buffer.n_envs).astype(np.float32)
        dones = rng.random(buffer.n_envs) < 0.2
        timeouts = dones & (rng.random(buffer.n_envs) < 0.5)
        infos = [{"TimeLimit.truncated": bool(timeout)} for timeout in timeouts]
        buffer.add(encode(frames, space), encode(next_frames, space), actions, rewards, dones, infos)
        for env in range(buffer.n_envs):
            terminated = bool(dones[env] and not timeouts[env])
            naive.add(env, episodes[env], actions[env], rewards[env], next_frames[env], terminated)
            frames[env] = next_frames[env]
            if dones[env]:
                frames[env] = new_frame()
                episodes[env] = naive.start(env, frames[env])
    stored = buffer.size()
    naive.steps = [steps[-stored:] for steps in naive.steps]
    return naive


def check(buffer, naive, batch_size=400, k=(1, 5), window=5):
    """Every sample of a large batch must be what the naive list says."""
    samples = buffer.sample(batch_size, future=k, past=k, window=window)
    where = {naive.episodes[e]["frames"][t]: (e, t) for steps in naive.steps for e, t in steps}
    first_stored = {}
    for e, t in where.values():
        first_stored[e] = min(t, first_stored.get(e, t))
    seen = set()
    for i, frame in enumerate(decode(samples.observations)):
        episode, t = where[frame]
        seen.add((episode, t))
        record = naive.episodes[episode]
        left = len(record["actions"]) - t
        n = min(buffer.n_steps, left)
        assert np.array_equal(samples.actions[i], record["actions"][t])
        assert decode(samples.next_observations)[i] == record["frames"][t + n]
        returns = sum(GAMMA**j * record["rewards"][t + j] for j in range(n))
        assert samples.rewards[i].item() == pytest.approx(returns, abs=1e-5)
        assert samples.dones[i].item() == float(record["terminated"] and n == left)
        if buffer.n_steps > 1:
            assert samples.discounts[i].item() == pytest.approx(GAMMA**n)
        gap = samples.gaps[i].item()
        assert gap == left if gap < k[0] else gap <= min(k[1], left)
        assert decode(samples.future_observations)[i] == record["frames"][t + gap]
        gap, stored_before = samples.past_gaps[i].item(), t - first_stored[episode]
        assert gap == stored_before if gap < k[0] else gap <= min(k[1], stored_before)
        assert decode(samples.past_observations)[i] == record["frames"][t - gap]
        m = min(window, left)
        assert samples.window_mask[i].tolist() == [1.0] * m + [0.0] * (window - m)
        assert decode(samples.window_observations)[i, :m].tolist() == record["frames"][t + 1 : t + m + 1]
        assert np.array_equal(samples.window_actions[i, :m], np.stack(record["actions"][t : t + m]))
        assert samples.window_rewards[i, :m].tolist() == pytest.approx(record["rewards"][t : t + m], abs=1e-5)
    return seen


@pytest.mark.parametrize("space", [BOX, DICT], ids=["box", "dict"])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("n_added", [5, 30, 100], ids=["part", "full", "wrapped"])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_samples_equal_a_naive_list(space, n_envs, n_added, n_steps):
    np.random.seed(0)
    buffer = SequenceReplayBuffer(30 * n_envs, space, ACTION, "cpu", n_envs, n_steps=n_steps, gamma=GAMMA)
    naive = fill(buffer, space, n_added)
    seen = check(buffer, naive)
    # Uniform: every stored transition turns up in 400 draws from at most 90
    assert len(seen) >= 0.9 * buffer.size() * n_envs


@pytest.mark.parametrize("k", [1, 2, 5])
def test_fixed_gap_is_shorter_only_at_the_end_of_an_episode(k):
    np.random.seed(0)
    buffer = SequenceReplayBuffer(60, BOX, ACTION, "cpu", 2, gamma=GAMMA)
    check(buffer, fill(buffer, BOX, 75), k=(k, k))


@pytest.mark.parametrize("space", [BOX, DICT], ids=["box", "dict"])
def test_windows_do_not_cross_a_reset_that_nobody_announced(space):
    np.random.seed(0)
    buffer = SequenceReplayBuffer(60, space, ACTION, "cpu", 2, gamma=GAMMA)
    check(buffer, fill(buffer, space, 100, interrupt=True))


def test_stays_right_at_every_position_of_the_write_head():
    for n_added in range(1, 25):
        np.random.seed(n_added)
        buffer = SequenceReplayBuffer(10, BOX, ACTION, "cpu", gamma=GAMMA)
        check(buffer, fill(buffer, BOX, n_added, seed=n_added), batch_size=60)


def test_rows_of_last_frames_are_reused():
    buffer = SequenceReplayBuffer(20, BOX, ACTION, "cpu", gamma=GAMMA)
    fill(buffer, BOX, 2000)
    assert len(buffer._frames[""].loose) <= 32


@pytest.mark.parametrize("n_added", [7, 50])
def test_pickled_buffer_goes_on_the_same(n_added):
    buffer = SequenceReplayBuffer(30, DICT, ACTION, "cpu", gamma=GAMMA)
    naive = fill(buffer, DICT, n_added)
    copy = pickle.loads(pickle.dumps(buffer))
    np.random.seed(0)
    check(copy, naive)
    for one in (buffer, copy):
        one.add(encode([1], DICT), encode([2], DICT), np.zeros((1, 2)), np.zeros(1), np.zeros(1, bool), [{}])
    np.random.seed(1)
    first = buffer.sample(64)
    np.random.seed(1)
    second = copy.sample(64)
    assert all(th.equal(first.observations[key], second.observations[key]) for key in DICT.spaces)
    assert th.equal(first.rewards, second.rewards)


def test_pickle_of_a_young_buffer_is_small():
    buffer = SequenceReplayBuffer(10_000, BOX, ACTION, "cpu")
    fill(buffer, BOX, 10)
    assert len(pickle.dumps(buffer)) < 10_000 * 192 / 2


def test_100k_frames_of_84_pixels_take_less_than_2200_mb():
    space = spaces.Box(0, 255, (3, 84, 84), np.uint8)
    buffer = SequenceReplayBuffer(100_000, space, ACTION, "cpu")
    arrays = [buffer.actions, buffer.rewards, buffer.dones, buffer.timeouts, buffer.ended, buffer.last_rows]
    frames = sum(store.ring.nbytes + store.loose.nbytes for store in buffer._frames.values())
    # Episodes of 75 steps or more: at most one frame more for each
    assert frames * (1 + 1 / 75) + sum(array.nbytes for array in arrays) <= 2.2e9


def test_refuses_what_does_not_fit_into_memory():
    space = spaces.Box(0, 255, (3, 128, 128), np.uint8)
    with pytest.raises(ValueError, match=r"needs [\d.]+ GiB for 1000000000 frames, and [\d.]+ GiB of memory are available"):
        SequenceReplayBuffer(1_000_000_000, space, ACTION, "cpu")


def test_gpu_storage_needs_a_gpu_model():
    with pytest.raises(ValueError, match="needs a model on a CUDA device"):
        SequenceReplayBuffer(10, BOX, ACTION, "cpu", storage="cuda")


def test_images_come_with_channels_last_in_memory_as_convolutions_want_them():
    buffer = SequenceReplayBuffer(20, BOX, ACTION, device="cpu")
    fill(buffer, BOX, 30)
    samples = buffer.sample(16, future=(1, 3), window=2)
    for images in (samples.observations, samples.next_observations, samples.future_observations):
        assert images.shape == (16, 3, 8, 8) and images.is_contiguous(memory_format=th.channels_last)
    assert samples.window_observations.flatten(0, 1).is_contiguous(memory_format=th.channels_last)
