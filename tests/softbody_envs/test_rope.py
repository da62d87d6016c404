"""StraightenRope: the rope keeps its length and never explodes, pickers hold what they should, the expert succeeds."""

from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest

from softbody_envs.experts import make_expert
from softbody_envs.painting import AMBIENT
from softbody_envs.rendering import FLOOR_COLOR
from softbody_envs.sim import rope_bank
from softbody_envs.sim.pickers import Pickers
from softbody_envs.sim.rope import LENGTH, N_NODES, RADIUS, SPACING, STEPS_PER_CONTROL, Rope, end_distance, failure, length
from softbody_envs.sim.world import World
from softbody_envs.tasks.straighten_rope import GRASP_RANGE, HIGH, KEY_NODES, LOW, PICKER_RADIUS

HORIZON = 75
IDLE = np.array([0.0, 0.0, 0.0, -1.0] * 2)


@pytest.fixture
def env():
    env = gym.make("StraightenRope-v0", obs_type="state", split="eval").unwrapped
    yield env
    env.close()


@pytest.fixture
def scene():
    """A straight rope along x from -0.25 to 0.25 m, and two pickers."""
    world = World(STEPS_PER_CONTROL)
    world.clear()
    world.add_floor()
    nodes = np.linspace(-LENGTH / 2, LENGTH / 2, N_NODES)[:, None] * (1.0, 0.0, 0.0) + (0.0, 0.0, RADIUS)
    rope = Rope(world, nodes)
    pickers = Pickers(world, rope, np.array([(-0.25, 0, 0.04), (0.25, 0, 0.04)]), LOW, HIGH, PICKER_RADIUS, GRASP_RANGE)
    yield world, rope, pickers
    world.close()


class RopeAudit:
    """Measures the rope after every simulation step."""

    def __init__(self, env):
        self.env = env
        self.shortest, self.longest, self.highest = np.inf, 0.0, 0.0
        self._step = env.world.step
        env.world.step = self.step

    def step(self):
        self._step()
        nodes = self.env.rope.nodes()
        relative = length(nodes) / LENGTH
        self.shortest, self.longest = min(self.shortest, relative), max(self.longest, relative)
        self.highest = max(self.highest, nodes[:, 2].max())


class Random:
    """Uniform actions."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)

    def act(self, state):
        return self.rng.uniform(-1, 1, 8)


class Jerk(Random):
    """Takes both ends, then moves both pickers at full speed along every axis and turns about every ``every`` steps."""

    def __init__(self, seed, every, opposite=False):
        super().__init__(seed)
        self.every, self.opposite = every, opposite
        self.expert = make_expert("StraightenRope-v0")
        self.expert.reset()
        self.steps = 0

    def act(self, state):
        if self.steps == 0 and not (state[36:] > 0.5).all():
            return self.expert.act(state)
        if self.steps % self.every == 0:
            self.action = np.sign(self.rng.uniform(-1, 1, 8))
            if self.opposite:
                self.action[4:7] = -self.action[:3]
            self.action[[3, 7]] = 1.0
        self.steps += 1
        return self.action


class Expert(Jerk):
    """The scripted expert."""

    def __init__(self, seed):
        super().__init__(seed, 1)

    def act(self, state):
        return self.expert.act(state)


POLICIES = {
    "expert": Expert,
    "random": Random,
    "turning every step": lambda seed: Jerk(seed, 1),
    "turning every other step": lambda seed: Jerk(seed, 2),
    "turning every sixth step": lambda seed: Jerk(seed, 6),
    "pulling apart": lambda seed: Jerk(seed, 5, opposite=True),
}


def audited(env, policy, variations):
    """Play whole episodes; returns the extremes of the rope's length, relative to what it should be, and its height."""
    shortest, longest, highest = np.inf, 0.0, 0.0
    for variation in variations:
        state, _ = env.reset(options={"variation": variation})
        audit, player = RopeAudit(env), POLICIES[policy](variation)
        for _ in range(HORIZON):
            state, _, _, truncated, _ = env.step(player.act(state))
            assert not truncated
        env.close()  # the audit goes with its world
        shortest, longest, highest = min(shortest, audit.shortest), max(longest, audit.longest), max(highest, audit.highest)
    return shortest, longest, highest


def assert_sound(shortest, longest, highest):
    assert shortest >= 0.95
    assert longest <= 1.05
    assert highest <= HIGH[2] + LENGTH


@pytest.mark.parametrize("policy", POLICIES)
def test_rope_keeps_its_length_at_every_simulation_step(env, policy):
    assert_sound(*audited(env, policy, [800]))


