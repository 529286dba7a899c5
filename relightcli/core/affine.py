"""Affine maps of meshes: points by M, normals by its inverse transpose, and winding so that fronts stay fronts."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


def compose(translate: F64, axis: F64, degrees: float, scale: F64) -> F64:
    """Matrix that scales, then rotates, then translates: T R S.

    translate (3,); axis (3,), any non-zero length; degrees, right-handed about `axis`; scale (3,), non-zero.
    Returns (4, 4) float64, row-major, for column vectors.
    Source: Rodrigues' rotation formula, R = I + sin(a) K + (1 - cos(a)) K^2.
    """
    unit = axis / np.abs(axis).max()
    x, y, z = unit / math.sqrt(float(unit @ unit))
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # Quarter turns come out exact, so that an axis-aligned box stays axis-aligned.
    turn = math.remainder(degrees, 360.0)
    quarter = {0.0: (0.0, 0.0), 90.0: (1.0, 1.0), -90.0: (-1.0, 1.0), 180.0: (0.0, 2.0), -180.0: (0.0, 2.0)}
    angle = math.radians(turn)
    # 1 - cos(a) as 2 sin(a/2)^2, which keeps its digits where a is small.
    sin, height = quarter.get(turn, (math.sin(angle), 2.0 * math.sin(0.5 * angle) ** 2))
    matrix = np.eye(4)
    matrix[:3, :3] = (np.eye(3) + sin * cross + height * (cross @ cross)) * scale
    matrix[:3, 3] = translate
    return matrix


def normal_matrix(linear: F64) -> F64:
    """The direction of (M^-1)^T: sign(det M) times M's cofactor matrix, of largest entry about 1.

    linear (3, 3). Needs no division, so it holds for scales whose determinant underflows.
    """
    m = linear / max(float(np.abs(linear).max()), np.finfo(np.float64).tiny)
    cofactor = np.stack([np.cross(m[1], m[2]), np.cross(m[2], m[0]), np.cross(m[0], m[1])])
    largest = float(np.abs(cofactor).max())
    if largest > 0.0:
        cofactor = cofactor / largest
    return -cofactor if is_mirror(linear) else cofactor


def is_mirror(linear: F64) -> bool:
    """Whether (3, 3) `linear` turns a right hand into a left one: det < 0."""
    m = linear / max(float(np.abs(linear).max()), np.finfo(np.float64).tiny)
    return float(m[0] @ np.cross(m[1], m[2])) < 0.0


def is_singular(linear: F64, limit: float = 1e14) -> bool:
    """Whether (3, 3) `linear` flattens space: the ratio of its singular values is above `limit`."""
    singular = np.linalg.svd(linear, compute_uv=False)
    return not float(singular[-1]) * limit > float(singular[0])


def unit(vectors: F64) -> F64:
    """Vectors (N, 3) at unit length; zero and non-finite ones become zero. Safe from over- and underflow."""
    largest = np.abs(vectors).max(axis=1, initial=0.0, keepdims=True)
    good = np.isfinite(largest) & (largest > 0.0)
    scaled = np.where(good, vectors, 0.0) / np.where(good, largest, 1.0)
    length = np.sqrt(np.einsum("ij,ij->i", scaled, scaled))[:, None]
    return np.asarray(scaled / np.where(length > 0.0, length, 1.0))


def transform_mesh(
    matrix: F64, positions: F64, normals: F64, faces: NDArray[np.int32]
) -> tuple[F64, F64, NDArray[np.int32]]:
    """A mesh under an affine map.

    matrix (4, 4) row-major, its last row 0 0 0 1, not singular; positions (V, 3); normals (V, 3), unit or zero;
    faces (F, 3). Returns positions M p, unit normals along (M^-1)^T n, and faces, whose winding is reversed where the
    map mirrors, so that a counter-clockwise front stays one.
    """
    if np.array_equal(matrix, np.eye(4)):
        return positions, normals, faces
    linear = matrix[:3, :3]
    moved = positions @ linear.T + matrix[:3, 3]
    turned = unit(normals @ normal_matrix(linear).T)
    return moved, turned, np.ascontiguousarray(faces[:, ::-1]) if is_mirror(linear) else faces
