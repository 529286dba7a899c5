"""What every vertex of a posed character sees, in its own frame, as spherical harmonics.

    v_i = integral over the sphere of V(w) y_i(w) dw

with V = 1 where n . w > 0 and nothing lies along w, and 0 elsewhere; no cosine [Nowrouzezahrai 2008, 3.1]. The frame of
a vertex has its tangent as x axis, normal x tangent as y and the normal as z, and moves with the skin, so that what an
upper arm sees of the sky changes little as the whole arm turns.

The back of a membrane, or of a surface that is lit from both sides, is a surface of its own that looks along -normal:
what it passes on is int L V_back max(0, -n . w) dw, and V_back is traced from that side of the skin, in the vertex's
frame turned by half a turn about the tangent, so that all that is known of fronts holds for backs as well.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.sphere.sh import harmonics
from relightcli.core.transport.tracer import Tracer

F64 = NDArray[np.float64]
RAYS = 1 << 19  # traced at a time


def hemisphere_directions(count: int) -> F64:
    """Directions (count, 3) float64, z > 0, that share the hemisphere's solid angle evenly: Fibonacci's lattice."""
    k = np.arange(count) + 0.5
    z = 1.0 - k / count
    radius = np.sqrt(1.0 - z * z)
    azimuth = 2.0 * np.pi * k / (0.5 * (1.0 + math.sqrt(5.0)))
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def hemisphere_harmonics(order: int) -> F64:
    """Coefficients (order^2,) of the whole hemisphere z > 0, V = 1 there: 2 pi K_l times P_l's integral over 0..1."""
    z, weight = np.polynomial.legendre.leggauss(order + 1)  # exact to degree 2 order + 1
    z, weight = 0.5 * (z + 1.0), 0.5 * weight
    zonal = harmonics(np.stack([np.sqrt(1.0 - z * z), 0.0 * z, z], axis=1), order)
    out = np.zeros(order * order)
    for band in range(order):
        index = band * (band + 1)
        out[index] = 2.0 * np.pi * (weight * zonal[:, index]).sum()
    return out


def trace_visibility(
    tracer: Tracer, position: F64, normal: F64, tangent: F64, directions: F64, order: int
) -> tuple[NDArray[np.float32], int]:
    """Coefficients (V, order^2) float32 of V vertices, and the number of rays.

    position, normal, tangent (V, 3) float64, world, the last two unit and orthogonal; directions (D, 3), of equal
    share, in the vertices' frames: every one of them is traced. What is blocked is summed and taken off the whole
    hemisphere, which is known exactly: a vertex that nothing blocks has no error.
    """
    basis = harmonics(directions, order)
    whole = hemisphere_harmonics(order)
    local = np.ascontiguousarray(directions, np.float64)
    out = np.empty((len(position), order * order), np.float32)
    step = max(1, RAYS // len(directions))
    for start in range(0, len(position), step):
        rows = slice(start, start + step)
        origins = np.repeat(tracer.offset(position[rows], normal[rows]), len(directions), axis=0)
        towards = _to_world(normal[rows], tangent[rows], local)
        blocked = tracer.occluded(origins, towards)
        out[rows] = _seen(blocked.reshape(-1, len(directions)), basis, whole)
    return out, len(position) * len(directions)


def both_sides(position: F64, normal: F64, tangent: F64) -> tuple[F64, F64, F64]:
    """Fronts of V vertices, then their backs: (2 V, 3) each, as `trace_visibility` takes them."""
    return np.concatenate([position] * 2), np.concatenate([normal, -normal]), np.concatenate([tangent] * 2)


@njit(cache=True)
def _to_world(normal, tangent, local):  # type: ignore[no-untyped-def]
    """Directions (V * D, 3) float32 of a set (D, 3) in V frames."""
    out = np.empty((len(normal) * len(local), 3), np.float32)
    row = 0
    for v in range(len(normal)):
        nx, ny, nz = normal[v]
        tx, ty, tz = tangent[v]
        bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
        for d in range(len(local)):
            x, y, z = local[d]
            out[row, 0] = x * tx + y * bx + z * nx
            out[row, 1] = x * ty + y * by + z * ny
            out[row, 2] = x * tz + y * bz + z * nz
            row += 1
    return out


@njit(cache=True)
def _seen(blocked, basis, whole):  # type: ignore[no-untyped-def]
    """whole - (2 pi / D) (sum of the basis over the blocked directions), (V, S) float32."""
    count, size = basis.shape
    out = np.empty((len(blocked), size), np.float32)
    total = np.empty(size)
    for v in range(len(blocked)):
        total[:] = 0.0
        for d in range(count):
            if blocked[v, d]:
                for i in range(size):
                    total[i] += basis[d, i]
        for i in range(size):
            out[v, i] = whole[i] - (2.0 * math.pi / count) * total[i]
    return out
