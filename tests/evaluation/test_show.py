"""``enjoy --human``: episodes in a window, here in SDL's window that nobody sees."""

import itertools
import sys
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
from toy_envs import DotEnv

import softbody_envs  # noqa: F401  (registers its ids)
from sb3_por.__main__ import main
from sb3_por.evaluation import evaluate
from sb3_por.evaluation.reference_policies import RandomModel
from sb3_por.evaluation.show import show_episodes
from softbody_envs.window import Window

pygame = pytest.importorskip("pygame", reason="pip install '.[human]'")
BALL = ["--model", "random", "--env", "FallingBall-v0"]


class WithImages(DotEnv):
    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 1000}

    def __init__(self, render_mode=None):
        super().__init__(obs_type="state")
        self.render_mode = render_mode

    def render(self):
        return np.full((16, 16, 3), self.t, np.uint8)


class WithoutImages(DotEnv):
    metadata: ClassVar = {"render_modes": []}

    def __init__(self, render_mode=None):
        super().__init__(obs_type="state")


@pytest.fixture(autouse=True)
def headless(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


@pytest.fixture
def own_ids():
    gym.register("Images-v0", WithImages)
    gym.register("NoImages-v0", WithoutImages)
    yield
    del gym.registry["Images-v0"], gym.registry["NoImages-v0"]


def assert_refused(capsys, message):
    (line,) = capsys.readouterr().err.splitlines()
    assert "error: " in line and message in line


def test_every_frame_of_the_episodes_is_shown_and_scored(monkeypatch, capsys):
    shown = []
    monkeypatch.setattr(Window, "show", lambda window, frame: shown.append(frame))
    assert main(["enjoy", *BALL, "--human", "-n", "2", "--size", "40"]) == 0
    assert "(2 episodes)" in capsys.readouterr().out
    assert {frame.shape for frame in shown} == {(40, 40, 3)}
    # The reset that opens the window, then two episodes, then the reset that follows the last one
    assert len(shown) == 1 + 2 * (1 + 50) + 1
    assert any((first != second).any() for first, second in itertools.pairwise(shown))


def test_the_scores_are_those_of_evaluate(monkeypatch):
    monkeypatch.setattr(Window, "show", lambda window, frame: None)
    model = RandomModel("FallingBall-v0")
    assert show_episodes(model, "FallingBall-v0") == evaluate(RandomModel("FallingBall-v0"), "FallingBall-v0", n_episodes=1)


def test_an_environment_that_has_images_alone_gets_a_window(own_ids, capsys):
    assert main(["enjoy", "--model", "random", "--env", "Images-v0", "--human"]) == 0
    assert "length 20" in capsys.readouterr().out
    assert not pygame.display.get_init(), "closed"


@pytest.mark.filterwarnings("ignore:.*render_mode")
def test_an_environment_without_images_is_refused(own_ids, capsys):
    assert main(["enjoy", "--model", "random", "--env", "NoImages-v0", "--human"]) == 2
    assert_refused(capsys, "NoImages-v0 has no window and no images")


@pytest.mark.parametrize("words", [[], ["--human", "-o", "video.gif"]])
def test_a_video_or_a_window_is_asked_for(words, capsys):
    assert main(["enjoy", *BALL, *words]) == 2
    assert_refused(capsys, "--human")


def test_without_pygame_one_line_names_the_extra(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pygame", None)
    assert main(["enjoy", *BALL, "--human"]) == 2
    assert_refused(capsys, 'pip install ".[human]"')


@pytest.mark.parametrize("env_id", ["FallingBall-v0", "Images-v0"])
@pytest.mark.skipif(sys.platform == "darwin", reason="a Mac always has a display")
def test_without_a_display_one_line_says_so(env_id, own_ids, monkeypatch, capsys):
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    pygame.display.quit()
    assert main(["enjoy", "--model", "random", "--env", env_id, "--human"]) == 2
    assert_refused(capsys, "needs a display")


def test_a_driver_that_cannot_be_opened_is_one_line(monkeypatch, capsys):
    monkeypatch.setenv("SDL_VIDEODRIVER", "no_such_driver")
    pygame.display.quit()
    assert main(["enjoy", *BALL, "--human"]) == 2
    assert_refused(capsys, "cannot open a window: no_such_driver not available")
