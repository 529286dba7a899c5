"""Real orthonormal spherical harmonics without the Condon-Shortley phase, index l (l + 1) + m.

"Order n" means the bands 0 to n - 1, n^2 coefficients.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.bits import trailing_zeros
from relightcli.core.sphere import cube

SLAB_BYTES = 32 << 20


def harmonics(directions: NDArray[np.float64], order: int) -> NDArray[np.float64]:
    """y_i of directions (..., 3), whose length is no matter: (..., order^2) float64.

        y_lm = N_lm Q_lm(z) Re (x + i y)^m,    y_l-m = N_lm Q_lm(z) Im (x + i y)^m,    m >= 0

    N_lm = sqrt((2 - d_m0) (2 l + 1) / (4 pi) (l - m)! / (l + m)!), Q_lm = P_lm / (1 - z^2)^(m/2), P the associated
    Legendre functions without phase. On the caller's thread alone: most callers have few directions, for which waking
    others takes longer than the work.
    """
    flat = np.ascontiguousarray(np.asarray(directions, np.float64).reshape(-1, 3))
    values = np.empty((len(flat), order * order))
    _fill(flat, *_recurrence(order), values)
    return values.reshape(*directions.shape[:-1], order * order)


@lru_cache(maxsize=32)
def _recurrence(order: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """q_lm = N_lm Q_lm: q_mm (order,), and a, b (order, order), m then l, of q_l+1,m = a_ml z q_lm - b_ml q_l-1,m."""
    norm = np.zeros((order + 1, order + 1))
    first, a, b = np.zeros(order), np.zeros((order, order)), np.zeros((order, order))
    for m in range(order):
        for band in range(m, order + 1):
            ratio = math.factorial(band - m) / math.factorial(band + m)
            norm[band, m] = math.sqrt((2.0 if m else 1.0) * (2 * band + 1) / (4.0 * math.pi) * ratio)
        first[m] = norm[m, m] * math.prod(range(1, 2 * m, 2))
        for band in range(m, order):
            a[m, band] = (2 * band + 1) / (band + 1 - m) * norm[band + 1, m] / norm[band, m]
            if band > m:
                b[m, band] = (band + m) / (band + 1 - m) * norm[band + 1, m] / norm[band - 1, m]
    return first, a, b


@njit(cache=True, nogil=True, error_model="numpy")
def _fill(directions, first, a, b, out):  # type: ignore[no-untyped-def]
    order = len(first)
    for i in range(len(directions)):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        shrink = 1.0 / math.sqrt(x * x + y * y + z * z)
        x, y, z = x * shrink, y * shrink, z * shrink
        before, q = 0.0, first[0]
        for band in range(order):
            out[i, band * (band + 1)] = q
            before, q = q, a[0, band] * z * q - b[0, band] * before
        c, s = x, y  # (x + i y)^m
        for m in range(1, order):
            before, q = 0.0, first[m]
            for band in range(m, order):
                middle = band * (band + 1)
                out[i, middle + m] = q * c
                out[i, middle - m] = q * s
                before, q = q, a[m, band] * z * q - b[m, band] * before
            c, s = c * x - s * y, s * x + c * y


@lru_cache(maxsize=2)
def _moment_basis(resolution: int, order: int) -> NDArray[np.float32]:
    """Integrand of the cosine projection over the texels, (T, 3 order^2): w_x y_i dOmega, x slowest."""
    directions = cube.texel_directions(resolution).reshape(-1, 3)
    weights = np.tile(cube.solid_angles(resolution).reshape(-1), 6)
    basis = harmonics(directions, order) * weights[:, None]
    return (directions[:, :, None] * basis[:, None, :]).reshape(len(directions), -1).astype(np.float32)


def cosine_transfer(bits: NDArray[np.uint8], normals: NDArray[np.float32], order: int) -> NDArray[np.float32]:
    """Coefficients of V(w) (n . w)+ / pi, (N, order^2) float32.

    bits (N, 6, R, R/8) visibility (zero below the horizon), normals (N, 3). The dot product with the sky's
    coefficients is the exit radiance of a white Lambert surface, up to the bands left out.

    Runs of visible texels are taken from running sums, in a fixed order: the bytes of the result depend neither on how
    receivers are put into blocks nor on the threads of a linear algebra library.
    """
    moments = run_sums(bits, _moment_basis(bits.shape[2], order))
    return _along(moments.reshape(len(bits), 3, order * order), np.ascontiguousarray(normals, np.float32))


def run_sums(bits: NDArray[np.uint8], values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Sums over the visible texels of values (6 R R, K): (N, K) float64; bits (N, 6, R, R/8)."""
    words = np.ascontiguousarray(bits).reshape(len(bits), -1).view(np.uint64)
    sums = np.zeros((len(bits), values.shape[1]))
    slab = max(1, SLAB_BYTES // (64 * 8 * values.shape[1]))  # words, so that their running sums stay small
    for first in range(0, words.shape[1], slab):
        part = values[64 * first : 64 * (first + slab)]
        prefix = np.zeros((len(part) + 1, values.shape[1]))
        np.cumsum(part, axis=0, dtype=np.float64, out=prefix[1:])
        _add_runs(words[:, first : first + slab], prefix, sums)
    return sums


@njit(cache=True)
def _add_runs(words, prefix, out):  # type: ignore[no-untyped-def]
    one, zero = np.uint64(1), np.uint64(0)
    for i in range(words.shape[0]):
        carry = zero  # last bit of the word before
        is_open = False
        for w in range(words.shape[1]):
            word = words[i, w]
            change = word ^ ((word << one) | carry)
            carry = word >> np.uint64(63)
            while change != zero:
                at = 64 * w + trailing_zeros(change)  # type: ignore[call-arg]
                if is_open:
                    out[i] += prefix[at]
                else:
                    out[i] -= prefix[at]
                is_open = not is_open
                change &= change - one
        if is_open:
            out[i] += prefix[len(prefix) - 1]


@njit(cache=True)
def _along(moments, normals):  # type: ignore[no-untyped-def]
    """Moments (N, 3, S) along the normals (N, 3), over pi: (N, S) float32."""
    out = np.empty((moments.shape[0], moments.shape[2]), np.float32)
    for i in range(len(out)):
        for k in range(out.shape[1]):
            total = 0.0
            for x in range(3):
                total += moments[i, x, k] * normals[i, x]
            out[i, k] = total / math.pi
    return out


def project_sky(flux: NDArray[np.float64], resolution: int, order: int) -> NDArray[np.float64]:
    """L_i = sum over texels of the flux times y_i at the texel's centre, (order^2, 3). flux (6 R R, 3)."""
    directions = cube.texel_directions(resolution).reshape(-1, 3)
    return harmonics(directions, order).T @ flux
