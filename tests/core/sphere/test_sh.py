"""Spherical harmonics: orthonormality, index order, signs, and the clamped cosine."""

import math

import numpy as np
import pytest

from relightcli.core.sphere import cube, sh
from relightcli.core.transport.visibility import horizon_bits
from tests.core.brdf.reflectances import random_directions

ORDER = 6


def quadrature(count):
    """Gauss points in z times even points in longitude: exact for polynomials of degree below 2 count."""
    z, w = np.polynomial.legendre.leggauss(count)
    phi = 2 * np.pi * np.arange(2 * count) / (2 * count)
    sine = np.sqrt(1 - z * z)[:, None]
    d = np.stack([sine * np.cos(phi), sine * np.sin(phi), np.broadcast_to(z[:, None], (count, 2 * count))], -1)
    return d.reshape(-1, 3), np.repeat(w * np.pi / count, 2 * count)


def test_orthonormal():
    d, w = quadrature(16)
    y = sh.harmonics(d, ORDER)
    assert y.shape == (len(d), ORDER**2)
    np.testing.assert_allclose(y.T @ (w[:, None] * y), np.eye(ORDER**2), atol=1e-13)


def test_index_order_and_signs():
    # Bands 0 to 2 written out: no Condon-Shortley phase, so that y_1 is proportional to +(y, z, x).
    d = random_directions(50, 1)
    x, y, z = d.T
    a = math.sqrt(15 / (4 * math.pi))
    expected = np.stack(
        [
            np.full(50, math.sqrt(1 / (4 * math.pi))),
            *(math.sqrt(3 / (4 * math.pi)) * q for q in (y, z, x)),
            a * x * y,
            a * y * z,
            math.sqrt(5 / (16 * math.pi)) * (3 * z * z - 1),
            a * x * z,
            0.5 * a * (x * x - y * y),
        ],
        -1,
    )
    np.testing.assert_allclose(sh.harmonics(d, 3), expected, atol=1e-14)


def test_parity():
    d = random_directions(50, 2)
    sign = np.concatenate([np.full(2 * band + 1, (-1.0) ** band) for band in range(ORDER)])
    np.testing.assert_allclose(sh.harmonics(-d, ORDER), sign * sh.harmonics(d, ORDER), atol=1e-13)


def test_addition_theorem():
    # sum_m y_lm(a) y_lm(b) = (2l+1)/(4 pi) P_l(a.b): rotation invariance in one line.
    a, b = random_directions(40, 3), random_directions(40, 4)
    product = sh.harmonics(a, ORDER) * sh.harmonics(b, ORDER)
    cosine = np.einsum("nx,nx->n", a, b)
    for band in range(ORDER):
        legendre = np.polynomial.legendre.Legendre.basis(band)(cosine)
        np.testing.assert_allclose(
            product[:, band**2 : (band + 1) ** 2].sum(1), (2 * band + 1) / (4 * math.pi) * legendre, atol=1e-13
        )


@pytest.mark.parametrize(("resolution", "error"), [(16, 1.5e-3), (64, 1e-4)])
def test_clamped_cosine(resolution, error):
    # E = sum A_l L_lm y_lm(n) with A_l = pi, 2 pi/3, pi/4, 0, -pi/24; the transfer carries another 1/pi. What remains
    # is the horizon's staircase of texels: measured 7.8e-4 at 16, 4.1e-5 at 64.
    normals = np.concatenate([np.eye(3), -np.eye(3), random_directions(26, 5)]).astype(np.float32)
    found = sh.cosine_transfer(horizon_bits(normals, resolution), normals, 5)
    factor = np.repeat([1, 2 / 3, 1 / 4, 0, -1 / 24], [1, 3, 5, 7, 9])
    expected = factor * sh.harmonics(normals.astype(np.float64), 5)
    np.testing.assert_allclose(found, expected, atol=error)


def test_sky_of_few_bands_is_recovered():
    r = 32
    d = cube.texel_directions(r).reshape(-1, 3)
    light = np.random.default_rng(6).normal(size=(16, 3))
    flux = (sh.harmonics(d, 4) @ light) * np.tile(cube.solid_angles(r).reshape(-1), 6)[:, None]
    # Midpoint rule over texels of 2/R, of order (l/R)^2: measured 7e-4.
    np.testing.assert_allclose(sh.project_sky(flux, r, 4), light, atol=1.5e-3)
