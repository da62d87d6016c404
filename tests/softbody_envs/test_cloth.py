"""FoldCloth and DropFoldCloth: the cloth holds together, the score is what the pages say, the experts succeed."""

import pickle

import gymnasium as gym
import numpy as np
import pytest

from softbody_envs.experts import fold_cloth, make_expert
from softbody_envs.sim import cloth
from softbody_envs.sim.cloth import N_SIDE, TETHER
from softbody_envs.tasks.fold_cloth import GRASP_RANGE, N_HALF, PICKER_RADIUS

#: For the long form of a test: minutes.
SOAK = (pytest.mark.slow, pytest.mark.timeout(3000))

CLOTH_ENVS = ("FoldCloth-v0", "DropFoldCloth-v0")
EXPERT_SCORES = {"FoldCloth-v0": 0.90, "DropFoldCloth-v0": 0.80}
NOTHING = np.zeros(8)
HOLD = np.tile([0.0, 0.0, 0.0, 1.0], 2)


def make(env_id="FoldCloth-v0", variation=0, **kwargs):
    env = gym.make(env_id, **{"obs_type": "state"} | kwargs).unwrapped
    env.reset(options={"variation": variation})
    return env


def both(x=0.0, y=0.0, z=0.0, pick=-1.0):
    """The same action for both pickers."""
    return np.tile([x, y, z, pick], 2)


def play_expert(env_id, variations):
    """The experts' scores, and the largest mean and single stretch of the edges on the way."""
    env, expert = make(env_id), make_expert(env_id)
    scores, mean_stretch, max_stretch = [], 0.0, 0.0
    for variation in variations:
        env.reset(options={"variation": variation})
        expert.reset()
        for _ in range(100):
            *_, truncated, info = env.step(expert.act(env.state()))
            assert not truncated
            stretch = env.cloth.stretch()
            mean_stretch, max_stretch = max(mean_stretch, stretch.mean()), max(max_stretch, stretch.max())
        scores.append(info["normalized_performance"])
    env.close()
    return np.array(scores), mean_stretch, max_stretch


@pytest.mark.parametrize("episodes", [2, pytest.param(50, marks=SOAK)])
@pytest.mark.parametrize("env_id", CLOTH_ENVS)
def test_expert_folds_without_stretching_the_cloth(env_id, episodes):
    scores, mean_stretch, max_stretch = play_expert(env_id, range(800, 800 + episodes))
    print(f"{env_id}: mean {scores.mean():.3f}, min {scores.min():.3f}, stretch {mean_stretch:.3f}, {max_stretch:.3f}")
    assert scores.mean() >= EXPERT_SCORES[env_id]
    assert mean_stretch <= 1.05
    assert max_stretch <= 1.3


@pytest.mark.parametrize("episodes", [2, pytest.param(200, marks=SOAK)])
@pytest.mark.parametrize("env_id", CLOTH_ENVS)
def test_cloth_never_explodes_in_random_play(env_id, episodes):
    env, rng = make(env_id), np.random.default_rng(0)
    worst, scores = 0.0, []
    for episode in range(episodes):
        env.reset(options={"variation": episode})
        for step in range(100):
            # Every other episode: held and pulled one way for a second at full speed, the hardest that there is.
            if episode % 2 == 0 or step % 12 == 0:
                action = rng.uniform(-1, 1, 8)
            if episode % 2 == 1:
                action = np.sign(action)
                action[[3, 7]] = 1.0
            *_, truncated, info = env.step(action)
            assert not truncated, info
            worst = max(worst, env.cloth.stretch().max())
            assert env.cloth.nodes()[:, 2].min() > -0.03, "through the floor"
        scores.append(info["normalized_performance"])
    print(f"{env_id}: worst stretch {worst:.2f}, score of random play {np.mean(scores):.3f}")
    assert worst < cloth.MAX_STRETCH
    assert np.mean(scores) < 0.3


@pytest.mark.parametrize("policy", [NOTHING, HOLD])
def test_a_cloth_left_alone_scores_nothing(policy):
    env = make()
    for _ in range(30):
        info = env.step(policy)[-1]
    assert abs(info["normalized_performance"]) < 0.02


