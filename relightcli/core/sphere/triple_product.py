"""Products of functions in spherical harmonics, cut to the order of the factors.

    (a * b)_k = sum_ij C_ijk a_i b_j,    C_ijk = integral of y_i y_j y_k

gives the first coefficients of the product of the two functions exactly; its higher bands are lost, so that the cut
product is commutative, but not associative.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.sphere import sh
from relightcli.core.sphere.rotation import quadrature

_ROUND_OFF = 1e-12  # the least coefficient that is not zero is 1e-2 at order 4, 1e-4 at order 10


class Coefficients(NamedTuple):
    """The coefficients that are not zero: i, j, k (T,) int32 and value (T,) float64, k slowest, all permutations."""

    i: NDArray[np.int32]
    j: NDArray[np.int32]
    k: NDArray[np.int32]
    value: NDArray[np.float64]


@lru_cache(maxsize=8)
def coefficients(order: int) -> Coefficients:
    """C_ijk of an order, by a quadrature that is exact for products of three harmonics."""
    directions, weights = quadrature(3 * (order - 1))
    y = sh.harmonics(directions, order)
    count = order * order
    pairs = (y[:, :, None] * y[:, None, :]).reshape(len(y), -1)
    dense = ((y * weights[:, None]).T @ pairs).reshape(count, count, count)
    k, i, j = np.nonzero(np.abs(dense) > _ROUND_OFF)
    return Coefficients(i.astype(np.int32), j.astype(np.int32), k.astype(np.int32), dense[k, i, j])


def product_matrices(a: NDArray[np.floating]) -> NDArray[np.float64]:
    """The symmetric matrices (..., N, N) float64 that multiply by the functions a (..., N): matrix @ b = a * b.

    Their eigenvalues lie between the least and the greatest value of the function.
    """
    n = a.shape[-1]
    i, j, k, value = coefficients(math.isqrt(n))
    dense = np.zeros((n, n * n))
    dense[i, k * n + j] = value
    out: NDArray[np.float64] = (np.asarray(a, np.float64) @ dense).reshape(*a.shape[:-1], n, n)
    return out


def product(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """The cut product (..., N) float64 of functions a and b (..., N), which broadcast."""
    n = a.shape[-1]
    shape = np.broadcast_shapes(a.shape, b.shape)
    flat_a, flat_b = (np.ascontiguousarray(np.broadcast_to(x, shape), np.float64).reshape(-1, n) for x in (a, b))
    found: NDArray[np.float64] = _product(flat_a, flat_b, *coefficients(math.isqrt(n))).reshape(shape)
    return found


@njit(cache=True)
def _product(a, b, i, j, k, value):  # type: ignore[no-untyped-def]
    out = np.zeros_like(a)
    for row in range(len(a)):
        for t in range(len(value)):
            out[row, k[t]] += value[t] * a[row, i[t]] * b[row, j[t]]
    return out
