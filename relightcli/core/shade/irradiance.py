"""Irradiance under any sky, straight from visibility bits.

The cosine is linear in the direction, so the integral over the visible sky is n . sum_t V_t m_t with m_t the moment
(integral of L w) of texel t. Visible texels come in runs; with prefix sums of the moments along the flat texel order
each run costs two look-ups, whatever its length. No basis is involved: what is lost is the texel's size alone.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.bits import trailing_zeros
from relightcli.core.lights.environment import SkyCube
from relightcli.core.parts import in_parts


def moment_prefix(sky: SkyCube) -> NDArray[np.float64]:
    """Running sums of the moments, (T + 1, 9) float64: three colours times x, y, z; the first row is zero."""
    flat = sky.moment.reshape(-1, 9)
    out = np.zeros((len(flat) + 1, 9))
    np.cumsum(flat, axis=0, out=out[1:])
    return out


def irradiance(
    bits: NDArray[np.uint8],
    normals: NDArray[np.float32],
    prefix: NDArray[np.float64],
    threads: int = 1,
    active: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """E = n . sum over visible texels of the moments, W m^-2 in the units of the map times sr, (N, 3) float32.

    bits (N, 6, R, R/8) uint8 visibility; normals (N, 3) unit; prefix from `moment_prefix`. Sums run in float64, so
    that a sun of 1e6 leaves the digits of a sky of 1e-3; texels on the horizon may add a little below zero, which is
    cut off. Receivers that are not `active` (N,) get 0.
    """
    words = np.ascontiguousarray(bits).reshape(len(bits), math.prod(bits.shape[1:])).view(np.uint64)
    out = np.empty((len(bits), 3), np.float32)
    normals = np.ascontiguousarray(normals, np.float32)
    if active is None:
        active = np.ones(len(bits), bool)
    in_parts(
        lambda a, b: _sum_runs(words[a:b], normals[a:b], active[a:b], prefix, out[a:b]),
        len(bits),
        threads,
    )
    return out


@njit(cache=True, nogil=True)
def _sum_runs(words, normals, active, prefix, out):  # type: ignore[no-untyped-def]
    one = np.uint64(1)
    top = np.uint64(63)
    zero = np.uint64(0)
    acc = np.empty(9)
    for i in range(words.shape[0]):
        if not active[i]:
            out[i] = np.float32(0.0)
            continue
        acc[:] = 0.0
        carry = zero  # last bit of the word before
        sign = -1.0  # the next change opens a run
        for w in range(words.shape[1]):
            word = words[i, w]
            change = word ^ ((word << one) | carry)
            carry = word >> top
            while change != zero:
                at = 64 * w + trailing_zeros(change)  # type: ignore[call-arg]
                for q in range(9):
                    acc[q] += sign * prefix[at, q]
                sign = -sign
                change &= change - one
        if sign > 0.0:  # a run that reaches the last texel
            for q in range(9):
                acc[q] += prefix[prefix.shape[0] - 1, q]
        for c in range(3):
            e = normals[i, 0] * acc[3 * c] + normals[i, 1] * acc[3 * c + 1] + normals[i, 2] * acc[3 * c + 2]
            out[i, c] = max(e, 0.0)
