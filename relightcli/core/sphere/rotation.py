"""Rotation of functions in real spherical harmonics, any order.

The rotated function is f'(d) = f(R^-1 d). Its coefficients D(R) f follow from a quadrature that is exact for products
of two harmonics of the order,

    D_ij = sum over points d_q of w_q y_i(d_q) y_j(R^-1 d_q),

without angles or recurrences: nothing is singular anywhere, and mirrors (det R = -1) work as well.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from relightcli.core.sphere import sh


@lru_cache(maxsize=16)
def quadrature(degree: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (Q, 3) and weights (Q,), sr, that integrate every polynomial of up to `degree` exactly.

    Gauss points in z times even longitudes.
    """
    count = degree // 2 + 1
    z, weight = np.polynomial.legendre.leggauss(count)
    around = degree + 1
    phi = 2.0 * np.pi * np.arange(around) / around
    sine = np.sqrt(1.0 - z * z)[:, None]
    d = np.stack([sine * np.cos(phi), sine * np.sin(phi), np.broadcast_to(z[:, None], (count, around))], -1)
    return d.reshape(-1, 3), np.repeat(weight * (2.0 * np.pi / around), around)


def rotation_matrices(rotations: NDArray[np.floating], order: int) -> NDArray[np.float64]:
    """D(R) (..., order^2, order^2) float64 of orthogonal matrices R (..., 3, 3); zero between bands.

    D(R) c are the coefficients of the function d -> f(R^-1 d) where c are f's.
    """
    r = np.asarray(rotations, np.float64)
    directions, weights = quadrature(2 * (order - 1))
    here = sh.harmonics(directions, order) * weights[:, None]
    back = sh.harmonics(np.einsum("qx,...xy->...qy", directions, r), order)  # rows d' R are R^-1 d
    out = np.zeros((*r.shape[:-2], order * order, order * order))
    for band in range(order):
        part = slice(band * band, (band + 1) ** 2)
        out[..., part, part] = np.einsum("qi,...qj->...ij", here[:, part], back[..., part])
    return out
