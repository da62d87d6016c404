"""The window of ``render_mode="human"``."""

import os
from typing import Any

import gymnasium as gym
import numpy as np


def check_display(pygame: Any) -> None:
    """
    Check that a window of pygame can be seen. Without a display, SDL draws into memory and reports nothing.

    :param pygame: The module
    :raises gymnasium.error.Error: If there is no display, unless ``SDL_VIDEODRIVER`` asks for none
    """
    try:
        pygame.display.init()
        seen = pygame.display.get_driver() not in ("offscreen", "dummy") or "SDL_VIDEODRIVER" in os.environ
    except pygame.error as error:
        raise gym.error.Error(f'render_mode="human" cannot open a window: {error}') from error
    if not seen:
        pygame.display.quit()
        raise gym.error.Error('render_mode="human" needs a display; render_mode="rgb_array" works without one')


class Window:
    """
    Shows frames at a constant rate. pygame has one window per process: several environments share it.

    :param fps: frames per second
    :raises gymnasium.error.DependencyNotInstalled: if pygame is missing
    :raises gymnasium.error.Error: if there is no display
    """

    def __init__(self, fps: float) -> None:
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            import pygame
        except ImportError as error:
            raise gym.error.DependencyNotInstalled('render_mode="human" needs pygame: pip install ".[human]"') from error
        check_display(pygame)
        self._pygame = pygame
        self._clock = pygame.time.Clock()
        self._fps = fps

    def show(self, frame: np.ndarray) -> None:
        """
        Draw a frame after the previous one has been visible for its full time.

        :param frame: RGB, uint8 ``(height, width, 3)``
        """
        display = self._pygame.display
        screen, size = display.get_surface(), frame.shape[1::-1]
        if screen is None or screen.get_size() != size:
            display.init()
            screen = display.set_mode(size)
        self._clock.tick(self._fps)
        self._pygame.surfarray.blit_array(screen, frame.swapaxes(0, 1))
        self._pygame.event.pump()  # otherwise the desktop reports that the window does not respond
        display.flip()

    def close(self) -> None:
        """Close the window. The next frame opens it again."""
        self._pygame.display.quit()
