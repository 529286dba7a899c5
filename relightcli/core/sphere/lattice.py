"""A fixed point set that covers the unit square evenly, also along any axis."""

from __future__ import annotations

from numba import njit


@njit(cache=True, nogil=True)
def r2_point(k: int) -> tuple[float, float]:
    """Point k of the R2 sequence in [0, 1)^2: fractional parts of 1/2 + k / g and 1/2 + k / g^2, g^3 = g + 1.
    [Roberts 2018, The Unreasonable Effectiveness of Quasirandom Sequences]"""
    return (0.5 + 0.7548776662466927 * k) % 1.0, (0.5 + 0.5698402909980532 * k) % 1.0
