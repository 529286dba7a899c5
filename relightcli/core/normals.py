"""Face areas and vertex normals of an indexed triangle mesh, at any scale."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from relightcli.core.affine import unit

F64 = NDArray[np.float64]

# A face whose height is below this share of its longest edge has no normal that float64 could tell.
FLAT = 1e-12


def _corners(positions: F64, faces: NDArray[np.int32]) -> F64:
    """(F, 3, 3) corner positions, recentred on the first corner's mean and scaled to about 1."""
    used = positions[faces]
    if len(used) == 0:
        return used
    low, high = used.min(axis=(0, 1)), used.max(axis=(0, 1))
    extent = float(np.max(high - low))
    return np.asarray((used - 0.5 * (low + high)) / (extent if extent > 0.0 else 1.0))


def degenerate_faces(positions: F64, faces: NDArray[np.int32]) -> NDArray[np.bool_]:
    """True (F,) for faces without area: a corner used twice, corners at one place, or all on one line.

    positions (V, 3) finite; faces (F, 3) in range. A face counts as a line when its height is below 1e-12 of its
    longest edge.
    """
    p = _corners(positions, faces)
    edges = np.roll(p, -1, axis=1) - p
    longest2 = np.einsum("fij,fij->fi", edges, edges).max(axis=1, initial=0.0)
    # Scaled per face, so that small faces of a large mesh do not underflow.
    safe = np.sqrt(np.where(longest2 > 0.0, longest2, 1.0))[:, None]
    cross = np.cross(edges[:, 0] / safe, -edges[:, 2] / safe)
    return np.asarray((longest2 <= 0.0) | (np.einsum("fi,fi->f", cross, cross) <= FLAT * FLAT))


def vertex_normals(positions: F64, faces: NDArray[np.int32]) -> F64:
    """Angle-weighted vertex normals: n_v = sum over the faces at v of (corner angle at v) x (unit face normal).

    positions (V, 3) finite; faces (F, 3) in range, none degenerate. Returns (V, 3) float64, unit. Where the sum
    cancels, the normal of the vertex's first face; for a vertex that no face uses, +Y.
    Source: Thuermer and Wuethrich 1998, Computing Vertex Normals from Polygonal Facets.
    """
    count = len(positions)
    p = _corners(positions, faces)
    ahead = unit((np.roll(p, -1, axis=1) - p).reshape(-1, 3)).reshape(-1, 3, 3)
    behind = -np.roll(ahead, 1, axis=1)
    face_normal = unit(np.cross(ahead[:, 0], behind[:, 0]))
    # atan2 keeps small and straight angles accurate where arccos would not.
    sine = np.linalg.norm(np.cross(ahead, behind), axis=2)
    angle = np.arctan2(sine, np.einsum("fij,fij->fi", ahead, behind))
    corner_vertex = faces.reshape(-1)
    weight = np.bincount(corner_vertex, angle.reshape(-1), minlength=count)
    total = np.empty((count, 3))
    for axis in range(3):
        weighted = (angle * face_normal[:, axis, None]).reshape(-1)
        total[:, axis] = np.bincount(corner_vertex, weighted, minlength=count)
    # Below this share of the summed angles only rounding is left.
    cancelled = np.linalg.norm(total, axis=1) <= 1e-10 * weight
    total[cancelled] = (0.0, 1.0, 0.0)
    first = np.full(count, -1)
    first[corner_vertex[::-1]] = np.repeat(np.arange(len(faces)), 3)[::-1]
    fallback = cancelled & (first >= 0)
    total[fallback] = face_normal[first[fallback]]
    return unit(total)
