"""Cube maps: faces +X -X +Y -Y +Z -Z in OpenGL's order and orientation, with exact solid angles.

A point of a face has coordinates s (to the right) and t (downwards) in [-1, 1]; texel (row i, column j) of an R x R
face has its centre at s = (2j + 1)/R - 1, t = (2i + 1)/R - 1. Flat texel index: (face R + row) R + column.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

# Direction of face point (s, t): axis + s * right + t * down. Rows: +X -X +Y -Y +Z -Z.
FACE_AXIS: NDArray[np.float64] = np.array(
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64
)
FACE_RIGHT: NDArray[np.float64] = np.array(
    [[0, 0, -1], [0, 0, 1], [1, 0, 0], [1, 0, 0], [1, 0, 0], [-1, 0, 0]], np.float64
)
FACE_DOWN: NDArray[np.float64] = np.array(
    [[0, -1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0, -1, 0], [0, -1, 0]], np.float64
)


def texel_centers(resolution: int) -> NDArray[np.float64]:
    """Face coordinate of texel centres, (R,) float64 in (-1, 1)."""
    return (2.0 * np.arange(resolution) + 1.0) / resolution - 1.0


def face_directions(face: int, s: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit directions (..., 3) of the points (s, t) of one face; s and t broadcast."""
    s, t = np.broadcast_arrays(s, t)
    d = FACE_AXIS[face] + s[..., None] * FACE_RIGHT[face] + t[..., None] * FACE_DOWN[face]
    return d / np.sqrt(1.0 + s * s + t * t)[..., None]


def texel_directions(resolution: int) -> NDArray[np.float64]:
    """Unit directions of all texel centres, (6, R, R, 3) float64."""
    c = texel_centers(resolution)
    return np.stack([face_directions(face, c[None, :], c[:, None]) for face in range(6)])


@lru_cache(maxsize=8)
def solid_angles(resolution: int) -> NDArray[np.float64]:
    """Exact solid angle of the texels of one face, (R, R) float64, sr; the same for every face, 6 faces sum to 4 pi.

    Read-only: it is made once.
    """
    # Odd and even numerators over R: edges, and their distances, free of rounding where R is a power of two.
    edge = (2.0 * np.arange(resolution + 1) - resolution) / resolution
    low, high, width = edge[:-1], edge[1:], 2.0 / resolution
    found = rectangle_solid_angles(low[None, :], high[None, :], low[:, None], high[:, None], width * width)
    found.flags.writeable = False
    return found


def rectangle_solid_angles(
    s0: NDArray[np.float64],
    s1: NDArray[np.float64],
    t0: NDArray[np.float64],
    t1: NDArray[np.float64],
    area: NDArray[np.float64] | float,
) -> NDArray[np.float64]:
    """Solid angles (...) of rectangles s0..s1, t0..t1 of a face, of `area` (s1 - s0)(t1 - t0), sr; all broadcast.

    Two triangles, tan(Omega/2) = |a . (b x c)| / (|a||b||c| + (a.b)|c| + (b.c)|a| + (c.a)|b|) [Van Oosterom 1983]: the
    triple product of corners (s, t, 1) is the rectangle's area, so that nothing cancels, however small it is. The
    difference of four arcus tangents at the corners loses six digits at 4096 texels a side.
    """
    a, b, c, d = (1.0 + s * s + t * t for s, t in ((s0, t0), (s1, t0), (s1, t1), (s0, t1)))
    la, lb, lc, ld = np.sqrt(a), np.sqrt(b), np.sqrt(c), np.sqrt(d)
    ss, tt = 1.0 + s0 * s1, 1.0 + t0 * t1
    ab, bc = ss + t0 * t0, tt + s1 * s1
    cd, da = ss + t1 * t1, tt + s0 * s0
    ac = ss + t0 * t1
    one = la * lb * lc + ab * lc + bc * la + ac * lb
    two = la * lc * ld + ac * ld + cd * la + da * lc
    found: NDArray[np.float64] = 2.0 * (np.arctan2(area, one) + np.arctan2(area, two))
    return found


def texel_index(directions: NDArray[np.floating], resolution: int) -> NDArray[np.int64]:
    """Flat index (...,) of the texel that holds each direction (..., 3). Directions need not be unit, but not zero."""
    d = np.asarray(directions, np.float64)
    major = np.argmax(np.abs(d), axis=-1)
    along = np.take_along_axis(d, major[..., None], axis=-1)[..., 0]
    face = 2 * major + (along < 0)
    inverse = 1.0 / np.abs(along)
    s = np.einsum("...i,...i->...", d, FACE_RIGHT[face]) * inverse
    t = np.einsum("...i,...i->...", d, FACE_DOWN[face]) * inverse
    column = np.clip(np.floor((s + 1.0) * (0.5 * resolution)).astype(np.int64), 0, resolution - 1)
    row = np.clip(np.floor((t + 1.0) * (0.5 * resolution)).astype(np.int64), 0, resolution - 1)
    return (face * resolution + row) * resolution + column


def block_sums(values: NDArray[np.float64], resolution: int, shrink: int) -> NDArray[np.float64]:
    """Sums of texel values (6 R R, k) over squares of `shrink` texels a side, a power of two: (6 (R/shrink)^2, k)."""
    found = values.reshape(6, resolution, resolution, -1)
    while shrink > 1:
        found = found[:, ::2] + found[:, 1::2]
        found = found[:, :, ::2] + found[:, :, 1::2]
        shrink //= 2
    return found.reshape(-1, values.shape[1])


def neighbours(resolution: int) -> NDArray[np.int32]:
    """The up to eight neighbours of every texel, across face borders too: (6 R R, 8) int32.

    Beyond a border the neighbour is the texel that the straight continuation of the face plane points at; at the
    eight corners of the cube, where only seven texels meet, one neighbour appears twice.
    """
    c = texel_centers(resolution)
    step = 2.0 / resolution
    out = np.empty((6, resolution, resolution, 8), np.int32)
    k = 0
    for di in (-1, 0, 1):
        for dj in (-1, 0, 1):
            if di == 0 and dj == 0:
                continue
            for face in range(6):
                d = face_directions(face, c[None, :] + dj * step, c[:, None] + di * step)
                out[face, :, :, k] = texel_index(d, resolution)
            k += 1
    return out.reshape(-1, 8)
