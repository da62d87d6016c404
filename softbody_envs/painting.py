"""Drawing that Bullet's renderers lack: cloth with shaded folds and two colours, and shadows of spheres on the floor."""

from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline

from softbody_envs.rendering import FLOOR_COLOR, NOTHING, Camera, on_floor
from softbody_envs.sim.world import Floor

#: Direction toward the light, and the brightness of surfaces that face away from it.
LIGHT = np.array([-0.5, -1.5, 2.5]) / np.linalg.norm([-0.5, -1.5, 2.5])
AMBIENT = 0.5
#: Basis of the plane perpendicular to the light, as columns. Shadows are computed in this plane.
ACROSS_LIGHT = np.linalg.svd(LIGHT[None])[2][1:].T
#: Points per pixel along each direction of the sheet: enough to leave no pixel inside it empty.
DENSITY = 1.45
#: Depth offset of the sheet in front of what it lies on, and of its underside (turned up by a fold) in front of its face:
#: m, plus a multiple of the length that a pixel covers, since depth within a pixel varies that much on a slope.
CLEARANCE = 0.004
PIXELS_CLEARANCE = 1.5


def paint_sheet(
    frame: np.ndarray,
    depth: np.ndarray,
    camera: Camera,
    grid: np.ndarray,
    face: tuple[float, float, float],
    underside: tuple[float, float, float],
    centers: np.ndarray,
    radius: float,
) -> None:
    """
    Draw a cloth into an image: a smooth surface through its nodes, point by point, farthest first.

    Bullet never updates the normals of a cloth, so its renderers do not show folds (bullet3 6c888f4ab).

    :param frame: RGB image, uint8 ``(size, size, 3)``, modified in place
    :param depth: depth buffer of the image, float ``(size, size)`` in [0, 1]
    :param camera: camera of the image
    :param grid: nodes of the sheet, m, ``(rows, columns, 3)``
    :param face: colour of the side from which columns follow rows counterclockwise, RGB in [0, 1]
    :param underside: colour of the other side
    :param centers: centres of the spheres that cast shadows on the sheet, m, ``(n, 3)``
    :param radius: radius of the spheres, m
    """
    size = len(frame)
    points, normals = _surface(grid, camera, size)
    x, y, distance = _project(points, camera, size)
    toward_eye = np.asarray(camera.position) - points
    is_face = _dot(normals, toward_eye) > 0
    distance = distance - (CLEARANCE + PIXELS_CLEARANCE * distance / _focal(camera, size)) * np.where(is_face, 1, 2)

    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    shown = (distance > camera.near) & (column >= 0) & (column < size) & (row >= 0) & (row < size)
    pixel = np.where(shown, row * size + column, 0)
    shown &= distance < _distances(depth, camera).ravel()[pixel]

    farthest_first = np.flatnonzero(shown)[np.argsort(-distance[shown], kind="stable")]
    point_in = np.full(size * size, -1)
    point_in[pixel[farthest_first]] = farthest_first  # of several points in a pixel, the last one remains
    painted = np.flatnonzero(point_in >= 0)
    nearest = point_in[painted]

    points, normals, is_face = points[nearest], normals[nearest], is_face[nearest]
    lengths = np.maximum(np.sqrt(_dot(normals, normals)), 1e-12)  # creases have no normal
    facing_light = _dot(normals, LIGHT) * np.where(is_face, 1, -1) / lengths
    lit = np.clip(facing_light, 0, 1) * ~_shaded(points, centers, radius)
    brightness = AMBIENT + (1 - AMBIENT) * lit
    colors = np.where(is_face[:, None], face, underside) * brightness[:, None]
    frame.reshape(-1, 3)[painted] = np.round(255 * colors)


