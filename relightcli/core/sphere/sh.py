"""Real orthonormal spherical harmonics without the Condon-Shortley phase, index l (l + 1) + m.

"Order n" means the bands 0 to n - 1, n^2 coefficients.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from relightcli.core.sphere import cube


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
    """
    resolution = bits.shape[2]
    seen = np.unpackbits(bits.reshape(len(bits), -1), axis=1, bitorder="little").astype(np.float32)
    moments = (seen @ _moment_basis(resolution, order)).reshape(len(bits), 3, order * order)
    out: NDArray[np.float32] = np.einsum("nxi,nx->ni", moments, normals) / np.float32(np.pi)
    return out


def project_sky(flux: NDArray[np.float64], resolution: int, order: int) -> NDArray[np.float64]:
    """L_i = sum over texels of the flux times y_i at the texel's centre, (order^2, 3). flux (6 R R, 3)."""
    directions = cube.texel_directions(resolution).reshape(-1, 3)
    return harmonics(directions, order).T @ flux
