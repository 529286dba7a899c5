"""Irradiance from runs of visibility bits against plain sums."""

import math

import numpy as np
import pytest

from relightcli.core.lights.environment import SkyCube, latlong_to_cube, splat
from relightcli.core.shade.irradiance import irradiance, moment_prefix
from relightcli.core.sphere import cube, sh
from relightcli.core.transport.visibility import horizon_bits
from tests.core.brdf.reflectances import random_directions
from tests.core.shade.skies import caps, patchy_map, smooth_map

NORMALS = random_directions(40, 1).astype(np.float32)


def dense(bits, normals, sky):
    seen = np.unpackbits(bits.reshape(len(bits), -1), axis=1, bitorder="little").astype(np.float64)
    total = (seen @ sky.moment.reshape(-1, 9)).reshape(-1, 3, 3)
    return np.maximum(np.einsum("ncx,nx->nc", total, normals.astype(np.float64)), 0)


@pytest.mark.parametrize("resolution", [16, 64])
def test_against_dense_sums(resolution):
    sky = splat(latlong_to_cube(patchy_map(2), resolution, 20.0))
    bits = caps(NORMALS, resolution, 3)
    found = irradiance(bits, NORMALS, moment_prefix(sky))
    np.testing.assert_allclose(found, dense(bits, NORMALS, sky), rtol=2e-7)  # float32 output


@pytest.mark.parametrize("pattern", ["none", "all", "first", "last", "alternating", "random", "word"])
def test_every_pattern_of_runs(pattern):
    sky = latlong_to_cube(patchy_map(4), 16)
    bits = np.zeros((len(NORMALS), 6, 16, 2), np.uint8)
    flat = bits.reshape(len(NORMALS), -1)
    if pattern == "all":
        flat[:] = 255
    elif pattern == "first":
        flat[:, 0] = 1
    elif pattern == "last":
        flat[:, -1] = 128
    elif pattern == "alternating":
        flat[:] = 0x55
    elif pattern == "random":
        flat[:] = np.random.default_rng(5).integers(0, 256, flat.shape)
    elif pattern == "word":
        flat[:, 8:16] = 255  # one whole word of 64
    # Bits below the horizon are summed as well here: this is a test of the sum.
    np.testing.assert_allclose(
        irradiance(bits, NORMALS, moment_prefix(sky)), dense(bits, NORMALS, sky), rtol=1e-6, atol=1e-9
    )


def test_sun_leaves_the_sky_its_digits():
    # 1e6 beside 1e-3: receivers that do not see the sun keep the sky's irradiance to float32.
    pixels = np.full((32, 64, 3), 1e-3, np.float32)
    plain = latlong_to_cube(pixels, 32)
    pixels[4, 7] = 1e6
    sunny = splat(latlong_to_cube(pixels, 32))
    bits = horizon_bits(NORMALS, 32)
    sun = sunny.flux[:, 0].reshape(6, 32, 32) > 1.0
    bits &= ~np.packbits(sun, axis=-1, bitorder="little")
    covered = ~np.packbits(sun, axis=-1, bitorder="little") & horizon_bits(NORMALS, 32)
    found = irradiance(covered, NORMALS, moment_prefix(sunny))
    np.testing.assert_allclose(found, dense(covered, NORMALS, sunny), rtol=2e-7)
    # And the sky is a sky of 1e-3: within the share of the few texels that were taken out, at most 4 % here.
    expected = dense(bits, NORMALS, plain)
    np.testing.assert_allclose(found, expected, rtol=0.01)


@pytest.mark.parametrize(("resolution", "bound"), [(16, 3e-3), (64, 3e-4)])
def test_constant_sky_gives_pi(resolution, bound):
    # The horizon's staircase: the digest gives 1.3e-3 at 16 and 8e-5 at 64 for the worst normal, along an axis.
    sky = latlong_to_cube(np.ones((2, 4, 3), np.float32), resolution)
    normals = np.concatenate([np.eye(3, dtype=np.float32), NORMALS])
    for light in (sky, splat(sky)):
        found = irradiance(horizon_bits(normals, resolution), normals, moment_prefix(light))
        np.testing.assert_allclose(found, math.pi, rtol=bound)


def test_sky_of_few_bands():
    # E(n) = sum A_l L_lm y_lm(n), exact for a sky of three bands. [Ramamoorthi 2001, Eq. 5]
    r = 64
    d = cube.texel_directions(r).reshape(-1, 3)
    light = np.zeros((9, 3))
    light[0] = 3.0
    light[1:] = np.random.default_rng(6).normal(size=(8, 3)) * 0.3
    flux = (sh.harmonics(d, 3) @ light) * np.tile(cube.solid_angles(r).reshape(-1), 6)[:, None]
    sky = SkyCube(r, flux, flux[:, :, None] * d[:, None, :])
    found = irradiance(horizon_bits(NORMALS, r), NORMALS, moment_prefix(sky))
    factor = np.repeat([math.pi, 2 * math.pi / 3, math.pi / 4], [1, 3, 5])
    expected = sh.harmonics(NORMALS.astype(np.float64), 3) @ (factor[:, None] * light)
    # The staircase as above, beside an irradiance of 2 to 4.
    np.testing.assert_allclose(found, expected, rtol=3e-4)


def test_linear_in_light():
    a, b = (latlong_to_cube(patchy_map(seed), 16) for seed in (7, 8))
    both = SkyCube(16, a.flux + 3 * b.flux, a.moment + 3 * b.moment)
    bits = caps(NORMALS, 16, 9)
    e = [irradiance(bits, NORMALS, moment_prefix(s)) for s in (a, b, both)]
    np.testing.assert_allclose(e[2], e[0] + 3 * e[1], rtol=1e-6)


def test_threads_and_the_active_mask():
    sky = latlong_to_cube(smooth_map(), 16)
    bits = caps(NORMALS, 16, 10)
    expected = irradiance(bits, NORMALS, moment_prefix(sky))
    active = np.arange(len(NORMALS)) % 3 != 0
    np.testing.assert_array_equal(irradiance(bits, NORMALS, moment_prefix(sky), threads=3), expected)
    found = irradiance(bits, NORMALS, moment_prefix(sky), threads=2, active=active)
    np.testing.assert_array_equal(found, np.where(active[:, None], expected, 0))
    assert irradiance(bits[:0], NORMALS[:0], moment_prefix(sky)).shape == (0, 3)