@pytest.mark.slow
@pytest.mark.timeout(3000)
@pytest.mark.parametrize("policy", POLICIES)
def test_rope_keeps_its_length_over_many_episodes(env, policy):
    extremes = audited(env, policy, range(800, 840))
    print(policy, *(f"{x:.4f}" for x in extremes))
    assert_sound(*extremes)


def final_scores(env, act, variations):
    scores = []
    for variation in variations:
        state, info = env.reset(options={"variation": variation})
        player = act(variation)
        for _ in range(HORIZON):
            state, _, _, _, info = env.step(player.act(state))
        scores.append(info["normalized_performance"])
    return scores


def test_expert_straightens_held_out_ropes(env):
    scores = final_scores(env, Expert, range(990, 995))
    assert np.mean(scores) >= 0.95
    assert env._info()["is_success"]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_expert_straightens_fifty_held_out_ropes(env):
    assert np.mean(final_scores(env, Expert, range(800, 850))) >= 0.95


def test_doing_nothing_scores_zero_and_random_play_little(env):
    class Idle:
        def act(self, state):
            return IDLE

    assert abs(np.mean(final_scores(env, lambda _: Idle(), range(800, 802)))) <= 0.03
    assert np.mean(final_scores(env, Random, range(800, 803))) <= 0.6


def test_score_is_the_distance_of_the_ends_from_the_length_of_the_rope(env):
    state, info = env.reset(options={"variation": 900})
    start = np.linalg.norm(state[27:30] - state[:3])
    assert info["normalized_performance"] == 0.0
    for _ in range(5):
        state, reward, _, _, info = env.step(make_action_of_expert(env))
    distance = np.linalg.norm(state[27:30] - state[:3])
    assert info["monotone"] == pytest.approx(distance, abs=1e-6)
    assert reward == info["performance"] == pytest.approx(-abs(distance - 0.5), abs=1e-6)
    assert info["normalized_performance"] == pytest.approx(1 - abs(distance - 0.5) / abs(start - 0.5), abs=1e-5)


def make_action_of_expert(env):
    expert = make_expert("StraightenRope-v0")
    expert.reset()
    return expert.act(env.state())


def test_state_holds_the_key_nodes_the_pickers_and_what_they_hold(env):
    env.reset(options={"variation": 7})
    while env.pickers.held == [None, None]:
        env.step(make_action_of_expert(env))
    state = env.state()
    np.testing.assert_allclose(state[:30].reshape(10, 3), env.rope.nodes()[list(KEY_NODES)], atol=1e-6)
    np.testing.assert_allclose(state[30:36].reshape(2, 3), env.pickers.positions, atol=1e-6)
    assert state[36:38].tolist() == [float(node is not None) for node in env.pickers.held]
    for picker, reaches in enumerate(state[38:].reshape(2, 2, 3)):  # in steps of a picker
        ends = env.rope.nodes()[[0, -1]]
        np.testing.assert_allclose(reaches * 0.08, ends - env.pickers.positions[picker], atol=1e-6)


def test_with_keep_hold_the_pickers_take_the_rope_and_never_let_go():
    env = gym.make("StraightenRope-v0", obs_type="state", keep_hold=True).unwrapped
    env.reset(options={"variation": 0})
    assert env.pickers.held == [None, None]
    expert = make_expert("StraightenRope-v0")
    for _ in range(20):
        env.step(expert.act(env.state()) * [1, 1, 1, 0, 1, 1, 1, 0])
    held = list(env.pickers.held)
    assert None not in held
    for x in (1.0, -1.0):
        for _ in range(3):
            env.step(np.array([x, 0.0, 0.2, -1.0, -x, 0.0, 0.2, -1.0]))
    assert env.pickers.held == held


def test_rope_parts_do_not_pass_through_each_other(env):
    closest = np.inf
    state, _ = env.reset(options={"variation": 810})
    player = Jerk(0, 3)
    for _ in range(40):
        state, *_ = env.step(player.act(state))
        nodes = env.rope.nodes()
        centres = (nodes[1:] + nodes[:-1]) / 2
        distances = np.linalg.norm(centres[:, None] - centres[None], axis=2)
        closest = min(closest, distances[np.triu_indices(len(centres), 2)].min())
    assert closest >= 0.75 * 2 * RADIUS


