"""Reflection operators against quadrature, the corrected table of the paper's appendix, and closed forms."""

import math

import numpy as np
import pytest
from scipy.linalg import eigh_tridiagonal

from relightcli.core.pose.phong_operator import (
    kernel_factors,
    lighting_matrix,
    phong_factors,
    phong_matrix,
    triple_products,
)
from relightcli.core.sphere import sh

EXPONENTS = [0.0, 0.5, 1.0, 2.0, 10.0, 100.0, 1e4, 1e6]


def _quadrature(exponent: float, order: int) -> np.ndarray:
    """M^a by integrating the harmonics themselves over z in [0, 1].

    Gauss's rule for the weight (1 - z)^m z^a takes the exponent, so that no node of a huge one has to resolve the
    peak, and the factor of (1 - z^2)^m by which entries of high m are small. The rest is a polynomial, of degree below
    2 order.
    """
    out = np.zeros((order**2, order**2))
    for m in range(order):
        z, w = _jacobi(2 * order, m, exponent)
        w = w * (1.0 + z) ** m * (math.pi if m else 2 * math.pi)
        for low in range(m, order):
            for high in range(m, order):
                value = np.sum(w * _polynomial(low, m, z) * _polynomial(high, m, z))
                for sign in (m, -m):
                    out[low * (low + 1) + sign, high * (high + 1) + sign] = value
    return out


