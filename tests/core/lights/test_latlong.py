"""Look-up and importance sampling of latitude-longitude environments."""

import math

import numpy as np
import pytest
from numba import njit
from scipy import stats

from relightcli.core.lights.latlong import (
    LUMINANCE,
    direction_density,
    lookup_many,
    make_latlong,
    sample,
    texel_of,
    texel_solid_angles,
)


@njit
def sample_many(env, u):
    d = np.empty((len(u), 3))
    rgb = np.empty((len(u), 3))
    density = np.empty(len(u))
    texel = np.empty(len(u), np.int64)
    for k in range(len(u)):
        direction, radiance, density[k] = sample(env, u[k, 0], u[k, 1])
        d[k, 0], d[k, 1], d[k, 2] = direction
        rgb[k, 0], rgb[k, 1], rgb[k, 2] = radiance
        i, j = texel_of(env.radiance.shape[0], env.radiance.shape[1], env.rotation, direction)
        texel[k] = i * env.radiance.shape[1] + j
    return d, rgb, density, texel


def texel_centres(height, width):
    lon = math.pi * (1 - 2 * (np.arange(width) + 0.5) / width)
    lat = math.pi * (0.5 - (np.arange(height) + 0.5) / height)
    lon, lat = np.meshgrid(lon, lat)
    return np.stack([np.sin(lon) * np.cos(lat), np.sin(lat), np.cos(lon) * np.cos(lat)], -1)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 7), (2, 4), (513, 3), (2048, 4096)])
def test_solid_angles_fill_the_sphere(height, width):
    # A sum of `height` float64 terms: rounding below height * 2^-53.
    assert texel_solid_angles(height, width).sum() * width == pytest.approx(4 * math.pi, rel=1e-12)


def test_solid_angles_are_the_difference_of_sines():
    lat = math.pi * (0.5 - np.arange(9) / 8)
    expected = (np.sin(lat[:-1]) - np.sin(lat[1:])) * 2 * math.pi / 5
    np.testing.assert_allclose(texel_solid_angles(8, 5), expected, rtol=1e-14)


@pytest.mark.parametrize(
    ("direction", "row", "column"),
    # +Z is the middle of the image, +X a quarter of the width left of it, -X right, -Z the vertical edge.
    [([1e-9, 0.1, 1], 3, 7), ([1, 0.1, -1e-9], 3, 3), ([-1, -0.1, 1e-9], 4, 11), ([1e-9, 0.1, -1], 3, 0)],
)
def test_convention(direction, row, column):
    assert texel_of(8, 16, 0.0, tuple(direction)) == (row, column)


def test_lookup_returns_the_texel_at_its_centre():
    pixels = np.random.default_rng(1).random((6, 12, 3), np.float32)
    np.testing.assert_array_equal(lookup_many(make_latlong(pixels), texel_centres(6, 12)), pixels)


def test_poles_and_any_length_are_inside_the_map():
    pixels = np.random.default_rng(1).random((6, 12, 3), np.float32)
    out = lookup_many(make_latlong(pixels), np.array([[0, 1, 0], [0, -1, 0], [0, 1e-200, 1e-201], [-0.0, 0, -1.0]]))
    assert (out[0] == pixels[0]).all(-1).any()
    assert (out[1] == pixels[5]).all(-1).any()
    assert (out[3] == pixels[3]).all(-1).any()


@pytest.mark.parametrize("degrees", [30.0, -90.0, 360.0, 725.0])
def test_rotation_is_right_handed_about_y(degrees):
    pixels = np.random.default_rng(2).random((8, 12, 3), np.float32)
    d = np.random.default_rng(3).normal(size=(1000, 3))
    a = math.radians(degrees)
    # Ry(-D) d
    turned = np.stack(
        [math.cos(a) * d[:, 0] - math.sin(a) * d[:, 2], d[:, 1], math.sin(a) * d[:, 0] + math.cos(a) * d[:, 2]], -1
    )
    rotated = lookup_many(make_latlong(pixels, degrees), d)
    np.testing.assert_array_equal(rotated, lookup_many(make_latlong(pixels), turned))


def test_whole_turns_change_nothing():
    assert make_latlong(np.ones((2, 4, 3)), 360.0).rotation == 0.0


