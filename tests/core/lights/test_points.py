"""Suns and lamps taken out of a map as points, and what is no point."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relightcli.core.lights.latlong import texel_solid_angles
from relightcli.core.lights.points import MOST, row_light, split_points
from relightcli.core.sphere import cube
from tests.core.shade.skies import smooth_map


def flux_of(radiance):
    solid = texel_solid_angles(*radiance.shape[:2])
    return np.einsum("i,ijc->c", solid, radiance.astype(np.float64))


def direction_of(row, column, height, rotate=0.0):
    """The middle of a pixel, that halves its solid angle."""
    lat = math.asin((math.cos(math.pi * row / height) + math.cos(math.pi * (row + 1) / height)) / 2)
    lon = math.pi * (1 - (column + 0.5) / height) + math.radians(rotate)
    return np.array([math.sin(lon) * math.cos(lat), math.sin(lat), math.cos(lon) * math.cos(lat)])


@pytest.mark.parametrize(
    "sky",
    [
        np.ones((512, 1024, 3)),
        np.zeros((512, 1024, 3)),
        np.random.default_rng(0).random((256, 512, 3)),
        np.full((1, 1, 3), 1e6),
        # Pixels this large are no points, however bright.
        np.kron(smooth_map() ** 8, np.ones((4, 4, 1))),
    ],
    ids=["white", "black", "noise", "one pixel", "wide pixels"],
)
def test_nothing_to_take_out(sky):
    sky = sky.astype(np.float32)
    rest, points, taken = split_points(sky)
    assert rest is sky
    assert len(points.flux) == len(taken) == 0


@pytest.mark.parametrize("rotate", [0.0, 77.0])
def test_a_sun_of_one_pixel(rotate):
    sky = np.full((512, 1024, 3), 0.01, np.float32)
    sky[130, 700] = (9e4, 8e4, 5e4)
    rest, points, taken = split_points(sky, rotate)
    assert taken.tolist() == [130 * 1024 + 700]
    assert len(points.flux) == 9  # most of the flux: thrice thrice, of equal flux, in the pixel
    middle = points.direction.mean(axis=0)
    np.testing.assert_allclose(
        middle / np.linalg.norm(middle), direction_of(130, 700, 512, rotate), atol=2e-5
    )  # the mean latitude of equal parts is off by (pi / 512)^2 / 24 or so
    assert np.degrees(np.arccos((points.direction @ direction_of(130, 700, 512, rotate)).min())) < 0.35 / 3 * 1.5
    np.testing.assert_allclose(points.flux, np.tile(flux_of(sky) - flux_of(rest), (9, 1)) / 9, rtol=1e-9)
    np.testing.assert_allclose(points.flux.sum(0) + flux_of(rest), flux_of(sky), rtol=1e-12)
    assert rest[130, 700].max() == 0
    assert sky[130, 700, 0] == np.float32(9e4)


def test_a_sun_of_many_pixels_is_a_few_points():
    height = 2048
    row, column = np.mgrid[0:height, 0 : 2 * height]
    disc = (row - 600) ** 2 + ((column - 1000) * math.sin(math.pi * 600 / height)) ** 2 < 3.1**2  # half a degree wide
    sky = np.full((height, 2 * height, 3), 0.1, np.float32)
    sky[disc] = 1e5
    rest, points, taken = split_points(sky)
    assert 9 <= len(points.flux) <= 36  # in up to four texels of 0.35 degrees
    assert len(taken) >= 0.9 * disc.sum()
    np.testing.assert_allclose(points.flux.sum(0) + flux_of(rest), flux_of(sky), rtol=1e-9)
    mean = points.flux[:, 0] @ points.direction
    assert mean @ direction_of(600, 1000, height) / np.linalg.norm(mean) > 1 - 1e-6


def test_no_more_than_the_brightest_few_and_none_of_a_small_part():
    rng = np.random.default_rng(1)
    sky = np.zeros((512, 1024, 3), np.float32)
    where = rng.permutation(512 * 1024 // 64)[:60] * 64
    sky.reshape(-1, 3)[where[where // 1024 > 100][:40]] = 1.0
    _, points, _ = split_points(sky)
    assert MOST >= len(points.flux) > 10
    sky[:] = 1.0
    sky[200, 200] = 3000.0  # 0.7 % of all flux
    assert len(split_points(sky)[1].flux) == 0
    sky[200, 200] = 9000.0
    assert len(split_points(sky)[1].flux) == 1


@pytest.mark.parametrize("rotate", [0.0, 77.0, -400.0])
def test_points_turn_right_handed_about_y(rotate):
    sky = np.full((512, 1024, 3), 0.01, np.float32)
    sky[130, 700], sky[400, 100] = (9e4, 8e4, 5e4), (2e4, 9e4, 1e4)
    rest, still, taken = split_points(sky)
    turned_rest, turned, turned_taken = split_points(sky, rotate)
    c, s = math.cos(math.radians(rotate)), math.sin(math.radians(rotate))
    about_y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    np.testing.assert_array_equal(np.sort(taken), np.sort(turned_taken))
    np.testing.assert_array_equal(rest, turned_rest)
    # A turn may bring them into faces of another order.
    expected = still.direction @ about_y.T
    same = np.argmax(turned.direction @ expected.T, axis=0)
    assert len(set(same.tolist())) == len(expected) == len(turned.flux)
    np.testing.assert_allclose(turned.direction[same], expected, atol=1e-12)
    np.testing.assert_allclose(turned.flux[same], still.flux, rtol=1e-12)


def test_a_cloudy_sky_has_no_points():
    sky = np.kron(smooth_map() ** 3, np.ones((16, 16, 1))).astype(np.float32)
    rest, points, taken = split_points(sky, 30.0)
    assert rest is sky
    assert len(points.flux) == len(taken) == 0


def test_pixels_within_one_texel_of_a_small_part_are_one_point():
    height = 2048
    centre = cube.texel_directions(256)[4, 100, 60]  # texels of 4 pixels; the middle of one on +Z
    row = round(height * (0.5 - math.asin(centre[1]) / math.pi))
    column = round(height * (1 - math.atan2(centre[0], centre[2]) / math.pi))
    sky = np.full((height, 2 * height, 3), 0.01, np.float32)
    solid = texel_solid_angles(height, 2 * height)[row - 1 : row + 1]
    sky[:] = 2 * solid.sum() * 1.93e5 / 0.03 / (4 * math.pi)  # so that they have 3 % of the light
    sky[row - 1 : row + 1, column - 1 : column + 1] = (1e5, 2e5, 4e5)
    rest, points, taken = split_points(sky)
    assert len(points.flux) == 1
    assert len(taken) == 4
    np.testing.assert_allclose(points.flux[0], 2 * solid.sum() * np.array([1e5, 2e5, 4e5]), rtol=1e-12)
    each = [direction_of(row + i, column + j, height) * solid[i + 1] for i in (-1, 0) for j in (-1, 0)]
    mean = np.sum(each, axis=0)
    np.testing.assert_allclose(points.direction[0], mean / np.linalg.norm(mean), atol=1e-12)
    np.testing.assert_allclose(points.flux.sum(0) + flux_of(rest), flux_of(sky), rtol=1e-9)


def test_the_brightest_are_taken_where_there_are_too_many():
    height = 512
    rng = np.random.default_rng(4)
    sky = np.zeros((height, 2 * height, 3), np.float32)
    row, column = rng.integers(100, 400, 40), np.arange(40) * 25
    value = rng.uniform(0.6, 1.4, (40, 3))
    sky[row, column] = value
    rest, points, taken = split_points(sky)
    flux = texel_solid_angles(height, 2 * height)[row, None] * sky[row, column].astype(np.float64)
    luminance = flux @ [0.2126, 0.7152, 0.0722]
    assert luminance.min() > 0.011 * luminance.sum()
    best = np.argsort(-luminance)[:MOST]
    assert len(points.flux) == MOST
    assert set(taken.tolist()) == set((row * 2 * height + column)[best].tolist())
    np.testing.assert_allclose(np.sort(points.flux[:, 0]), np.sort(flux[best, 0]), rtol=1e-12)
    np.testing.assert_allclose(points.flux.sum(0) + flux_of(rest), flux_of(sky), rtol=1e-12)


@pytest.mark.parametrize("height", [512, 2048])
def test_a_sun_at_the_pole_keeps_all_flux(height):
    sky = np.full((height, 2 * height, 3), 1e-3, np.float32)
    sky[:1] = (1e5, 2e5, 3e5)
    rest, points, taken = split_points(sky, 12.0)
    np.testing.assert_allclose(points.flux.sum(0) + flux_of(rest), flux_of(sky), rtol=1e-9)
    changed = np.flatnonzero((rest != sky).any(axis=2))
    np.testing.assert_array_equal(np.sort(taken), changed)


def test_a_sun_in_the_zenith():
    sky = np.full((512, 1024, 3), 1e-3, np.float32)
    sky[0] = 1e5  # 1024 narrow pixels
    rest, points, _ = split_points(sky)
    assert points.flux.sum() > 0.99 * flux_of(sky).sum()
    np.testing.assert_allclose(points.flux.sum(0) + flux_of(rest), flux_of(sky), rtol=1e-9)


def test_light_of_the_rows_that_changed():
    rng = np.random.default_rng(6)
    sky = rng.random((256, 512, 3)).astype(np.float32)
    edited = sky.copy()
    edited[[3, 200], [70, 5]] = 400.0
    edited[9, 9] = 0.0
    found = row_light(edited, row_light(sky), np.array([3, 9, 200]))
    for part, whole in zip(found, row_light(edited), strict=True):
        np.testing.assert_array_equal(part, whole)
    for part, whole in zip(split_points(edited, 7.0, found), split_points(edited, 7.0), strict=True):
        np.testing.assert_equal(part, whole)
