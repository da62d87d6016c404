"""Turned batches show what a turned camera would have seen of turned actions."""

from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

import softbody_envs  # noqa: F401  (registers its ids)
from sb3_por import SACMRQ, SACPOR, SACSPR, VisualSAC
from sb3_por.common.errors import UserError
from sb3_por.evaluation import load_safe
from sb3_por.visual.replay_buffer import SequenceSamples
from sb3_por.visual.symmetries import ELEMENTS, _turn, _turn_pixels, check_planar, turned

PAIRS = [[0, 1], [4, 5]]


class Batch(NamedTuple):
    observations: th.Tensor
    next_observations: th.Tensor
    actions: th.Tensor


def red(image):
    """Centre of the red picker, right and up, in pixels."""
    rows, columns = np.nonzero((image[0] > 150) & (image[1] < 90) & (image[2] < 90))
    return np.array([columns.mean(), -rows.mean()])


def test_a_hand_moves_where_its_action_points_in_every_picture():
    env = gym.make("StraightenRope-v0", obs_type="pixels", image_size=64)
    before, _ = env.reset(options={"variation": 3})
    action = np.array([1.0, 0.5, 0.0, -1.0, 0.2, -0.6, 0.0, 1.0], np.float32)
    after, *_ = env.step(action)
    env.close()
    images = [th.from_numpy(image.transpose(2, 0, 1).copy()).expand(16, -1, -1, -1) for image in (before, after)]
    batch = turned(Batch(*images, th.from_numpy(action).expand(16, -1)), PAIRS)
    moves = [red(new) - red(old) for old, new in zip(batch.observations.numpy(), batch.next_observations.numpy(), strict=True)]
    expected = batch.actions[:, :2].numpy()
    scale = np.linalg.norm(moves[0]) / np.linalg.norm(expected[0])
    np.testing.assert_allclose(moves, scale * expected, atol=1.0)
    assert len({tuple(row) for row in batch.actions.tolist()}) == 8, "the symmetries of a square"
    rest = [2, 3, 6, 7]
    assert th.equal(batch.actions[:, rest], th.from_numpy(action[rest]).expand(16, -1))


def test_all_frames_and_actions_of_a_row_are_turned_alike():
    n = 24
    image = th.arange(9, dtype=th.uint8).reshape(1, 3, 3)
    arrow = th.tensor([0.0, 0.0, 1.0, 0.5])
    rows, window = image.expand(n, 1, 3, 3), image.expand(n, 2, 1, 3, 3)
    batch = SequenceSamples(
        observations={"one": rows, "other": rows},
        actions=arrow.expand(n, 4),
        next_observations=rows,
        dones=th.zeros(n, 1),
        rewards=th.zeros(n, 1),
        past_observations=rows,
        window_observations=window,
        window_actions=arrow.expand(n, 2, 4),
    )
    out = turned(batch, [[2, 3]])
    kinds = set()
    for i in range(n):
        frames = [
            *out.window_observations[i],
            out.past_observations[i],
            *(out.observations[key][i] for key in ("one", "other")),
        ]
        assert all(th.equal(frame, out.next_observations[i]) for frame in frames)
        assert all(th.equal(action, out.actions[i]) for action in out.window_actions[i])
        kinds.add((*out.next_observations[i].flatten().tolist(), *out.actions[i].tolist()))
    assert len(kinds) == 8 and len({kind[:9] for kind in kinds}) == 8 and len({kind[9:] for kind in kinds}) == 8
    assert out.future_observations is None and out.rewards is batch.rewards
    assert th.equal(batch.observations["one"], rows), "the batch itself stays"


@pytest.mark.parametrize("n", [1, 3, 8, 11])
def test_each_symmetry_is_as_frequent_as_the_others(n):
    images = th.zeros(n, 1, 2, 2)
    seen = []
    for _ in range(400):
        batch = turned(Batch(images, images, th.tensor([[1.0, 0.5]]).expand(n, -1)), [[0, 1]])
        seen += [tuple(row) for row in batch.actions.tolist()]
    counts = np.unique(seen, axis=0, return_counts=True)[1]
    assert len(counts) == 8 and counts.min() > 0.6 * len(seen) / 8


@pytest.mark.parametrize("shape", [(9, 3, 5, 5), (9, 2, 3, 5, 5)])
@pytest.mark.parametrize("dtype", [th.uint8, th.float32])
def test_pixels_are_turned_as_on_a_gpu(shape, dtype):
    frames = (255 * th.rand(shape)).to(dtype)
    blocks = [(slice(i, i + 2), *element) for i, element in enumerate(ELEMENTS)]
    channels_last = frames.movedim(-3, -1).contiguous().movedim(-1, -3)
    for one in (frames, channels_last):
        out = _turn_pixels(one, blocks)
        assert th.equal(out, _turn(one, blocks)) and out.stride() == channels_last.stride()


class Square(gym.Env):
    """A picture, and an action whose first and third elements point in it."""

    observation_space = spaces.Box(0, 255, (36, 36, 3), np.uint8)
    action_space = spaces.Box(-1, 1, (4,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


SMALL = {"buffer_size": 100, "learning_starts": 10, "batch_size": 16, "seed": 0}


@pytest.mark.parametrize("algorithm", [SACPOR, SACSPR, SACMRQ])
def test_algorithms_learn_from_turned_batches(algorithm, tmp_path):
    losses = {}
    for pairs in (None, [[0, 2]]):
        model = algorithm("CnnPolicy", gym.wrappers.TimeLimit(Square(), 20), planar_actions=pairs, **SMALL)
        model.learn(24)
        losses[str(pairs)] = float(next(model.critic.parameters()).sum())
    assert losses["None"] != losses["[[0, 2]]"]
    model.save(tmp_path / "model")
    assert algorithm.load(tmp_path / "model").planar_actions == [[0, 2]]
    assert load_safe(tmp_path / "model.zip").planar_actions == [[0, 2]]


def test_a_model_refuses_what_it_cannot_turn():
    with pytest.raises(UserError, match="only square images can be turned"):
        VisualSAC("MlpPolicy", gym.make("FoldCloth-v0", obs_type="state"), planar_actions=[[0, 1]])


IMAGE = spaces.Box(0, 255, (3, 36, 36), np.uint8)
ACTION = spaces.Box(-1, 1, (4,))


@pytest.mark.parametrize(
    "pairs", [[], [[0]], [[0, 1], [1, 2]], [[0, 4]], [[0, -1]], [0, 1], [["x", "y"]], [[0, 0]], [[True, 2]]]
)
def test_pairs_that_do_not_fit_are_refused(pairs):
    with pytest.raises(UserError, match="planar_actions must be pairs of different elements of an action, from 0 to 3"):
        check_planar(pairs, IMAGE, ACTION)


@pytest.mark.parametrize(
    "observations",
    [
        spaces.Box(-1, 1, (5,)),
        spaces.Box(0, 255, (3, 36, 40), np.uint8),
        spaces.Dict(image=IMAGE, state=spaces.Box(-1, 1, (5,))),
    ],
)
def test_what_is_not_a_square_image_is_refused(observations):
    with pytest.raises(UserError, match="only square images can be turned, and observations have the shape"):
        check_planar([[0, 1]], observations, ACTION)


def test_actions_that_would_leave_their_bounds_are_refused():
    with pytest.raises(UserError, match=r"turned, the elements \[0, 1\] of an action would leave their bounds"):
        check_planar([[0, 1]], IMAGE, spaces.Box(np.float32([-1, -2, -1, -1]), np.float32([1, 2, 1, 1])))