def test_failed_simulation_ends_the_episode_and_the_next_one_is_sound(env):
    env.reset(options={"variation": 0})
    env.world.client.resetBasePositionAndOrientation(env.rope._segments[5], (5.0, 0.0, 1.0), (0, 0, 0, 1))
    _, _, terminated, truncated, info = env.step(IDLE)
    assert truncated and not terminated
    assert "rope" in info["sim_error"]
    with pytest.raises(gym.error.ResetNeeded):
        env.step(IDLE)
    env.reset(options={"variation": 0})
    _, _, _, truncated, info = env.step(IDLE)
    assert not truncated and "sim_error" not in info


def test_a_failed_simulation_repeats_what_was_last_sound_and_draws_black():
    env = gym.make("StraightenRope-v0", obs_type="state", render_mode="rgb_array", render_size=32).unwrapped
    env.reset(options={"variation": 0})
    state, reward, _, _, info = env.step(IDLE)
    kept = state.copy()
    state[:], info["performance"] = 7.0, 7.0  # ours to change
    env.world.client.resetBasePositionAndOrientation(env.rope._segments[5], (5.0, 0.0, 1.0), (0, 0, 0, 1))
    repeated, again, _, truncated, last = env.step(IDLE)
    assert truncated and again == reward and last["performance"] != 7.0
    np.testing.assert_array_equal(repeated, kept)
    assert env.render().shape == (32, 32, 3) and not env.render().any()
    env.reset()
    assert env.render().any()
    env.close()


def test_failure_names_what_is_wrong():
    nodes = np.linspace(0.0, LENGTH, N_NODES)[:, None] * (1.0, 0.0, 0.0)
    assert failure(nodes) is None
    assert "long" in failure(nodes * 1.3)
    assert "left" in failure(nodes + 3.0)
    assert "left" in failure(nodes * np.nan)


# -- pickers -----------------------------------------------------------------------------------------------------------


def act(*pairs):
    """An action of ``(dx, dy, dz, pick)`` for each picker."""
    return np.array([*pairs[0], *pairs[1]], dtype=float)


def test_picker_takes_the_nearest_node_and_lets_it_go(scene):
    _, rope, pickers = scene
    pickers.control(act((0, 0, 0, -1), (0, 0, 0, 1)))
    assert pickers.held == [None, N_NODES - 1]
    pickers.control(act((0, 0, 0, 1), (0, 0, 0, 0)))
    assert pickers.held == [0, None]
    for _ in range(2):
        pickers.control(act((0, 0, 1, 1), (0, 0, 1, -1)))
    nodes = rope.nodes()
    assert nodes[0, 2] > 0.10
    assert nodes[-1, 2] < 0.03
    for _ in range(6):
        pickers.control(act((0, 0, 0, -1), (0, 0, 0, -1)))
    assert rope.nodes()[0, 2] < 0.03


def test_picker_out_of_range_takes_nothing_until_it_comes_near(scene):
    _, _, pickers = scene
    pickers.control(act((0, 0, 1, -1), (0, 0, 1, -1)))
    pickers.control(act((0, 0, 0, 1), (0, 0, 0, 1)))
    assert pickers.held == [None, None]
    pickers.control(act((0, 0, -1, 1), (0, 0, -1, -1)))
    assert pickers.held == [0, None]


def test_two_pickers_never_hold_the_same_node(scene):
    _, _, pickers = scene
    for _ in range(4):
        pickers.control(act((1, 0, 0, -1), (-1, 0, 0, -1)))
    pickers.control(act((0, 0, 0, 1), (0, 0, 0, 1)))
    first, second = pickers.held
    assert None not in (first, second)
    assert first != second


def test_pickers_stay_in_their_box(scene):
    _, _, pickers = scene
    for corner in (LOW, HIGH):
        move = np.sign(corner)
        move[2] = 1.0 if corner is HIGH else -1.0
        for _ in range(9):
            pickers.control(act((*move, -1), (*move, -1)))
        np.testing.assert_allclose(pickers.positions, [corner, corner], atol=1e-6)


def test_empty_picker_goes_exactly_where_it_is_sent(scene):
    _, _, pickers = scene
    before = pickers.positions.copy()
    pickers.control(act((0.5, -0.25, 1.0, -1), (-1.0, 1.0, 0.25, -1)))
    np.testing.assert_allclose(pickers.positions - before, [(0.04, -0.02, 0.08), (-0.08, 0.08, 0.02)], atol=1e-6)


def test_one_picker_can_lift_the_whole_rope_and_hold_it(scene):
    _, rope, pickers = scene
    for step in range(12):
        pickers.control(act((0.3 if step < 8 else 0, 0, 0.25 if step < 8 else 0, 1), (0, 0, 1, -1)))
    assert rope.nodes()[0, 2] > HIGH[2] - 0.05 - 0.02
    assert np.linalg.norm(rope.nodes()[0] - pickers.positions[0]) <= GRASP_RANGE