def test_a_cloth_held_still_in_the_air_scores_nothing():
    env = make("DropFoldCloth-v0")
    for _ in range(30):
        info = env.step(HOLD)[-1]
    assert abs(info["normalized_performance"]) < 0.03


@pytest.mark.slow
def test_letting_the_cloth_drop_scores_nothing_on_average():
    env = make("DropFoldCloth-v0")
    scores = []
    for variation in range(800, 850):
        env.reset(options={"variation": variation})
        for _ in range(40):
            info = env.step(NOTHING)[-1]
        scores.append(info["normalized_performance"])
    print(f"dropped: mean {np.mean(scores):.3f}, max {np.max(scores):.3f}")
    assert abs(np.mean(scores)) < 0.15
    assert np.max(scores) < 0.6


@pytest.mark.parametrize("env_id", CLOTH_ENVS)
def test_performance_is_the_formula_of_the_page(env_id):
    env = make(env_id)
    folded = env._grid.copy()
    folded[: -N_HALF - 1 : -1] = env._place
    folded[:N_HALF] = env._place
    env._grid = folded
    assert env.performance() == pytest.approx(0.0)
    assert env.normalized_performance() == pytest.approx(1.0)

    env._grid = folded + np.array([0.03, 0.0, 0.0])
    weight = {"FoldCloth-v0": 1.2, "DropFoldCloth-v0": 7.0}[env_id]
    assert env.performance() == pytest.approx(-weight * 0.03)
    assert env.monotone() == pytest.approx(0.0)

    env._grid = folded.copy()
    env._grid[:N_HALF, :, 2] += 0.05
    counts = env_id == "FoldCloth-v0"  # seen from above, DropFoldCloth's halves still lie on each other
    assert env.performance() == pytest.approx(-0.05 if counts else 0.0)
    assert env.monotone() == pytest.approx(-0.05)


def test_starting_states_are_those_of_the_pages():
    sizes, yaws, bottoms = [], [], []
    env, dropping = make(), make("DropFoldCloth-v0")
    for variation in range(0, 24):
        env.reset(options={"variation": variation})
        grid = env.cloth.grid()
        sides = grid[-1, 0] - grid[0, 0], grid[0, -1] - grid[0, 0]
        sizes += [np.linalg.norm(side) for side in sides]
        yaws.append(np.degrees(np.arctan2(sides[0][1], sides[0][0])))
        assert np.abs(grid.mean(axis=(0, 1))[:2]).max() < 0.01
        middle = (grid[0, 0] + grid[0, -1]) / 2
        expected = [middle + (0, -0.10, 0), middle + (0, 0.10, 0)]
        assert np.allclose(env.pickers.positions[:, :2], np.array(expected)[:, :2], atol=0.005)
        assert np.allclose(env.pickers.positions[:, 2], 0.10, atol=0.005)
        assert env.state()[18:20].tolist() == [0, 0]
    for variation in range(0, 6):
        dropping.reset(options={"variation": variation})
        bottoms.append(dropping.cloth.grid()[-1, :, 2].mean())
        assert dropping.state()[18:20].tolist() == [1, 1]
    assert 0.38 - 0.01 <= min(sizes) < 0.41 and 0.50 < max(sizes) <= 0.54 + 0.01
    assert -46 < min(yaws) < -20 and 20 < max(yaws) < 46
    assert 0.005 < min(bottoms) and max(bottoms) < 0.02 and np.ptp(bottoms) > 0.003


def test_state_tells_the_ways_of_pickers_and_corners_in_steps_of_a_picker():
    env = make()
    env.reset(options={"variation": 5})
    corners, pickers, ways = env.state()[:12].reshape(4, 3), env.pickers.positions, env.state()[20:]
    np.testing.assert_allclose(ways[:6].reshape(2, 3) * 0.08, corners[:2] - pickers, atol=1e-6)
    np.testing.assert_allclose(ways[6:].reshape(2, 3) * 0.08, corners[2:] - corners[:2], atol=1e-6)


