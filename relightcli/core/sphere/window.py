"""Windows against ringing: bands scaled as if the function were smoothed with a kernel that is nowhere negative.

A function cut to order n rings: the cut of one between 0 and 1 goes below and above. Scaled by the bands of a kernel
k(cos) >= 0 of the same order with integral 1 it is a weighted mean of the original, and lies between 0 and 1 again. The
kernel here keeps most of band 1: by Lukacs' theorem k(x) = (1 + x) q(x)^2 or q(x)^2, and the largest mean of x under
such a k is the largest root of an orthogonal polynomial.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray


@lru_cache(maxsize=16)
def _bands(order: int) -> NDArray[np.float64]:
    """lambda_l (order,), 1 at l = 0: the Legendre means of the kernel."""
    from scipy.special import roots_jacobi

    degree = order - 1
    points = degree // 2 + 1  # q's degree plus one
    odd = degree % 2
    # The kernel that maximises the mean of x: q vanishes at all roots but the largest.
    roots, _ = roots_jacobi(points, 0, odd)
    x, w = np.polynomial.legendre.leggauss(order + 1)
    q = np.prod([(x - r) for r in roots[:-1]], axis=0) if points > 1 else np.ones_like(x)
    kernel = w * q * q * ((1.0 + x) if odd else 1.0)
    values = np.array([kernel @ np.polynomial.legendre.Legendre.basis(band)(x) for band in range(order)])
    return values / values[0]


def window(order: int, strength: float = 1.0) -> NDArray[np.float64]:
    """Factors (order^2,) of the coefficients: at strength 1 those of the kernel, at 0 all 1, between them in between
    (linear: a mixture of the function and its mean, negative values shrink in proportion)."""
    bands = 1.0 + strength * (_bands(order) - 1.0)
    return np.repeat(bands, 2 * np.arange(order) + 1)