def _dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Dot products along the last axis, which has 3 elements: several times as fast as ``sum(axis=-1)``."""
    return first[..., 0] * second[..., 0] + first[..., 1] * second[..., 1] + first[..., 2] * second[..., 2]


def _shaded(points: np.ndarray, centers: np.ndarray, radius: float) -> np.ndarray:
    """Mask of the points that are in the shadow of a sphere, ``(n,)``."""
    shaded = np.zeros(len(points), dtype=bool)
    for center in centers:
        way = center - points
        x, y = (_dot(way, axis) for axis in ACROSS_LIGHT.T)
        shaded |= (x**2 + y**2 < radius**2) & (_dot(way, LIGHT) > 0)
    return shaded


def paint_shadows(
    frame: np.ndarray, depth: np.ndarray, camera: Camera, floor: Floor, centers: np.ndarray, radius: float
) -> None:
    """
    Draw the shadows of spheres on the floor. They show how high the spheres are, even to a camera above them.

    Bullet's own shadows take twice the time and need a visible floor body.

    :param frame: RGB image, uint8 ``(size, size, 3)``, modified in place
    :param depth: depth buffer of the image, float ``(size, size)`` in [0, 1]
    :param camera: camera of the image
    :param floor: floor that the shadows fall on
    :param centers: centres of the spheres, m, ``(n, 3)``
    :param radius: radius of the spheres, m
    """
    x, y, seen = _lit_floor(camera, len(frame), floor)
    shaded = np.zeros_like(seen)
    for center_x, center_y in centers @ ACROSS_LIGHT:
        shaded |= (x - center_x) ** 2 + (y - center_y) ** 2 < radius**2
    frame[shaded & seen & (depth >= NOTHING)] = round(AMBIENT * FLOOR_COLOR)


@lru_cache(maxsize=32)
def _lit_floor(camera: Camera, size: int, floor: Floor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both coordinates, m, of the floor behind the pixels, projected along the light, and the mask of the floor."""
    points, seen = on_floor(camera, size, floor)
    x, y = np.moveaxis(points @ ACROSS_LIGHT, -1, 0).copy()
    return x, y, seen


def _surface(grid: np.ndarray, camera: Camera, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the sheet, m, ``(n, 3)``, dense enough for the image, and their normals."""
    x, y, _ = _project(grid, camera, size)
    flat = np.stack([x, y], axis=-1)
    longest = max(np.linalg.norm(np.diff(flat, axis=axis), axis=-1).max() for axis in (0, 1))
    per_cell = int(np.clip(np.ceil(DENSITY * longest), 1, size // 4))  # a cell next to the camera needs no more
    (rows, along_rows), (columns, along_columns) = (_spline(n, per_cell) for n in grid.shape[:2])
    across = np.tensordot(columns, grid, (1, 1)).swapaxes(0, 1)
    points = np.tensordot(rows, across, 1)
    by_row = np.tensordot(along_rows, across, 1)
    by_column = np.tensordot(rows, np.tensordot(along_columns, grid, (1, 1)).swapaxes(0, 1), 1)
    return points.reshape(-1, 3), np.cross(by_row, by_column).reshape(-1, 3)


@lru_cache(maxsize=64)
def _spline(n: int, per_cell: int) -> tuple[np.ndarray, np.ndarray]:
    """Matrices ``(m, n)`` from values at ``n`` knots to the points and the slopes of the spline through them."""
    spline = CubicSpline(np.arange(n), np.eye(n), bc_type="natural")
    at = np.linspace(0, n - 1, (n - 1) * per_cell + 1)
    return spline(at), spline(at, 1)


def _project(points: np.ndarray, camera: Camera, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image coordinates in pixels, from the upper left, and the distance in front of the camera, m."""
    view = np.reshape(camera.view, (4, 4), order="F")
    x, y, z = np.moveaxis(points @ view[:3, :3].T + view[:3, 3], -1, 0)
    distance = np.maximum(-z, 1e-6)
    focal = _focal(camera, size)
    return size / 2 + focal * x / distance, size / 2 - focal * y / distance, -z


def _focal(camera: Camera, size: int) -> float:
    """Focal length in pixels."""
    return size / 2 / np.tan(np.radians(camera.fov) / 2)


def _distances(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Convert a depth buffer to distances in front of the camera, m."""
    return camera.near * camera.far / (camera.far - (camera.far - camera.near) * depth)
