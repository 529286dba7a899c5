"""Light past others in cells, against closed forms and the closed product of harmonics."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.lights.environment import latlong_to_cube
from relightcli.core.pose.beside import (
    CELLS,
    band_profile,
    lambert_profile,
    shade_beside,
    sky_cells,
)
from relightcli.core.pose.phong_operator import lighting_matrix, phong_factors
from relightcli.core.pose.visibility import hemisphere_harmonics
from relightcli.core.sphere import cube, sh
from relightcli.core.transport.visibility import horizon_bits

UP = np.array([[0.0, 0.0, 1.0]], np.float32)


def packed(mask):
    """Bits (1, 6, C, C/8) of a mask (6, C, C)."""
    return np.packbits(mask.reshape(1, 6, CELLS, CELLS), axis=3, bitorder="little")


def every():
    return packed(np.ones((6, CELLS, CELLS), bool))


def sky(seed=2):
    rng = np.random.default_rng(seed)
    return latlong_to_cube((rng.random((8, 16, 3)) + 0.2).astype(np.float32), 64)


def test_even_light_and_blocked_halves():
    even = latlong_to_cube(np.ones((2, 4, 3), np.float32), 32)
    cells = sky_cells(even, 4)
    assert cells.flux.sum(axis=0) == pytest.approx(4 * np.pi, rel=1e-5)
    whole = hemisphere_harmonics(4)[None].astype(np.float32)
    zero = np.zeros(1, np.int32)
    # Lambert of albedo 1 in even light: 1, and 1/2 past a wall. 16 x 16 cells: 5e-3.
    open_half = packed(cube.texel_directions(CELLS)[..., 0] > 0)
    for bits, expected in ((every(), 1.0), (open_half, 0.5), (packed(np.zeros((6, CELLS, CELLS), bool)), 0.0)):
        found = shade_beside(whole, bits, cells, UP, zero, [lambert_profile()])
        assert found == pytest.approx(np.full((1, 3), expected), abs=5e-3)
    assert (
        shade_beside(whole, packed(np.zeros((6, CELLS, CELLS), bool)), cells, UP, zero, [lambert_profile()]) == 0
    ).all()


@pytest.mark.parametrize("exponent", [0.0, 1.0, 20.0, 1e6])
def test_where_all_is_open_it_is_the_closed_product(exponent):
    rng = np.random.default_rng(3)
    light, order = sky(), 4
    v = rng.normal(size=(5, order**2)).astype(np.float32) * 0.2
    v[:, 0] += 2
    axis = rng.normal(size=(5, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    kappa = phong_factors(exponent, 2 * order - 1)
    table = lighting_matrix(kappa, sh.project_sky(light.flux, light.resolution, 10), order)
    expected = np.maximum(np.einsum("vk,kjc,vj->vc", sh.harmonics(axis, 7), table, v), 0)
    profile = [band_profile(kappa)]
    found = shade_beside(
        v,
        np.repeat(every(), 5, axis=0),
        sky_cells(light, order),
        axis.astype(np.float32),
        np.zeros(5, np.int32),
        profile,
    )
    # Polynomials of degree 9 over cells of 5.6 degrees.
    np.testing.assert_allclose(found, expected, atol=0.02 * expected.max())


def test_never_negative_whatever_the_bands_say():
    v = -np.ones((2, 16), np.float32)
    kernel = np.array([0, -1], np.int32)
    found = shade_beside(
        v, horizon_bits(np.repeat(UP, 2, axis=0), CELLS), sky_cells(sky(), 4), np.repeat(UP, 2, axis=0), kernel,
        [lambert_profile()],
    )  # fmt: skip
    assert (found >= 0).all()
    assert (found[1] == 0).all()
