"""PourWater and PourWaterAmount: the water stays where physics allows, the score is SoftGym's, the experts succeed."""

import gymnasium as gym
import numpy as np
import pytest

import softbody_envs
from softbody_envs.experts import make_expert
from softbody_envs.sim.cups import WALL, Cup, CupSize, corners, overlap
from softbody_envs.sim.water import DIAMETER, RADIUS, Water
from softbody_envs.sim.world import World
from softbody_envs.tasks.pour_water import MARGIN, REACH, SINK_DEPTH

#: For the long form of a test: minutes.
SOAK = (pytest.mark.slow, pytest.mark.timeout(3000))
WATER_ENVS = [env_id for env_id in softbody_envs.ENV_IDS if env_id.startswith("PourWater")]


def make(env_id="PourWater-v0", variation=0, **kwargs):
    env = gym.make(env_id, obs_type="state", **kwargs).unwrapped
    env.reset(options={"variation": variation})
    return env


class WaterAudit:
    """Follows every particle through every simulation step and counts those that pass a wall or a floor."""

    def __init__(self, env):
        self.env, self.violations = env, 0
        self._step = env.world.step
        env.world.step = self.step
        self._before = self._look()

    def _look(self):
        positions = self.env.water.positions()
        return positions, [(cup.local(positions), cup.contains(positions)) for cup in (self.env.cup, self.env.target)]

    def step(self):
        self._step()
        positions, now = self._look()
        assert np.isfinite(positions).all()
        # Fast particles dip into the floor for a step before it pushes them out; none may be under its surface as a whole.
        self.violations += int((positions[:, 2] < -SINK_DEPTH - RADIUS).sum())
        for cup, (_, was_inside), (local, inside), (local_before, _) in zip(
            (self.env.cup, self.env.target), self._before[1], now, self._before[1], strict=True
        ):
            # In one step of 8 ms nothing moves further than a particle's diameter against a cup: whoever goes in or out
            # must have been near the rim.
            below_rim = np.minimum(local[:, 2], local_before[:, 2]) < cup.size.outer_height - 2 * DIAMETER
            self.violations += int(((was_inside != inside) & below_rim).sum())
        self._before = positions, now


def play(env, episodes, act, first_variation=0):
    """Play whole episodes under audit; returns the number of violations and the normalized performances."""
    violations, scores = 0, []
    for variation in range(first_variation, first_variation + episodes):
        env.reset(options={"variation": variation})
        audit = WaterAudit(env)
        if hasattr(act, "reset"):
            act.reset()
        for _ in range(100):
            info = env.step(act.act(env.state()) if hasattr(act, "act") else act())[-1]
            counted = env.n_in_cup + env.n_in_target + env.n_spilled
            assert counted == len(env.water)
        del env.world.step  # the audit's; the class's own is back
        violations += audit.violations
        scores.append(info["normalized_performance"])
    return violations, scores


@pytest.mark.parametrize("episodes", [3, pytest.param(200, marks=SOAK)])
def test_no_particle_passes_a_wall_in_random_play(episodes):
    env = make()
    rng = np.random.default_rng(0)
    assert play(env, episodes, lambda: rng.uniform(-1, 1, 3))[0] == 0


@pytest.mark.parametrize("episodes", [3, pytest.param(200, marks=SOAK)])
def test_no_particle_passes_a_wall_when_the_expert_pours(episodes):
    assert play(make(), episodes, make_expert("PourWater-v0"))[0] == 0


@pytest.mark.parametrize("episodes", [6, pytest.param(50, marks=SOAK)])
@pytest.mark.parametrize("env_id", WATER_ENVS)
def test_expert_reaches_its_score_on_held_out_variations(env_id, episodes):
    _, scores = play(make(env_id), episodes, make_expert(env_id), first_variation=800)
    assert np.mean(scores) >= 0.9


def test_a_cup_moved_at_full_speed_keeps_its_water():
    env = make()
    for _ in range(4):
        env.step(np.array([0, 1, 0]))
    assert env.n_in_cup == len(env.water)


def test_without_its_velocity_the_moving_cup_launches_the_water(monkeypatch):
    env = make()
    monkeypatch.setattr(env.world.client, "resetBaseVelocity", lambda *args: None, raising=False)
    for _ in range(4):
        env.step(np.array([0, 1, 0]))
    assert env.n_in_cup < len(env.water)


def test_doing_nothing_scores_nothing():
    env = make()
    for _ in range(20):
        info = env.step(np.zeros(3))[-1]
    assert info["normalized_performance"] == 0.0


def test_a_cup_on_the_table_cannot_tilt():
    env = make()
    env.step(np.array([0, 0, 1]))
    assert (env.cup.x, env.cup.z, env.cup.angle) == (0.0, 0.0, 0.0)


