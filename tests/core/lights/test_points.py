"""Suns and lamps taken out of a map as points, and what is no point."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relightcli.core.lights.latlong import texel_solid_angles
from relightcli.core.lights.points import MOST, split_points
from tests.core.shade.skies import smooth_map


def flux_of(radiance):
    solid = texel_solid_angles(*radiance.shape[:2])
    return np.einsum("i,ijc->c", solid, radiance.astype(np.float64))


def direction_of(row, column, height, rotate=0.0):
    lat = math.pi * (0.5 - (row + 0.5) / height)
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
    np.testing.assert_allclose(points.direction, [direction_of(130, 700, 512, rotate)], atol=1e-12)
    np.testing.assert_allclose(points.flux + flux_of(rest), flux_of(sky)[None], rtol=1e-12)
    assert rest[130, 700].max() == 0
    assert sky[130, 700, 0] == np.float32(9e4)


def test_a_sun_of_many_pixels_is_a_few_points():
    height = 2048
    row, column = np.mgrid[0:height, 0 : 2 * height]
    disc = (row - 600) ** 2 + ((column - 1000) * math.sin(math.pi * 600 / height)) ** 2 < 3.1**2  # half a degree wide
    sky = np.full((height, 2 * height, 3), 0.1, np.float32)
    sky[disc] = 1e5
    rest, points, taken = split_points(sky)
    assert 1 <= len(points.flux) <= 6
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