def test_two_pickers_cannot_pull_the_rope_longer(scene):
    _, rope, pickers = scene
    for _ in range(10):
        pickers.control(act((-1, 0, 0, 1), (1, 0, 0, 1)))
    assert pickers.held == [0, N_NODES - 1]
    assert end_distance(rope.nodes()) == pytest.approx(LENGTH, rel=0.01)
    assert length(rope.nodes()) == pytest.approx(LENGTH, rel=0.01)


# -- where episodes start ----------------------------------------------------------------------------------------------


def test_every_start_is_a_whole_rope_within_reach_that_shows_its_ends():
    for variation in range(1000):
        nodes = rope_bank.crumpled(variation, np.random.default_rng(variation))
        steps = np.array([np.linalg.norm(b - a) for a, b in pairwise(nodes)])
        np.testing.assert_allclose(steps, SPACING, rtol=0.02)
        assert end_distance(nodes) <= rope_bank.MAX_END_DISTANCE + 1e-4
        assert (np.abs(nodes[:, :2]) <= HIGH[:2]).all()
        assert nodes[:, 2].min() > -0.005
        assert rope_bank._shows_its_ends(nodes)


def test_bank_is_small():
    assert rope_bank.PATH.stat().st_size < 500_000


def test_every_variation_has_a_rope_of_its_own_and_draws_how_it_lies():
    shapes = rope_bank._bank()
    assert len(np.unique(shapes.reshape(len(shapes), -1), axis=0)) == len(shapes) == 1000
    starts = [rope_bank.crumpled(800, np.random.default_rng(seed)) for seed in range(8)]
    assert all(not np.allclose(a, b) for a, b in pairwise(starts))
    ends = np.array([end_distance(nodes) for nodes in starts])
    np.testing.assert_allclose(ends, ends[0])


def test_rope_is_at_rest_at_the_start(env):
    for variation in (3, 421, 999):
        env.reset(options={"variation": variation})
        before = env.rope.nodes()
        env.step(IDLE)
        assert np.abs(env.rope.nodes() - before).max() < 2e-3


def test_recipe_of_the_bank_makes_good_starts():
    world = World(STEPS_PER_CONTROL)
    rng = np.random.default_rng(5)
    while (nodes := rope_bank.crumple(world, rng)) is None:
        pass
    world.close()
    assert length(nodes) == pytest.approx(LENGTH, rel=0.01)
    assert end_distance(nodes) <= rope_bank.MAX_END_DISTANCE
    assert np.linalg.norm(nodes[:, :2], axis=1).max() <= rope_bank.MAX_EXTENT


def test_image_shows_both_pickers_wherever_they_are_and_tells_the_ends_apart():
    env = gym.make("StraightenRope-v0", obs_type="pixels", image_size=64).unwrapped
    image, _ = env.reset(options={"variation": 12})
    for move in ((1, 1, 1), (-1, -1, 1), (1, -1, -1)):
        for _ in range(9):
            image, *_ = env.step(np.array([*move, -1, *(-np.array(move[:2])), move[2], -1.0]))
        red, green, blue = image.astype(int).transpose(2, 0, 1)
        assert ((red > green + 60) & (red > blue + 60)).sum() >= 4
        assert ((green > red + 40) & (green > blue + 40)).sum() >= 4
    # The pickers are in two corners
    yellow, magenta = (red > blue + 60) & (green > blue + 60), (red > green + 60) & (blue > green + 60)
    assert yellow.sum() >= 3 and magenta.sum() >= 3
    env.close()


def test_the_image_tells_how_high_a_picker_is():
    env = gym.make("StraightenRope-v0", obs_type="pixels", image_size=84).unwrapped
    env.reset(options={"variation": 0})

    def shadow_rows():
        gray = np.isclose(env._image(84), round(AMBIENT * FLOOR_COLOR)).all(axis=-1)
        return np.nonzero(gray)[0].mean()  # the light comes from below in the image: the higher, the farther up

    aside = np.array([1.0, 0.0, 0.0, -1.0] * 2)
    for _ in range(4):
        env.step(aside)
    rows = []
    for _ in range(3):
        rows.append(shadow_rows())
        env.step(np.array([0.0, 0.0, -0.4, -1.0] * 2))
    env.close()
    assert rows[0] + 1 < rows[1] and rows[1] + 1 < rows[2]
