"""Reflection by a 1D kernel as a matrix of spherical harmonics: a surface's shade from visibility and light.

A 1D BRDF times the cosine is g(t), t the cosine between the light and an axis R: the mirrored view for phong, the
normal for lambert. With visibility V = sum v_j y_j and light L = sum l_i y_i

    shade = int L V g(s . R) ds = l' M v,    M_ij = int g(s . R) y_i y_j ds.

Two forms. In a frame with R on z, phong's M is M^a / (2 pi / (a + 1)) with [Nowrouzezahrai 2008, Eq. 2, App. A]

    M^a_ij = int over z > 0 of z^a y_i y_j ds,

of which the appendix prints closed forms with errors; here every entry is summed in exact rational arithmetic and
rounded once. In any common frame, by the addition theorem and the triple products C of the harmonics,

    shade = sum_L kappa_L sum_M y_LM(R) sum_ij C_(LM)ij l_i v_j,    kappa_L = 2 pi int g(t) P_L(t) dt,

L < 2 n - 1 for n bands: no rotation, and another kernel changes kappa alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from relightcli.core.sphere import sh

Kernel = Callable[[NDArray[np.float64]], NDArray[np.float64]]

PANELS = 50  # of the quadrature of a kernel, each half as wide as the one before it towards t = 0, and t = 1
NODES = 32


def phong_matrix(exponent: float, order: int) -> NDArray[np.float64]:
    """M^a, (order^2, order^2) float64, for the exponent a >= 0, without the factor (a + 1) / (2 pi).

    Every entry is its exact value rounded once, whatever the exponent: at a = 1e6 a sum in floating point would keep no
    digit of the entries of high m. Raises ValueError for an exponent that is negative or not finite.
    """
    if not (math.isfinite(exponent) and exponent >= 0.0):
        raise ValueError(f"exponent: expected a finite number, at least 0; found {exponent}")
    return _phong_matrix(float(exponent), order).copy()


@lru_cache(maxsize=64)
def _phong_matrix(exponent: float, order: int) -> NDArray[np.float64]:
    a = Fraction(exponent)
    moments = [1 / (a + 1 + k) for k in range(2 * order - 1)]  # int z^(a + k)
    matrix = np.zeros((order * order, order * order))
    for m in range(order):
        for low in range(m, order):
            for high in range(low, order):
                product = _times(_times(_associated(low, m), _associated(high, m)), _sine_power(m))
                integral = sum((c * moments[k] for k, c in enumerate(product) if c), start=Fraction(0))
                # 2 pi K_l K_l' int: the square of K is rational but for 1 / (4 pi).
                squared = _norm2(low, m) * _norm2(high, m) * integral * integral
                value = math.copysign(0.5 * _root(squared), integral)
                for sign in {m, -m}:
                    i, j = low * (low + 1) + sign, high * (high + 1) + sign
                    matrix[i, j] = matrix[j, i] = value
    return matrix


def _root(square: Fraction) -> float:
    """The square root of a fraction, of any size of numerator and denominator."""
    if not square:
        return 0.0
    shift = square.denominator.bit_length() - square.numerator.bit_length() + 128
    shift += shift % 2  # an even number of bits, so that the root takes half of them
    numerator = square.numerator << shift if shift >= 0 else square.numerator >> -shift
    return math.ldexp(math.isqrt(numerator // square.denominator), -shift // 2)


def _norm2(band: int, m: int) -> Fraction:
    """(2 l + 1) (l - m)! / (l + m)!, 4 pi times the square of the norm K. For m > 0 the 2 of it meets cos^2's mean."""
    return Fraction((2 * band + 1) * math.factorial(band - m), math.factorial(band + m))


