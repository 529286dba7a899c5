"""Large faces cut into smaller ones, so that vertices are close enough together to carry shadows.

Light is known at vertices and interpolated between them; the shadow of a ball on a ground of two triangles would fall
between four vertices and be lost. An edge is halved while it is longer than

    h(p) = min(D / OBJECT_PARTS, max(D' / NEAR_PARTS, SLOPE d))

with D the diagonal of its object, D' that of any other one and d the distance from its middle p to that other one:
shadows are sharp near what casts them and soften with distance. The shape does not change, nor do the first vertices;
neighbouring faces stay joined, because they share the cut edges. Skinned objects keep their faces: those move.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from relightcli.scene.model import Geometry

F64 = NDArray[np.float64]

OBJECT_PARTS = 32.0
NEAR_PARTS = 48.0
SLOPE = 0.1
MOST_NEW_VERTICES = 40_000
MOST_ROUNDS = 40


def tessellate(geometry: Geometry, whole: Collection[int] = ()) -> Geometry:
    """The same scene with no edge longer than h; new vertices come after the old ones. The same object if none is.

    Objects of the indices `whole` are not cut, but others are near them.
    Where that would take more than MOST_NEW_VERTICES, h is widened until it does not.
    """
    diagonals = _diagonals(geometry)
    finer = refine(geometry, _Limit(geometry, diagonals, near=False, whole=whole))
    if len(geometry.object_names) > 1:
        finer = refine(finer, _Limit(finer, diagonals, near=True, whole=whole))
    return unit_normals(geometry, finer)


class Limit(Protocol):
    """How long edges may be. `floor` (O,): no edge of an object that is shorter is beyond the limit."""

    floor: F64

    def exceeded(self, middle: F64, length: F64, owner: NDArray[np.int32], turn: F64) -> NDArray[np.bool_]:
        """Of edges by middle (M, 3), length (M,), object (M,) and angle between the ends' normals (M,), rad: beyond?"""


def unit_normals(before: Geometry, after: Geometry) -> Geometry:
    """Normals that `refine` has interpolated, normalised; where they cancelled, some unit vector."""
    if after is before:
        return after
    count = len(before.positions)
    normals = after.normals.copy()
    size = np.linalg.norm(normals[count:].astype(np.float64), axis=1, keepdims=True)
    unit = np.where(size > 1e-6, normals[count:] / np.maximum(size, 1e-6), [0.0, 1.0, 0.0])
    normals[count:] = unit
    return replace(after, normals=normals)


def _diagonals(geometry: Geometry) -> NDArray[np.float64]:
    out = np.zeros(len(geometry.object_names))
    for k in range(len(out)):
        corners = geometry.positions[geometry.faces[geometry.face_object == k].reshape(-1)]
        if len(corners):
            out[k] = float(np.linalg.norm(np.ptp(corners, axis=0)))
    return out


class _Limit:
    """h, without or with the part that looks at other objects' vertices. `floor` (O,): the least it can be."""

    def __init__(
        self, geometry: Geometry, diagonals: NDArray[np.float64], near: bool, whole: Collection[int] = ()
    ) -> None:
        self.whole = np.isin(np.arange(len(diagonals)), list(whole))
        self.whole |= np.array([name in geometry.rigs for name in geometry.object_names], bool)
        self.widest = np.where(self.whole, np.inf, diagonals / OBJECT_PARTS)
        self.nearest = diagonals / NEAR_PARTS
        self.floor = self.widest.copy()
        self.trees: list[Any] = []
        if not near:
            return
        from scipy.spatial import cKDTree

        for k in range(len(diagonals)):
            used = np.unique(geometry.faces[geometry.face_object == k])
            self.trees.append(cKDTree(geometry.positions[used]))
            others = np.arange(len(diagonals)) != k
            self.floor[others] = np.minimum(self.floor[others], self.nearest[k])
        self.floor[self.whole] = np.inf

    def exceeded(self, middle: F64, length: F64, owner: NDArray[np.int32], turn: F64) -> NDArray[np.bool_]:
        """Whether edges of this length (M,), middle (M, 3) and object (M,) are longer than h."""
        out: NDArray[np.bool_] = length > self.widest[owner]
        for k, tree in enumerate(self.trees):
            # The box around an object is nearer than the object: most edges need no search.
            outside = np.maximum(np.maximum(tree.mins - middle, middle - tree.maxes), 0.0)
            least = np.maximum(self.nearest[k], SLOPE * np.linalg.norm(outside, axis=1))
            ask = np.flatnonzero(~out & (owner != k) & ~self.whole[owner] & (length > least))
            if len(ask):
                out[ask] = length[ask] > np.maximum(self.nearest[k], SLOPE * tree.query(middle[ask])[0])
        return out


def refine(geometry: Geometry, limit: Limit) -> Geometry:
    """Edges halved until none is beyond the limit; normals of new vertices are linear between the old ones, not unit.

    Where that would take more than MOST_NEW_VERTICES, the limit is widened until it does not.
    """
    widen = 1.0
    while (out := _cut(geometry, limit, widen)) is None:
        widen *= 1.5
    return out


