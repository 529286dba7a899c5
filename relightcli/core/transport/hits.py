"""What stands where the sky is blocked: for every receiver and cell of a coarse cube, the receiver behind it.

The cube's texels are gathered into cells, 6 x C x C. Where any texel of a cell is above the horizon and blocked, one
ray goes through one such texel; it ends on a face, and one of the face's three corners is kept, drawn with its
barycentric weight. Summed over many rays that is linear interpolation on the face, with a third of the look-ups.

Light that was reflected before arrives through exactly the blocked texels, the sky through the others: together they
make up the hemisphere, whatever C is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.sphere import cube
from relightcli.core.transport.tracer import Tracer

BATCH = 256  # receivers whose rays are traced together


class Surfaces(NamedTuple):
    """The mesh, and who receives on it.

    positions (V, 3) float64; normals (V, 3) float32; faces (F, 3) int32; two_sided (F,) bool;
    front, back (V,) int32: receiver on either side of a vertex, -1 where there is none
    buried (N,) bool: receivers that the others of their face stand in for
    """

    positions: NDArray[np.float64]
    normals: NDArray[np.float32]
    faces: NDArray[np.int32]
    two_sided: NDArray[np.bool_]
    front: NDArray[np.int32]
    back: NDArray[np.int32]
    buried: NDArray[np.bool_]


def trace_hits(
    tracer: Tracer,
    surfaces: Surfaces,
    positions: NDArray[np.float64],
    normals: NDArray[np.float32],
    bits: NDArray[np.uint8],
    cells: int,
    first: int,
    seed: int,
) -> tuple[NDArray[np.int32], int]:
    """Receivers behind the blocked cells, (N, 6, C, C) int32, and the number of rays.

    An entry is the receiver's index plus 1; 0 where nothing blocks the cell, or where what blocks it sends nothing: its
    back, or a surface whose shading normal looks away. positions (N, 3), normals (N, 3), bits (N, 6, R, R/8) of the
    receivers `first` to `first + N`; `cells` C divides R. The result hangs on `seed` and the receivers' indices alone.
    """
    resolution = bits.shape[2]
    directions = cube.texel_directions(resolution).reshape(-1, 3).astype(np.float32)
    words = np.ascontiguousarray(bits).reshape(len(bits), -1)
    normals = np.ascontiguousarray(normals, np.float32)
    out = np.zeros((len(bits), 6 * cells * cells), np.int32)
    rays = 0
    for start in range(0, len(bits), BATCH):
        rows = slice(start, min(start + BATCH, len(bits)))
        origins = tracer.offset(positions[rows], normals[rows])
        owner, cell, texel = _choose(words[rows], normals[rows], directions, resolution, cells, first + start, seed)
        towards = directions[texel]
        hits = tracer.intersect(origins[owner], towards)
        _keep(surfaces, hits.face, hits.u, hits.v, towards, owner, cell, first + start, seed, out[rows])
        rays += len(owner)
    return out.reshape(len(bits), 6, cells, cells), rays


@njit(cache=True)
def _hash(seed, receiver, cell, salt):  # type: ignore[no-untyped-def]
    """64 evenly distributed bits of four integers (splitmix64's finisher over their sum of odd multiples)."""
    z = (
        np.uint64(seed) * np.uint64(0xD6E8FEB86659FD93)
        + np.uint64(receiver) * np.uint64(0x9E3779B97F4A7C15)
        + np.uint64(cell) * np.uint64(0xC2B2AE3D27D4EB4F)
        + np.uint64(salt) * np.uint64(0x165667B19E3779F9)
    )
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(cache=True)
def _choose(words, normals, directions, resolution, cells, first, seed):  # type: ignore[no-untyped-def]
    """One blocked texel above the horizon of every cell that has any: (receiver of the batch, cell, texel)."""
    side = resolution // cells
    n = len(words)
    capacity = n * 6 * cells * cells
    owner = np.empty(capacity, np.int32)
    cell = np.empty(capacity, np.int32)
    texel = np.empty(capacity, np.int32)
    blocked = np.empty(side * side, np.int32)
    count = 0
    for i in range(n):
        for c in range(6 * cells * cells):
            face, row, column = c // (cells * cells), (c // cells) % cells, c % cells
            found = 0
            for a in range(side):
                t = (face * resolution + row * side + a) * resolution + column * side
                for b in range(side):
                    if (words[i, (t + b) >> 3] >> np.uint8((t + b) & 7)) & np.uint8(1):
                        continue
                    d = directions[t + b]
                    if normals[i, 0] * d[0] + normals[i, 1] * d[1] + normals[i, 2] * d[2] > np.float32(0.0):
                        blocked[found] = t + b
                        found += 1
            if found > 0:
                owner[count], cell[count] = i, c
                texel[count] = blocked[_hash(seed, first + i, c, 0) % np.uint64(found)]
                count += 1
    return owner[:count], cell[:count], texel[:count]


@njit(cache=True)
def _keep(surfaces, face, u, v, towards, owner, cell, first, seed, out):  # type: ignore[no-untyped-def]
    p, q = surfaces.positions, surfaces.normals
    for r in range(len(owner)):
        f = face[r]
        if f < 0:
            continue
        a, b, c = surfaces.faces[f, 0], surfaces.faces[f, 1], surfaces.faces[f, 2]
        e1 = (p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2])
        e2 = (p[c, 0] - p[a, 0], p[c, 1] - p[a, 1], p[c, 2] - p[a, 2])
        g = (e1[1] * e2[2] - e1[2] * e2[1], e1[2] * e2[0] - e1[0] * e2[2], e1[0] * e2[1] - e1[1] * e2[0])
        facing = -(g[0] * towards[r, 0] + g[1] * towards[r, 1] + g[2] * towards[r, 2])
        if not facing > 0.0 and not (surfaces.two_sided[f] and facing < 0.0):
            continue
        side = 1.0 if facing > 0.0 else -1.0
        s, t = float(u[r]), float(v[r])
        w = 1.0 - s - t
        looking = 0.0
        for k in range(3):
            looking -= (w * q[a, k] + s * q[b, k] + t * q[c, k]) * towards[r, k]
        if not side * looking > 0.0:
            continue
        of_vertex = surfaces.front if side > 0.0 else surfaces.back
        i, j, k = of_vertex[a], of_vertex[b], of_vertex[c]
        if surfaces.buried[i] + surfaces.buried[j] + surfaces.buried[k] < 3:
            w = 0.0 if surfaces.buried[i] else w
            s = 0.0 if surfaces.buried[j] else s
            t = 0.0 if surfaces.buried[k] else t
        x = (_hash(seed, first + owner[r], cell[r], 1) >> np.uint64(11)) * 2.0**-53 * (w + s + t)
        out[owner[r], cell[r]] = (i if x < w else (j if x < w + s else k)) + 1
