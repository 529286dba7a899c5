"""Which texels of the sky a vertex sees, from a few bands of its visibility.

Visibility is 0 or 1, and so is what is made of its bands v again:

    V(w) = 1 where n . w > 0 and sum of v_i y_i(w) > 1/2, else 0.

Bands of an open hemisphere are above 1/2 all over it, so that it comes back as it was; where something is in the way,
the edge comes back where the bands have it. Any lobe can be integrated over such texels, however narrow; a lobe that is
cut to the bands of light times visibility is as wide as those, and rings.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.parts import in_parts
from relightcli.core.sphere import cube, sh


def seen_bits(
    visibility: NDArray[np.float32], normals: NDArray[np.float32], resolution: int, threads: int = 1
) -> NDArray[np.uint8]:
    """Bits (V, 6, R, R/8), as `core.transport.visibility` has them.

    visibility (V, n^2) and normals (V, 3) in the world's frame; resolution R a multiple of 8.
    """
    directions = cube.texel_directions(resolution).reshape(-1, 3)
    basis = sh.harmonics(directions, math.isqrt(visibility.shape[1]))
    rows = np.concatenate([basis, directions], axis=1).T.astype(np.float32)
    out = np.zeros((len(visibility), len(directions) // 8), np.uint8)

    def part(a: int, b: int) -> None:
        _seen(visibility, normals, np.ascontiguousarray(rows), a, b, out)

    in_parts(part, len(out), threads)
    return out.reshape(len(out), 6, resolution, resolution // 8)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _seen(visibility, normals, rows, first, last, out):  # type: ignore[no-untyped-def]
    size, count = visibility.shape[1], rows.shape[1]
    value, height = np.empty(count, np.float32), np.empty(count, np.float32)
    for v in range(first, last):
        value[:] = np.float32(-0.5)
        for i in range(size):
            for c in range(count):
                value[c] += visibility[v, i] * rows[i, c]
        for c in range(count):
            height[c] = (
                normals[v, 0] * rows[size, c] + normals[v, 1] * rows[size + 1, c] + normals[v, 2] * rows[size + 2, c]
            )
        for byte in range(count // 8):
            bits = np.uint8(0)
            for k in range(8):
                c = 8 * byte + k
                if value[c] > np.float32(0.0) and height[c] > np.float32(0.0):
                    bits |= np.uint8(1) << np.uint8(k)
            out[v, byte] = bits
