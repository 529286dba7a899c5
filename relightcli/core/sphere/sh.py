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
    """y_i of unit directions (..., 3): (..., order^2) float64."""
    from sphericart import SphericalHarmonics

    flat = np.ascontiguousarray(np.asarray(directions, np.float64).reshape(-1, 3))
    values: NDArray[np.float64] = SphericalHarmonics(l_max=order - 1).compute(flat)
    return values.reshape(*directions.shape[:-1], order * order)


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