def test_actions_move_the_cup_as_far_as_softgym_does():
    env = make()
    env.step(np.array([0, 1, 0]))
    env.step(np.array([-1, 0.5, 0.5]))
    np.testing.assert_allclose([env.cup.x, env.cup.z, env.cup.angle], np.array([-1, 1.5, 0.5]) * REACH)


def test_the_cup_stops_one_particle_before_the_target():
    env = make()
    for _ in range(20):
        env.step(np.array([1, 0, 0]))
    gap = (env.target.x - env.target.size.outer_length / 2) - (env.cup.x + env.cup.size.outer_length / 2)
    assert DIAMETER <= gap < DIAMETER + REACH[0] / env.steps_per_control
    assert MARGIN >= DIAMETER


@pytest.mark.parametrize("variation", range(0, 1000, 25))
def test_cups_never_start_within_reach_of_each_other(variation):
    env = make(variation=variation)
    assert env._allowed(np.zeros(3))
    assert env.n_in_cup == len(env.water)
    target = env.target.size
    assert target.length * target.width * target.height > len(env.water) * DIAMETER**3 / np.sqrt(2)


def test_reward_is_the_fraction_in_the_target_and_not_in_the_cup():
    world = World(10)
    world.clear()
    cup, target = (Cup(world, CupSize(0.2, 0.2, 0.2), x, (1, 1, 1, 1)) for x in (0.0, 0.5))
    water = Water(world, np.array([(0.0, 0, 0.1), (0.5, 0, 0.1), (0.55, 0.05, 0.1), (0.25, 0, 0.1)]))
    positions = water.positions()
    np.testing.assert_array_equal(cup.contains(positions), [True, False, False, False])
    np.testing.assert_array_equal(target.contains(positions), [False, True, True, False])
    env = make()
    env.cup, env.target, env.water = cup, target, water
    env._locate()
    assert env.performance() == env.reward() == env.monotone() == 0.5
    assert env.n_spilled == 1
    world.close()


def test_a_tilted_cup_knows_what_is_inside():
    world = World(10)
    world.clear()
    cup = Cup(world, CupSize(0.2, 0.2, 0.3), 0.0, (1, 1, 1, 1))
    cup.move(0.0, 0.0, np.pi / 2)  # the opening shows toward +x
    inside = np.array([(WALL + 0.15, 0.0, 0.0)])
    assert cup.contains(inside) and not cup.contains(inside + (0.3, 0, 0)) and not cup.contains(inside - (0.3, 0, 0))
    np.testing.assert_allclose(cup.local(inside), [[0.0, 0.0, WALL + 0.15]], atol=1e-12)
    world.close()


def test_outlines_that_touch_overlap_and_tilted_ones_are_told_apart():
    size = CupSize(0.2, 0.2, 0.2)
    square = corners(size, 0.0, 0.0, 0.0)
    width = size.outer_length
    assert overlap(square, corners(size, width, 0.0, 0.0))
    assert not overlap(square, corners(size, width + 1e-6, 0.0, 0.0))
    diagonal = corners(size, width + 0.05, 0.0, 0.5)
    assert not overlap(square, diagonal)
    assert overlap(square, diagonal - (0.07, 0.0))


def test_amount_is_drawn_for_each_variation_and_one_is_reachable():
    env = make("PourWaterAmount-v0")
    wanted = []
    for variation in range(12):
        _, info = env.reset(options={"variation": variation})
        assert info["normalized_performance"] == 0.0
        wanted.append(env.state()[-1])
        env.n_in_target = env.n_wanted
        assert env.normalized_performance() == 1.0
        env.n_in_target += 3
        assert env.performance() == pytest.approx(-3 / len(env.water))
    assert 0.15 <= min(wanted) and max(wanted) <= 1.0 and len(set(wanted)) > 8


def red_rows(env, size=64):
    image = env._image(size).astype(int)
    return ((image[..., 0] > 150) & (image[..., 1] < 60)).any(axis=1).sum()


def test_the_share_of_the_back_wall_that_is_red_tells_the_goal():
    env = make("PourWaterAmount-v0")
    seen, told = [], []
    for variation in range(800, 812):
        env.reset(options={"variation": variation})
        seen.append(red_rows(env) / env.target.size.height)
        told.append(env.state()[-1])
    assert np.corrcoef(seen, told)[0, 1] > 0.95
    assert max(told) - min(told) > 0.5


def test_the_wanted_water_rises_to_the_wanted_height_and_leaves_red_wall_above_it():
    env = make("PourWaterAmount-v0", variation=803)
    expert = make_expert("PourWaterAmount-v0")
    expert.reset()
    for _ in range(100):
        info = env.step(expert.act(env.state()))[-1]
    assert info["normalized_performance"] > 0.9
    inside = env.water.positions()[env.target.contains(env.water.positions())]
    surface = np.sort(inside[:, 2])[-5:].mean() + RADIUS
    assert abs(surface - env.wanted_height) < DIAMETER
    assert red_rows(env) > 0