def _cut(geometry: Geometry, limit: Limit, widen: float) -> Geometry | None:
    """Halves edges until none is above `widen` times its limit; None where that takes too many vertices."""
    positions, normals, uvs = geometry.positions, geometry.normals, geometry.uvs
    vertex_object = geometry.vertex_object
    faces, owner = geometry.faces.astype(np.int64), geometry.face_object
    settled: list[tuple[NDArray[np.int64], NDArray[np.int32]]] = []
    short = np.zeros(0, np.int64)  # edges found short enough
    for _ in range(MOST_ROUNDS):
        ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)  # (F, 3, 2)
        side = np.linalg.norm(positions[ends[..., 0]] - positions[ends[..., 1]], axis=2)
        # Only faces with an edge above the least limit can be cut, or touch one that is.
        open_faces = side.max(axis=1) > widen * limit.floor[owner]
        settled.append((faces[~open_faces], owner[~open_faces]))
        faces, owner, ends = faces[open_faces], owner[open_faces], ends[open_faces]
        key = np.sort(ends.reshape(-1, 2), axis=1)
        edges, inverse = np.unique(key[:, 0] << 32 | key[:, 1], return_inverse=True)
        a, b = edges >> 32, edges & 0xFFFFFFFF
        middle = 0.5 * (positions[a] + positions[b])
        length = np.linalg.norm(positions[a] - positions[b], axis=1)
        fresh = np.flatnonzero(~np.isin(edges, short, assume_unique=True))
        marked = np.zeros(len(edges), bool)
        turn = angle_between(normals[a[fresh]], normals[b[fresh]])
        marked[fresh] = limit.exceeded(middle[fresh], length[fresh] / widen, vertex_object[a[fresh]], turn / widen)
        if not marked.any():
            break
        short = np.concatenate([short, edges[fresh][~marked[fresh]]])
        of_face = inverse.reshape(-1, 3)
        longest = np.argmax(length[of_face], axis=1)
        top = of_face[np.arange(len(faces)), longest]
        # A face that is cut is cut at its longest edge first: angles stay bounded. [Rivara 1984]
        while (need := marked[of_face].any(axis=1) & ~marked[top]).any():
            marked[top[need]] = True
        if len(positions) + int(marked.sum()) > len(geometry.positions) + MOST_NEW_VERTICES:
            return None
        number = np.full(len(marked), -1, np.int64)
        number[marked] = len(positions) + np.arange(int(marked.sum()))
        faces, owner = _split(faces, owner, of_face, longest, number)
        a, b = a[marked], b[marked]
        positions = np.concatenate([positions, middle[marked]])
        normals = np.concatenate([normals, 0.5 * (normals[a] + normals[b])])
        uvs = np.concatenate([uvs, (0.5 * (uvs[a] + uvs[b])).astype(np.float32)])
        vertex_object = np.concatenate([vertex_object, vertex_object[a]])
    if len(positions) == len(geometry.positions):
        return geometry
    faces = np.concatenate([*(f for f, _ in settled), faces])
    owner = np.concatenate([*(o for _, o in settled), owner])
    order = np.argsort(owner, kind="stable")
    return replace(
        geometry,
        positions=positions,
        normals=normals,
        uvs=uvs,
        faces=faces[order].astype(np.int32),
        vertex_object=vertex_object,
        face_object=owner[order].astype(np.int32),
    )


def angle_between(a: NDArray[np.float32], b: NDArray[np.float32]) -> F64:
    """Angle (M,), rad, between vectors (M, 3) that are not zero, to the roundings of float32."""
    x, y = a.astype(np.float64), b.astype(np.float64)
    sine, cosine = np.linalg.norm(np.cross(x, y), axis=1), np.einsum("mi,mi->m", x, y)
    return np.arctan2(sine, cosine)


def _split(
    faces: NDArray[np.int64],
    owner: NDArray[np.int32],
    of_face: NDArray[np.intp],
    longest: NDArray[np.intp],
    number: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Faces cut at their marked edges. of_face (F, 3): edges; number: of each edge its new vertex, or -1."""
    # Corners and edge middles, the longest edge first.
    turn = (longest[:, None] + np.arange(3)) % 3
    rows = np.arange(len(faces))[:, None]
    v0, v1, v2 = faces[rows, turn].T
    m0, m1, m2 = number[of_face[rows, turn]].T
    whole = m0 < 0
    one, two = ~whole & (m1 < 0), ~whole & (m1 >= 0)
    left, both = ~whole & (m2 < 0), ~whole & (m2 >= 0)
    parts = [
        (whole, (v0, v1, v2)),
        (left, (v0, m0, v2)),
        (both, (v0, m0, m2)),
        (both, (m0, v2, m2)),
        (one, (m0, v1, v2)),
        (two, (m0, v1, m1)),
        (two, (m0, m1, v2)),
    ]
    new_faces = np.concatenate([np.stack([c[mask] for c in corners], axis=1) for mask, corners in parts])
    return new_faces, np.concatenate([owner[mask] for mask, _ in parts])