def _jacobi(count: int, p: int, q: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes in [0, 1] and weights for (1 - z)^p z^q, from the eigenvectors of the recurrence. [Golub 1969]

    SciPy's roots_jacobi overflows at q = 1e4.
    """
    k = np.arange(count)
    s = 2.0 * k + p + q
    diagonal = np.append((q - p) / (p + q + 2.0), (q * q - p * p) / (s[1:] * (s[1:] + 2.0)))
    k, s = k[1:], s[1:]
    side = np.sqrt(4.0 * k * (k + p) * (k + q) * (k + p + q) / (s * s * (s + 1.0) * (s - 1.0)))
    nodes, vectors = eigh_tridiagonal(diagonal, side)
    beta = math.prod(n / (q + n) for n in range(1, p + 1)) / (q + p + 1)  # int (1 - z)^p z^q
    return 0.5 * (1.0 + nodes), vectors[0] ** 2 * beta


def _polynomial(band: int, m: int, z: np.ndarray) -> np.ndarray:
    """y_lm without (1 - z^2)^(m/2) and cos m phi."""
    norm = math.sqrt((2 * band + 1) / (4 * math.pi) * math.factorial(band - m) / math.factorial(band + m))
    return norm * (math.sqrt(2.0) if m else 1.0) * np.polynomial.legendre.Legendre.basis(band).deriv(m)(z)


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_entries_equal_quadrature(exponent: float) -> None:
    """1e-10 is the demanded bound. Beside it 1e-13 of what the norms allow: some entries are exactly 0."""
    for order in range(1, 9):
        ours, theirs = phong_matrix(exponent, order), _quadrature(exponent, order)
        most = np.sqrt(np.outer(np.diag(theirs), np.diag(theirs)))  # Cauchy and Schwarz
        assert (np.abs(ours - theirs) <= 1e-10 * np.abs(theirs) + 1e-13 * most).all()


def test_table_of_the_appendix_as_corrected() -> None:
    for a in (0.5, 1.0, 2.0, 10.0, 100.0, 1e4):
        a1, a2, a3, a4, a5, a6, a7 = (a + k for k in range(1, 8))
        table = {
            "00": 1 / (2 * a1),
            "02": math.sqrt(3) / (2 * a2),
            "06": math.sqrt(5) * a / (2 * a1 * a3),
            "0C": math.sqrt(7) * (a - 1) / (2 * a2 * a4),
            "22": 3 / (2 * a3),
            "26": math.sqrt(15) * a1 / (2 * a2 * a4),
            "2C": math.sqrt(21) * a / (2 * a3 * a5),
            "66": 5 * (a * a + 2 * a + 3) / (2 * a1 * a3 * a5),
            "6C": math.sqrt(35) * (a * a + 2 * a + 6) / (2 * a2 * a4 * a6),
            "CC": 7 * (a * a + 2 * a + 15) / (2 * a3 * a5 * a7),
            "11": 3 / (2 * a1 * a3),
            "15": 3 * math.sqrt(5) / (2 * a2 * a4),
            "1B": 3 * math.sqrt(7) * a / (math.sqrt(2) * a1 * a3 * a5),
            "55": 15 / (2 * a3 * a5),
            "5B": 3 * math.sqrt(35) * a1 / (math.sqrt(2) * a2 * a4 * a6),
            "BB": 21 * (2 * a * a + 4 * a + 5) / (2 * a1 * a3 * a5 * a7),
            "44": 15 / (2 * a1 * a3 * a5),
            "4A": 15 * math.sqrt(7) / (2 * a2 * a4 * a6),
            "AA": 105 / (2 * a3 * a5 * a7),
            "99": 105 / (2 * a1 * a3 * a5 * a7),
        }
        twins = {"11": "33", "15": "37", "1B": "3D", "55": "77", "5B": "7D", "BB": "DD"}
        twins |= {"44": "88", "4A": "8E", "AA": "EE", "99": "FF"}
        expected = np.zeros((16, 16))
        for name, value in table.items():
            for i, j in (name, twins.get(name, name)):
                expected[int(i, 16), int(j, 16)] = expected[int(j, 16), int(i, 16)] = value
        # Both are exact formulas rounded a few times.
        np.testing.assert_allclose(phong_matrix(a, 4), expected, rtol=3e-15, atol=0.0)


@pytest.mark.parametrize(("exponent", "entries", "distinct"), [(0.5, 44, 20), (10.0, 44, 20), (1.0, 42, 18)])
def test_sparsity_at_order_four(exponent: float, entries: int, distinct: int) -> None:
    """44 of 256 entries and 20 values; at a = 1, 0C vanishes and 55 = 66."""
    matrix = phong_matrix(exponent, 4)
    values = np.sort(matrix[matrix != 0.0])
    assert len(values) == entries
    assert 1 + np.count_nonzero(np.diff(values) > 1e-12 * values[1:]) == distinct


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_traces_definiteness_and_recurrence(exponent: float) -> None:
    order = 8
    matrix = phong_matrix(exponent, order)
    for band in range(order):
        rows = np.arange(band * band, (band + 1) ** 2)
        trace = (exponent + 1) / (2 * math.pi) * matrix[rows, rows].sum()
        assert trace == pytest.approx((2 * band + 1) / (4 * math.pi), rel=1e-13)  # addition theorem at one point
    # Scaled to a unit diagonal, so that entries that fall like a^-m count too.
    root = np.sqrt(np.diag(matrix))
    assert np.linalg.eigvalsh(matrix / np.outer(root, root)).min() > -1e-13
    # z y_i stays in the first `order` bands for the bands below the last.
    jump = np.sqrt(4 * math.pi / 3) * triple_products(order, 2, order)[:, 2]
    inner = (order - 1) ** 2
    np.testing.assert_allclose((jump @ matrix)[:inner], phong_matrix(exponent + 1, order)[:inner], rtol=0, atol=2e-14)


def test_exponent_one_is_diffuse() -> None:
    """Clamped-cosine factors pi, 2 pi / 3, pi / 4, 0, -pi / 24, over pi."""
    np.testing.assert_allclose(phong_factors(1.0, 5), [1, 2 / 3, 1 / 4, 0, -1 / 24], rtol=1e-15)
    cosine = sh.harmonics(np.array([[0.0, 0.0, 1.0]]), 4)[0] * np.repeat(phong_factors(1.0, 4), [1, 3, 5, 7])
    unit = np.sqrt(4 * math.pi)  # visible everywhere
    np.testing.assert_allclose(phong_matrix(1.0, 4)[:, 0] * unit / math.pi, cosine, atol=1e-15)


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_frame_free_form_equals_rotated_matrix(exponent: float) -> None:
    """1e-12 is the demanded bound."""
    rng = np.random.default_rng(3)
    for order in (1, 2, 4, 6, 8):
        light, seen = rng.normal(size=(2, order**2))
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        turn = _frame(axis)
        to = _rotation(turn, order)
        rotated = (exponent + 1) / (2 * math.pi) * (to @ light) @ phong_matrix(exponent, order) @ (to @ seen)
        table = lighting_matrix(phong_factors(exponent, 2 * order - 1), light[:, None], order)
        free = sh.harmonics(axis[None], 2 * order - 1)[0] @ table[:, :, 0] @ seen
        assert free == pytest.approx(rotated, abs=1e-12 * np.linalg.norm(light) * np.linalg.norm(seen))


def _frame(axis: np.ndarray) -> np.ndarray:
    x = np.cross(axis, [0.3, 0.5, -0.8])
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(axis, x), axis])


def _rotation(frame: np.ndarray, order: int) -> np.ndarray:
    """Coefficients in the frame from those in the world, by an exact product rule."""
    x, w = np.polynomial.legendre.leggauss(order)
    phi = 2 * math.pi * np.arange(2 * order) / (2 * order)
    z, f = np.meshgrid(x, phi, indexing="ij")
    r = np.sqrt(1 - z * z)
    world = np.stack([r * np.cos(f), r * np.sin(f), z], -1).reshape(-1, 3)
    weight = np.repeat(w, 2 * order) * math.pi / order
    return sh.harmonics(world @ frame.T, order).T @ (sh.harmonics(world, order) * weight[:, None])


def test_open_sky_gives_one() -> None:
    """V = 1 and L = 1: every normalised lobe gives 1."""
    even = np.zeros(16)
    even[0] = math.sqrt(4 * math.pi)
    axis = np.array([[0.6, 0.0, 0.8]])
    for exponent in EXPONENTS:
        table = lighting_matrix(phong_factors(exponent, 7), even[:, None], 4)
        assert (sh.harmonics(axis, 7)[0] @ table[:, :, 0] @ even) == pytest.approx(1.0, rel=1e-14)


@pytest.mark.parametrize(("exponent", "shade"), [(0.5, 0.979), (1, 1.0), (2, 1.0078), (10, 0.9297), (100, 0.8303)])
def test_half_sky_of_four_bands(exponent: float, shade: float) -> None:
    """Visibility of a hemisphere cut to four bands is .5 + 1.40625 t - 1.09375 t^3."""
    seen = np.array([math.sqrt(math.pi), 0, math.sqrt(3 * math.pi) / 2, 0, 0, 0, 0, 0, 0, 0, 0, 0])
    seen = np.append(seen, [-math.sqrt(7 * math.pi) / 8, 0, 0, 0])
    even = np.zeros(16)
    even[0] = math.sqrt(4 * math.pi)
    ours = (exponent + 1) / (2 * math.pi) * even @ phong_matrix(exponent, 4) @ seen
    a = exponent
    assert ours == pytest.approx((a + 1) * (0.5 / (a + 1) + 1.40625 / (a + 2) - 1.09375 / (a + 4)), rel=1e-13)
    assert ours == pytest.approx(shade, abs=6e-5 if a > 1 else 6e-4)


def test_factors_of_any_kernel() -> None:
    """Phong given as a function equals its closed form; a mirrored cosine has the signs of odd bands turned."""
    for exponent in (0.0, 0.5, 2.0, 100.0, 1e4):
        found = kernel_factors(
            lambda t, a=exponent: (a + 1) / (2 * math.pi) * np.where(t > 0, np.abs(t) ** a, 0.0),  # type: ignore[misc]
            15,
        )
        np.testing.assert_allclose(found, phong_factors(exponent, 15), atol=1e-12)
    back = kernel_factors(lambda t: np.maximum(-t, 0.0) / math.pi, 9)
    np.testing.assert_allclose(back, phong_factors(1.0, 9) * (-1.0) ** np.arange(9), atol=1e-14)
    with pytest.raises(ValueError, match="finite"):
        kernel_factors(lambda t: np.full_like(t, np.nan), 3)


def test_triple_products_known() -> None:
    products = triple_products(4, 4, 4)
    assert np.count_nonzero(products) == 353
    assert np.count_nonzero(triple_products(7, 4, 4)) == 708
    np.testing.assert_allclose(products[0] * math.sqrt(4 * math.pi), np.eye(16), atol=1e-14)


@pytest.mark.parametrize("exponent", [-0.1, math.nan, math.inf])
def test_bad_exponents(exponent: float) -> None:
    with pytest.raises(ValueError, match="exponent"):
        phong_matrix(exponent, 4)
    with pytest.raises(ValueError, match="exponent"):
        phong_factors(exponent, 4)