def test_state_tells_how_the_hanging_cloth_runs_and_where_it_belongs():
    env = make("DropFoldCloth-v0")
    for _ in range(3):
        env.step(both(x=-1.0, pick=1.0))
    sides = env.state()[32:].reshape(2, 5, 3) * 0.08
    for side, column in enumerate((0, -1)):
        lower_place = env._place[0, column]
        np.testing.assert_allclose(sides[side] + lower_place, env._grid[[0, 2, 4, 6, 8], column], atol=1e-6)
    env._grid[: -N_HALF - 1 : -1] = env._place
    env._grid[:N_HALF] = env._place
    folded = env.state()[32:].reshape(2, 5, 3)
    np.testing.assert_allclose(folded[:, [0, -1]], 0.0, atol=1e-6)


def test_pickers_of_the_hanging_cloth_move_three_centimetres_a_step():
    env = make("DropFoldCloth-v0")
    before = env.pickers.positions.copy()
    env.step(both(x=-1.0, z=0.5, pick=1.0))
    np.testing.assert_allclose(env.pickers.positions - before, [[-0.03, 0.0, 0.015]] * 2, atol=1e-3)


def test_with_keep_hold_nothing_drops_the_cloth():
    assert make("DropFoldCloth-v0").keep_hold is False
    env = pickle.loads(pickle.dumps(make("DropFoldCloth-v0", keep_hold=True)))
    holding = make("DropFoldCloth-v0")
    env.reset(options={"variation": 0})
    action = both(x=-0.5, z=-0.2, pick=-1.0)
    for _ in range(10):
        state = env.step(action)[0]
        holding.step(both(x=-0.5, z=-0.2, pick=1.0))
    assert state[18:20].tolist() == [1, 1]
    assert (state == holding.state()).all()
    assert action[3] == action[7] == -1.0


def test_with_keep_hold_the_flat_cloth_can_be_folded_too(monkeypatch):
    # Taken as soon as it is in range, not from where the script would take it
    monkeypatch.setattr(fold_cloth, "GRASP_HEIGHT", 0.058)
    env = pickle.loads(pickle.dumps(make(keep_hold=True)))
    state, _ = env.reset(options={"variation": 0})
    expert = make_expert("FoldCloth-v0")
    for _ in range(100):
        action = expert.act(state)
        action[[3, 7]] = -1.0
        state, _, _, _, info = env.step(action)
    assert state[18:20].tolist() == [1, 1]
    assert info["normalized_performance"] > 0.8


def test_first_action_decides_whether_the_hanging_cloth_drops():
    env = make("DropFoldCloth-v0")
    top = env._grid[0, 0, 2]
    env.step(HOLD)
    assert env._grid[0, 0, 2] == pytest.approx(top, abs=0.005)
    env.reset(options={"variation": 0})
    for _ in range(20):
        env.step(NOTHING)
    assert env._grid[..., 2].max() < 0.2
    assert env.pickers.held == [None, None]


def test_picker_takes_the_nearest_node_in_range_carries_it_and_lets_it_go():
    env = make()
    for _ in range(5):  # down: out of range at first
        env.step(both(pick=1.0) if env.pickers.positions[0, 2] > 0.09 else NOTHING)
    assert env.pickers.held == [None, None]
    env.step(both(z=-1.0))
    positions, nodes = env.pickers.positions.copy(), env.cloth.nodes()
    assert positions[:, 2] == pytest.approx(PICKER_RADIUS, abs=0.003)
    distances = np.linalg.norm(nodes - positions[:, None], axis=2)
    env.step(both(pick=1.0))
    assert env.pickers.held == distances.argmin(axis=1).tolist()
    assert distances.min(axis=1).max() <= GRASP_RANGE
    for _ in range(3):
        env.step(both(z=1.0, pick=1.0))
    held = env.cloth.nodes()[env.pickers.held]
    assert held[:, 2].min() > 0.2
    assert np.allclose(held - env.pickers.positions, nodes[env.pickers.held] - positions, atol=0.01)
    for _ in range(15):
        env.step(NOTHING)
    assert env.cloth.nodes()[:, 2].max() < 0.1