@lru_cache(maxsize=256)
def _associated(band: int, m: int) -> tuple[Fraction, ...]:
    """Coefficients in z of d^m P_l / dz^m, so that P_l^m = (1 - z^2)^(m/2) times it (no Condon-Shortley phase)."""
    out = [Fraction(0)] * (band + 1)
    for k in range(band // 2 + 1):
        out[band - 2 * k] = Fraction(
            (-1) ** k * math.factorial(2 * band - 2 * k),
            2**band * math.factorial(k) * math.factorial(band - k) * math.factorial(band - 2 * k),
        )
    for _ in range(m):
        out = [power * c for power, c in enumerate(out)][1:]
    return tuple(out)


def _sine_power(m: int) -> tuple[Fraction, ...]:
    """(1 - z^2)^m."""
    out: tuple[Fraction, ...] = (Fraction(1),)
    for _ in range(m):
        out = _times(out, (Fraction(1), Fraction(0), Fraction(-1)))
    return out


def _times(a: tuple[Fraction, ...], b: tuple[Fraction, ...]) -> tuple[Fraction, ...]:
    out = [Fraction(0)] * (len(a) + len(b) - 1)
    for i, x in enumerate(a):
        if x:
            for j, y in enumerate(b):
                out[i + j] += x * y
    return tuple(out)


def phong_factors(exponent: float, count: int) -> NDArray[np.float64]:
    """kappa_L of (a + 1) / (2 pi) max(0, t)^a, L < count: 1, (a + 1) / (a + 2), then
    kappa_L = kappa_{L-2} (a + 2 - L) / (a + 1 + L). No step of it cancels. a = 1 is lambert of albedo 1."""
    if not (math.isfinite(exponent) and exponent >= 0.0):
        raise ValueError(f"exponent: expected a finite number, at least 0; found {exponent}")
    kappa = np.empty(max(count, 2))
    kappa[:2] = 1.0, (exponent + 1.0) / (exponent + 2.0)
    for band in range(2, count):
        kappa[band] = kappa[band - 2] * (exponent + 2.0 - band) / (exponent + 1.0 + band)
    return kappa[:count]


def kernel_factors(kernel: Kernel, count: int) -> NDArray[np.float64]:
    """kappa_L = 2 pi int_{-1}^1 g(t) P_L(t) dt, L < count, of any kernel g(t), a function of arrays of cosines.

    Gauss quadrature on panels that halve towards t = 0, where kernels end and may jump, and t = 1, where glossy ones
    live. Give phong by `phong_factors`, which is exact.
    """
    x, w = np.polynomial.legendre.leggauss(NODES)
    steps = 0.5 ** np.arange(1.0, PANELS)
    edges = np.concatenate([[-1.0], -steps, [0.0], steps[:0:-1], 1.0 - steps, [1.0]])
    half = 0.5 * np.diff(edges)[:, None]
    t = (edges[:-1, None] + half * (1.0 + x)).reshape(-1)
    weight = (half * w).reshape(-1) * np.asarray(kernel(t), np.float64)
    if not np.isfinite(weight).all():
        raise ValueError("kernel: expected finite values on [-1, 1]")
    return 2.0 * math.pi * (np.polynomial.legendre.legvander(t, count - 1).T @ weight)


@lru_cache(maxsize=8)
def triple_products(bands: int, light: int, visibility: int) -> NDArray[np.float64]:
    """C_kij = int y_k y_i y_j, (bands^2, light^2, visibility^2), by a product rule that is exact for these degrees."""
    degree = bands + light + visibility - 3
    x, w = np.polynomial.legendre.leggauss(degree // 2 + 1)
    phi = 2.0 * math.pi * np.arange(degree + 1) / (degree + 1)
    z, f = np.meshgrid(x, phi, indexing="ij")
    r = np.sqrt(1.0 - z * z)
    y = sh.harmonics(np.stack([r * np.cos(f), r * np.sin(f), z], -1).reshape(-1, 3), max(bands, light, visibility))
    weight = np.repeat(w, len(phi)) * (2.0 * math.pi / len(phi))
    pairs = y[:, : light**2, None] * y[:, None, : visibility**2]
    out: NDArray[np.float64] = ((y[:, : bands**2] * weight[:, None]).T @ pairs.reshape(len(y), -1)).reshape(
        bands**2, light**2, visibility**2
    )
    out[np.abs(out) < 1e-13] = 0.0  # round-off of what symmetry makes 0
    return out


def lighting_matrix(
    kappa: NDArray[np.float64], light: NDArray[np.float64], visibility_order: int
) -> NDArray[np.float64]:
    """T (len(kappa)^2, visibility_order^2, C) with shade_c = sum y_k(R) T_kjc v_j: the light (S, C) multiplied in.

    It is made once for a light and a kernel; what is left for a vertex is its R and its v. len(kappa) bands of the
    kernel; light order + visibility_order - 1 are all that count.
    """
    products = triple_products(len(kappa), math.isqrt(len(light)), visibility_order)
    per_band = np.repeat(kappa, 2 * np.arange(len(kappa)) + 1)
    return np.einsum("kij,ic->kjc", products, light, optimize=True) * per_band[:, None, None]
