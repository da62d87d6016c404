"""A drawn cloth shows its side, hides what is behind it, and is hidden by what is in front. A shadow tells a height."""

import numpy as np
import pytest

from softbody_envs.painting import LIGHT, paint_shadows, paint_sheet
from softbody_envs.rendering import FLOOR_COLOR, Camera
from softbody_envs.sim.cloth import flat_grid
from softbody_envs.sim.world import Floor

FACE, UNDERSIDE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
SIZES = (64, 84, 128)
CAMERA = Camera(position=(0.0, -0.82, 0.82), target=(0.0, 0.0, 0.0))
ABOVE = Camera(position=(0.0, 0.0, 0.93), target=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
FLOOR = Floor(0.0, half_size=3.0)
NOWHERE = np.zeros((0, 3))


def paint(grid, size=84, camera=CAMERA, depth=1.0, centers=NOWHERE):
    frame = np.full((size, size, 3), 200, np.uint8)
    paint_sheet(frame, np.broadcast_to(np.float32(depth), (size, size)), camera, grid, FACE, UNDERSIDE, centers, 0.05)
    return frame


def shows(frame, channel):
    """Pixels of one of the two colours."""
    return (frame[..., channel] > 0) & (frame[..., (channel + 1) % 3] == 0) & (frame[..., (channel + 2) % 3] == 0)


def buffer_depth(distance, camera=CAMERA):
    """What a depth buffer holds for a distance in front of the camera."""
    return camera.far * (distance - camera.near) / (distance * (camera.far - camera.near))


def folded(length, width, yaw):
    grid = flat_grid(length, width, yaw)
    grid[: len(grid) // 2] = grid[: len(grid) // 2 : -1]
    return grid


@pytest.mark.parametrize("size", (*SIZES, 480))
def test_each_side_has_its_colour(size):
    above = paint(flat_grid(0.4, 0.5), size)
    below = paint(flat_grid(0.4, 0.5), size, Camera(position=(0.0, -0.82, -0.82), target=(0.0, 0.0, 0.0)))
    assert shows(above, 0).any() and not shows(above, 2).any()
    assert shows(below, 2).any() and not shows(below, 0).any()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("yaw", [-0.7, 0.0, 0.5])
def test_a_sheet_has_no_holes(size, yaw):
    cloth = shows(paint(flat_grid(0.5, 0.4, yaw), size), 0)
    assert 0.05 < cloth.mean() < 0.5
    for row in cloth:
        columns = np.flatnonzero(row)
        assert len(columns) == 0 or len(columns) == np.ptp(columns) + 1


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("yaw", [-0.7, 0.0, 0.5])
def test_a_fold_shows_the_underside_and_nothing_shines_through(size, yaw):
    frame = paint(folded(0.5, 0.4, yaw), size)
    face, underside = shows(frame, 0), shows(frame, 2)
    assert underside.sum() > 20 * face.sum()


def test_what_stands_in_front_hides_the_sheet_and_what_is_behind_does_not():
    depth = np.full((84, 84), buffer_depth(3.0), np.float32)
    depth[:, 42:] = buffer_depth(0.5)
    cloth = shows(paint(flat_grid(0.5, 0.5), depth=depth), 0)
    assert cloth[:, :42].any() and not cloth[:, 42:].any()


def test_light_and_shade_tell_slopes_apart():
    flat, tilted = flat_grid(0.4, 0.4), flat_grid(0.4, 0.4)
    tilted[..., 2] += 0.5 * tilted[..., 1]
    brightness = [frame[shows(frame, 0)][:, 0].mean() for frame in (paint(flat), paint(tilted))]
    assert abs(brightness[0] - brightness[1]) > 10


@pytest.mark.parametrize("shift", [(0.6, 0.0, 0.0), (0.0, -1.0, 1.0), (9.0, 9.0, 9.0)])
def test_a_sheet_may_leave_the_image(shift):
    frame = paint(flat_grid(0.5, 0.5) + np.array(shift))
    assert frame.shape == (84, 84, 3)


def shadow_on_sheet(center, slope=0.0):
    """Where a sphere of 5 cm makes a sheet darker, bool; the sheet rises along y."""
    grid = flat_grid(0.6, 0.6)
    grid[..., 2] += slope * grid[..., 1]
    bare, shaded = (paint(grid, 256, ABOVE, centers=centers) for centers in (NOWHERE, np.array([center])))
    return (shaded < bare).any(axis=-1)


@pytest.mark.parametrize("height", (0.06, 0.12))
def test_a_shadow_on_a_sheet_is_where_it_would_be_on_the_floor(height):
    center = (0.05, 0.0, height)
    on_floor, on_sheet = shadow(center), shadow_on_sheet(center)
    assert (on_floor & on_sheet).sum() > 0.95 * on_floor.sum()
    assert on_sheet.sum() < 1.1 * on_floor.sum()


def test_a_shadow_follows_the_sheet_and_spares_what_is_above_the_sphere():
    rows = [np.nonzero(shadow_on_sheet((0.0, 0.0, 0.15), slope))[0].mean() for slope in (0.0, 0.3)]
    assert rows[1] > rows[0] + 2  # the sheet rises toward it: it falls sooner
    assert not shadow_on_sheet((0.0, 0.0, -0.15)).any()


def shadow(center, radius=0.05, size=256, depth=1.0, floor=FLOOR):
    """Where a frame gets darker, bool."""
    frame = np.full((size, size, 3), FLOOR_COLOR, np.uint8)
    paint_shadows(frame, np.broadcast_to(np.float32(depth), (size, size)), ABOVE, floor, np.array([center]), radius)
    return (frame < FLOOR_COLOR).all(axis=-1)


@pytest.mark.parametrize("height", (0.05, 0.2))
def test_a_shadow_falls_away_from_the_light_by_the_height_of_the_sphere(height):
    rows, columns = np.nonzero(shadow((0.1, -0.05, height)))
    metres = 2 * 0.93 * np.tan(np.radians(45 / 2)) / 256  # that a pixel covers
    place = np.array([columns.mean() - 127.5, 127.5 - rows.mean()]) * metres
    assert place == pytest.approx(np.array([0.1, -0.05]) - height * LIGHT[:2] / LIGHT[2], abs=metres)
    # A disc, stretched by the slant of the light
    assert len(rows) * metres**2 == pytest.approx(np.pi * 0.05**2 / LIGHT[2], rel=0.03)


def test_a_shadow_falls_on_the_floor_alone():
    assert shadow((0.0, 0.0, 0.1)).any()
    assert not shadow((0.0, 0.0, 0.1), depth=0.5).any()  # a body is there
    assert not shadow((0.0, 0.0, 0.1), radius=0.03, floor=Floor(0.0, half_size=0.01)).any()


def test_shadows_of_several_spheres_are_drawn():
    frame = np.full((64, 64, 3), FLOOR_COLOR, np.uint8)
    centers = np.array([(-0.2, 0.0, 0.1), (0.2, 0.0, 0.1)])
    paint_shadows(frame, np.ones((64, 64), np.float32), ABOVE, FLOOR, centers, 0.03)
    assert (frame[:, :32] < FLOOR_COLOR).any() and (frame[:, 32:] < FLOOR_COLOR).any()