@pytest.mark.parametrize(("degrees", "compensated"), [(0.0, False), (77.0, False), (30.0, True)])
def test_samples_follow_luminance_times_solid_angle(degrees, compensated):
    rng = np.random.default_rng(4)
    pixels = rng.random((5, 9, 3)) ** 4
    pixels[2] = 0
    pixels[:, 4] = 0
    env = make_latlong(pixels, degrees, compensated)
    n = 1_000_000
    _, _, density, texel = sample_many(env, rng.random((n, 2)))
    weight, omega = pixels.astype(np.float32) @ LUMINANCE, texel_solid_angles(5, 9)[:, None]
    if compensated:
        weight = np.maximum(weight - (weight * omega).sum() / (4 * math.pi), 0)
    p = (weight * omega).ravel()
    expected = n * p / p.sum()
    seen = np.bincount(texel, minlength=45).astype(float)
    assert seen[expected == 0].sum() == 0
    used = expected > 5
    statistic = (((seen - expected) ** 2)[used] / expected[used]).sum()
    # Chi-square test of a sampler at significance 0.01.
    assert stats.chi2.sf(statistic, used.sum() - 1) > 0.01
    np.testing.assert_allclose(density, (p / p.sum() / np.repeat(texel_solid_angles(5, 9), 9))[texel], rtol=1e-5)


def test_samples_are_uniform_within_a_texel():
    env = make_latlong(np.ones((1, 1, 3)), compensated=False)
    d, _, density, _ = sample_many(env, np.random.default_rng(5).random((200_000, 2)))
    np.testing.assert_allclose(density, 1 / (4 * math.pi), rtol=1e-12)
    # Archimedes: the height of a uniform point on the sphere is uniform in [-1, 1], about any axis.
    for axis in range(3):
        assert stats.kstest(d[:, axis], stats.uniform(-1, 2).cdf).pvalue > 0.01
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, rtol=1e-12)


def test_one_texel_sun_leaves_the_sky_its_share():
    pixels = np.full((64, 128, 3), 1e-3)
    pixels[10, 20] = 1e6
    env = make_latlong(pixels, compensated=False)
    n = 1 << 20
    u = (np.arange(n) + 0.5) / n
    omega = texel_solid_angles(64, 128)
    sky = 1e-3 * (4 * math.pi - omega[10])
    share = sky / (sky + 1e6 * omega[10])
    # Widths of the two-level bins outside the sun's texel, from the sums themselves.
    rows = np.diff(env.row_cdf)
    in_sun = rows[10] * (env.column_cdf[10, 21] - env.column_cdf[10, 20])
    assert 1 - in_sun == pytest.approx(share, rel=1e-6)
    # The whole energy comes back from the estimator radiance / density, which is constant where luminance is.
    _, rgb, density, _ = sample_many(env, np.stack([u, (u * 7919) % 1.0], -1))
    np.testing.assert_allclose(rgb[:, 1] / density, sky + 1e6 * omega[10], rtol=1e-6)


@pytest.mark.parametrize("value", [0.0, 1e-30, 0.1, 1e6])
def test_even_maps_have_nothing_to_sample(value):
    env = make_latlong(np.full((37, 53, 3), value))
    _, rgb, density, _ = sample_many(env, np.random.default_rng(6).random((100, 2)))
    assert not rgb.any()
    assert not density.any()
    assert env.lit == (value > 0)


def test_black_map_has_density_zero_without_compensation():
    _, _, density, _ = sample_many(make_latlong(np.zeros((4, 8, 3)), compensated=False), np.full((3, 2), 0.5))
    assert not density.any()


def test_negative_texels_are_sampled():
    pixels = np.zeros((4, 8, 3))
    pixels[1, 2] = [-1, 0, 0]
    _, rgb, density, texel = sample_many(
        make_latlong(pixels, compensated=False), np.random.default_rng(7).random((100, 2))
    )
    assert (texel == 10).all()
    # The estimator radiance/density is the integral of radiance; 1e-6: two luminances of the same texel.
    np.testing.assert_allclose(rgb[:, 0] / density, -texel_solid_angles(4, 8)[1], rtol=1e-6)


@pytest.mark.parametrize("compensated", [False, True])
def test_density_of_a_direction_is_the_density_of_its_sample(compensated):
    pixels = np.random.default_rng(8).random((5, 9, 3), np.float32)
    env = make_latlong(pixels, 10.0, compensated)
    assert (env.floor > 0) == compensated
    d, rgb, density, _ = sample_many(env, np.random.default_rng(9).random((1000, 2)))
    again = [direction_density(env, tuple(map(float, x))) for x in lookup_many(env, d)]
    np.testing.assert_allclose(again, density, rtol=1e-6)
    np.testing.assert_array_equal(lookup_many(env, d), rgb)
