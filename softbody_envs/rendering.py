"""Cameras and the two renderers: TinyRenderer (any machine) and EGL (a machine with a graphics driver)."""

import importlib.util
import struct
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pybullet

from softbody_envs.sim.world import Floor, World

RENDERERS = ("tiny", "egl")
FLOOR_COLOR, SKY_COLOR = 201, 255
#: Smallest depth of a pixel that shows no body.
NOTHING = 1 - 1e-6


@dataclass(frozen=True)
class Camera:
    """
    A fixed perspective camera with square images.

    :param position: position of the camera, m, z up
    :param target: point in the middle of the image, m
    :param fov: vertical field of view, degrees (SoftGym: 45)
    :param up: direction that points up in the image
    :param near: distance of the near clipping plane, m
    :param far: distance of the far clipping plane, m
    """

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float = 45.0
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    near: float = 0.05
    far: float = 10.0

    @property
    def view(self) -> tuple[float, ...]:
        """World-to-camera matrix, 16 numbers, column-major as in OpenGL."""
        return pybullet.computeViewMatrix(self.position, self.target, self.up)

    @property
    def projection(self) -> tuple[float, ...]:
        """Camera-to-clip-space matrix, 16 numbers, column-major."""
        return pybullet.computeProjectionMatrixFOV(self.fov, 1.0, self.near, self.far)


class Renderer:
    """
    Renders a world as seen by a camera.

    Images of the two kinds differ (bullet#2410): train and evaluate with the same kind.

    :param kind: ``"tiny"`` (software, deterministic) or ``"egl"`` (OpenGL without a display)
    """

    def __init__(self, kind: str = "tiny") -> None:
        if kind not in RENDERERS:
            raise ValueError(f"renderer must be one of {', '.join(RENDERERS)}, got {kind!r}")
        self.kind = kind
        self._flag = pybullet.ER_TINY_RENDERER if kind == "tiny" else pybullet.ER_BULLET_HARDWARE_OPENGL

    def attach(self, world: World) -> None:
        """Prepare a world that holds no bodies yet for rendering."""
        if self.kind == "egl":
            plugin = importlib.util.find_spec("eglRenderer")
            loaded = plugin is not None and world.client.loadPlugin(plugin.origin, "_eglRendererPlugin") >= 0
            if not loaded:
                raise RuntimeError('renderer="egl" needs an EGL driver, and this machine has none; use renderer="tiny"')

    def render(self, world: World, camera: Camera, size: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Render a frame. The floor comes from ``backdrop``: as a body it would take half the time of an 84-pixel frame.

        :return: new RGB frame, uint8 ``(size, size, 3)``, and depth buffer of the bodies, float32 ``(size, size)`` in
            [0, 1]
        """
        _, _, rgba, depth, _ = world.client.getCameraImage(
            size,
            size,
            camera.view,
            camera.projection,
            lightDirection=(-0.5, -1.5, 2.5),
            shadow=0,
            renderer=self._flag,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
        )
        if isinstance(rgba, tuple):  # a pybullet built without numpy; these two are ten times faster than np.asarray
            rgba = np.frombuffer(bytearray(rgba), np.uint8)
            depth = np.frombuffer(struct.Struct(f"{size * size}f").pack(*depth), np.float32)
        bodies = np.asarray(rgba, dtype=np.uint8).reshape(size, size, 4)
        depth = np.asarray(depth, dtype=np.float32).reshape(size, size)
        # Four channels in one number are chosen together, in half the time of three.
        chosen = np.where(depth < NOTHING, _as_numbers(bodies), _as_numbers(backdrop(camera, size, world.floor)))
        return np.ascontiguousarray(chosen.view(np.uint8).reshape(size, size, 4)[:, :, :3]), depth


def _as_numbers(rgba: np.ndarray) -> np.ndarray:
    """Pixels of an RGBA image, uint8 ``(height, width, 4)``, as uint32 ``(height, width)``."""
    return rgba.view(np.uint32)[:, :, 0]


@lru_cache(maxsize=32)
def backdrop(camera: Camera, size: int, floor: Floor | None) -> np.ndarray:
    """
    Return the image of a scene without bodies.

    :return: read-only RGBA image, uint8 ``(size, size, 4)``
    """
    image = np.full((size, size, 4), SKY_COLOR, np.uint8)
    if floor is not None:
        image[on_floor(camera, size, floor)[1], :3] = FLOOR_COLOR
    image.flags.writeable = False
    return image


@lru_cache(maxsize=32)
def on_floor(camera: Camera, size: int, floor: Floor) -> tuple[np.ndarray, np.ndarray]:
    """
    Intersect the rays of a camera's pixels with a floor.

    :return: points of the floor's plane behind the pixels, m, ``(size, size, 3)``, and the mask of those that lie on the
        floor in front of the camera, bool ``(size, size)``; both read-only
    """
    across = (2 * np.arange(size) + 1 - size) / size * np.tan(np.radians(camera.fov) / 2)
    right, up, back = np.reshape(camera.view, (4, 4), order="F")[:3, :3]
    rays = across[None, :, None] * right - across[:, None, None] * up - back
    with np.errstate(divide="ignore", invalid="ignore"):
        way = (floor.height - camera.position[2]) / rays[:, :, 2]
        points = camera.position + way[:, :, None] * rays
        seen = (way > 0) & (np.abs(points[:, :, :2]).max(axis=-1) <= floor.half_size)
    points.flags.writeable = seen.flags.writeable = False
    return points, seen
