"""Which rays from receivers to suns may meet what is inside a ball: the others need not be traced.

A ray can only meet a ball if the ball's centre lies within its radius of the ray, ahead of it or around its origin.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.parts import in_parts


def may_meet(
    positions: NDArray[np.float64],
    directions: NDArray[np.float64],
    center: NDArray[np.float64],
    radius: float,
    open_: NDArray[np.bool_],
    threads: int = 1,
) -> NDArray[np.bool_]:
    """Which of the rays that are still open (n, K), from positions (n, 3) in directions (K, 3), may meet a ball."""
    out = np.zeros(open_.shape, np.bool_)
    p = np.ascontiguousarray(positions, np.float64)
    in_parts(lambda a, b: _may_meet(p[a:b], directions, center, radius, open_[a:b], out[a:b]), len(p), threads)
    return out


@njit(cache=True, nogil=True)
def _may_meet(positions, directions, center, radius, open_, out):  # type: ignore[no-untyped-def]
    for i in range(len(positions)):
        x, y, z = center[0] - positions[i, 0], center[1] - positions[i, 1], center[2] - positions[i, 2]
        far2 = x * x + y * y + z * z
        for k in range(len(directions)):
            if open_[i, k]:
                along = x * directions[k, 0] + y * directions[k, 1] + z * directions[k, 2]
                inside = far2 <= radius * radius
                out[i, k] = inside or (along > 0.0 and far2 - along * along <= radius * radius)
