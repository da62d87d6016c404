"""The window of ``render_mode="human"``."""

import os

import gymnasium as gym
import numpy as np


class Window:
    """
    Shows frames at a constant rate. pygame has one window per process: several environments share it.

    :param fps: frames per second
    :raises gymnasium.error.DependencyNotInstalled: if pygame is missing
    """

    def __init__(self, fps: float) -> None:
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            import pygame
        except ImportError as error:
            raise gym.error.DependencyNotInstalled('render_mode="human" needs pygame: pip install ".[human]"') from error
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