def test_two_pickers_never_hold_the_same_node():
    env = make()
    down = both(z=-1.0)
    together = np.array([0, 1, 0, -1, 0, -1, 0, -1.0])
    for action in (together, together * 0.25, down, both(pick=1.0)):
        env.step(action)
    first, second = env.pickers.held
    assert first is not None and first != second


def test_pickers_cannot_tear_the_cloth_apart():
    env = make("DropFoldCloth-v0")
    width = np.linalg.norm(env._grid[0, 0] - env._grid[0, -1])
    for _ in range(20):
        env.step(np.array([0, -1, 0, 1, 0, 1, 0, 1.0]))
    apart = np.linalg.norm(env._grid[0, 0] - env._grid[0, -1])
    assert width < apart < 1.02 * TETHER * width
    assert env.cloth.stretch().max() < 1.6


def test_a_cloth_at_rest_does_not_fall_asleep():
    env = make()
    for _ in range(40):  # 3.2 s; Bullet's bodies sleep after 2
        env.step(NOTHING)
    env.step(both(z=-1.0))
    for _ in range(4):
        env.step(both(z=1.0, pick=1.0))
    assert env.cloth.nodes()[:, 2].max() > 0.2


def test_a_swinging_cloth_comes_to_rest():
    env = make("DropFoldCloth-v0")
    for _ in range(4):
        env.step(both(x=1.0, pick=1.0))
    moves = []
    for _ in range(40):
        before = env.cloth.nodes()
        env.step(HOLD)
        moves.append(np.abs(env.cloth.nodes() - before).max())
    assert max(moves[:5]) > 0.03
    assert max(moves[-5:]) < 0.01


def test_an_explosion_ends_the_episode_and_the_next_one_starts_afresh(monkeypatch):
    env = make(variation=3)
    fresh = env.state()
    monkeypatch.setattr(cloth, "STIFFNESS", 100 * cloth.STIFFNESS)
    env.reset(options={"variation": 3})
    for _ in range(100):
        observation, reward, terminated, truncated, info = env.step(both(z=-1.0, pick=1.0))
        if truncated:
            break
    assert truncated and not terminated
    assert "exploded" in info["sim_error"]
    assert np.isfinite(observation).all() and np.isfinite(reward) and np.isfinite(info["normalized_performance"])
    monkeypatch.undo()
    env.reset(options={"variation": 3})
    assert (env.state() == fresh).all()


def test_mesh_has_every_node_and_only_short_edges():
    nodes = cloth.flat_grid(0.4, 0.5).reshape(-1, 3)
    edges = cloth._edges()
    assert len(edges) == 2 * N_SIDE * (N_SIDE - 1) + (N_SIDE - 1) ** 2
    assert set(edges.ravel()) == set(range(N_SIDE**2))
    lengths = np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)
    assert lengths.max() <= np.hypot(0.4, 0.5) / (N_SIDE - 1) + 1e-9
    for corner in (0, N_SIDE - 1, N_SIDE * (N_SIDE - 1), N_SIDE**2 - 1):
        assert (edges == corner).sum() == 3, "each corner hangs on a diagonal, too"


def test_the_image_tells_how_high_a_picker_is():
    env = gym.make("FoldCloth-v0", obs_type="pixels", image_size=84).unwrapped
    env.reset(options={"variation": 0})
    up = np.array([0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 1.0, -1.0])
    env.step(up)

    def on_cloth():
        red, green, blue = env._image(84).astype(int).transpose(2, 0, 1)
        dark = (red > 2 * green) & (blue > green) & (red < 150)  # the shaded face
        return np.argwhere(dark).mean(axis=0) if dark.any() else None

    places = []
    for _ in range(3):
        env.step(up)
        places.append(on_cloth())
    env.close()
    assert all(place is not None for place in places)
    assert min(np.linalg.norm(np.diff(places, axis=0), axis=1)) > 1
