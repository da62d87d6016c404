"""``render_mode="human"``, in SDL's window that nobody sees."""

import sys
import time

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import softbody_envs  # noqa: F401  (registers its ids)
from softbody_envs.sim.world import CONTROL_PERIOD
from softbody_envs.tasks.falling_ball import FallingBallEnv
from softbody_envs.wrappers import ActionRepeat

pygame = pytest.importorskip("pygame", reason="pip install '.[human]'")
ID = "FallingBall-v0"


@pytest.fixture(autouse=True)
def headless(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


def shown():
    """The image in the window, ``(height, width, 3)``."""
    return pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)


def picture(env):
    return env.unwrapped._image(env.unwrapped.render_size)


@pytest.mark.parametrize("wrapper", [lambda env: env, lambda env: ActionRepeat(env, repeat=3)])
def test_every_reset_and_step_is_shown(wrapper):
    env = wrapper(gym.make(ID, obs_type="state", render_mode="human", render_size=60))
    env.reset(seed=0)
    first = shown()
    np.testing.assert_array_equal(first, picture(env))
    for _ in range(3):
        env.step(np.ones(1, np.float32))
        np.testing.assert_array_equal(shown(), picture(env))
    assert (shown() != first).any()
    assert env.render() is None
    env.close()
    assert pygame.display.get_surface() is None
    env.reset()  # opens it again
    np.testing.assert_array_equal(shown(), picture(env))
    env.close()


def test_time_in_the_window_passes_as_in_the_world():
    env = FallingBallEnv(obs_type="state", render_mode="human", render_size=36)
    env.reset(seed=0)
    start = time.perf_counter()
    for _ in range(8):
        env.step(np.zeros(1))
    assert 7 * CONTROL_PERIOD <= time.perf_counter() - start <= 20 * CONTROL_PERIOD
    env.close()


def test_a_failed_simulation_leaves_the_window_open_and_black(monkeypatch):
    env = FallingBallEnv(obs_type="state", render_mode="human", render_size=36)
    env.reset(seed=0)
    monkeypatch.setattr(env, "fault", lambda: "exploded")
    assert env.step(np.zeros(1))[4]["sim_error"] == "exploded"
    assert not shown().any()
    env.close()


def test_two_environments_share_the_window():
    large, small = (FallingBallEnv(obs_type="state", render_mode="human", render_size=size) for size in (60, 36))
    for env in (large, small, large):
        env.reset(seed=0)
        np.testing.assert_array_equal(shown(), picture(env))
    small.close()
    large.step(np.zeros(1))
    np.testing.assert_array_equal(shown(), picture(large))
    large.close()


@pytest.mark.filterwarnings("error")
def test_checker_has_no_complaint():
    check_env(gym.make(ID, obs_type="state", image_size=36, render_mode="human", render_size=36).unwrapped)


def test_without_pygame_one_line_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(gym.error.DependencyNotInstalled, match=r"pip install \"\.\[human\]\""):
        gym.make(ID, render_mode="human")
    gym.make(ID, render_mode="rgb_array").close()
