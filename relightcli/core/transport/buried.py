"""Receivers that cannot stand on their vertex: where surfaces meet, under things and inside them.

Where a wall stands on a floor, the vertices along the line lie in the planes of both, and rays from there are blocked
at once. A receiver whose rays end in next to nothing steps aside, onto one of its vertex's faces.

A floor's vertex below a table's foot gets no light; interpolated, it would darken the floor around the foot. Such a
receiver is found by a few rays: it is buried if none of them leaves the scene, and either each ends closer than the
receiver's nearest neighbour on the mesh or on the back of a one-sided surface, or most of them end on backs, inside
something. It moves along its vertex's faces to the nearest place that is not buried, and speaks for the vertex from
there. Where there is none, the face's other corners stand in.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.sampling import about
from relightcli.core.sphere.lattice import r2_point
from relightcli.core.transport.receivers import Receivers, receivers_of_vertices
from relightcli.core.transport.tracer import Tracer

FIRST, ALL = 8, 56  # rays of every receiver, and of those whose first ones all end on something
INSIDE = 0.5  # share of rays that end on backs, from which a point counts as inside
TOUCHING = 1 / 256  # of the distance to the neighbours: rays that end closer have hardly begun
ASIDE = 1 / 64  # of the way to a face's opposite edge
HALFWAY = 8 / 16
STEPS = (1 / 16, 2 / 16, 3 / 16, 4 / 16, 6 / 16, 8 / 16, 12 / 16, 15 / 16)  # of the way to a face's opposite edge
BATCH = 1 << 16


def unbury(
    tracer: Tracer,
    receivers: Receivers,
    positions: NDArray[np.float64],
    faces: NDArray[np.int32],
    face_normals: NDArray[np.float32],
    two_sided: NDArray[np.bool_],
) -> tuple[Receivers, NDArray[np.bool_]]:
    """The receivers of a mesh's vertices, buried ones moved; and which of them are buried still, (N,) bool.

    positions (V, 3), faces (F, 3); face_normals (F, 3) of the counter-clockwise sides; two_sided (F,).
    """
    reach = shortest_edges(positions, faces)[receivers.vertex]
    place = receivers.position.copy()
    touching = _touching(tracer, place, receivers.normal, reach)
    # Corners of faces by vertex: vertex v's are corner[first[v]] to corner[first[v + 1]].
    corner = np.argsort(faces.reshape(-1), kind="stable")
    first = np.searchsorted(faces.reshape(-1)[corner], np.arange(len(positions) + 1))

    def along(at: NDArray[np.intp], step: float) -> NDArray[np.float64]:
        face, k = at // 3, at % 3
        here = positions[faces[face, k]]
        across = 0.5 * (positions[faces[face, (k + 1) % 3]] + positions[faces[face, (k + 2) % 3]])
        moved: NDArray[np.float64] = here + step * (across - here)
        return moved

    place[touching] = along(corner[first[receivers.vertex[touching]]], ASIDE)
    buried = find_buried(tracer, place, receivers.normal, reach, face_normals, two_sided)
    for step in STEPS:
        left = np.flatnonzero(buried)
        if step != HALFWAY:
            # Where all neighbours are buried too, one try is enough: deep inside there is no way out.
            left = left[_rim(faces, receivers, buried)[left]]
        vertex = receivers.vertex[left]
        count = first[vertex + 1] - first[vertex]
        who = np.repeat(left, count)
        if len(who) == 0:
            continue  # none of these is on a rim; halfway the others have their try
        within = np.arange(len(who)) - np.repeat(np.cumsum(count) - count, count)
        there = along(corner[np.repeat(first[vertex], count) + within], step)
        free = ~find_buried(tracer, there, receivers.normal[who], reach[who], face_normals, two_sided)
        moved, chosen = np.unique(who[free], return_index=True)
        place[moved] = there[free][chosen]
        buried[moved] = False
    return replace(receivers, position=place), buried


def _rim(faces: NDArray[np.int32], receivers: Receivers, buried: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Receivers (N,) with a neighbour on the same side that is not buried."""
    out = np.zeros(len(buried), bool)
    for index in receivers_of_vertices(receivers.vertex, receivers.side, int(faces.max(initial=-1)) + 1):
        corner = index[faces]
        corner = corner[(corner >= 0).all(axis=1)]
        out[corner[(~buried[corner]).any(axis=1)]] = True
    return out


def _touching(
    tracer: Tracer, positions: NDArray[np.float64], normals: NDArray[np.float32], reach: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Points (N,) from which a ray ends at once."""
    out = np.zeros(len(positions), bool)
    for start in range(0, len(positions), BATCH // FIRST):
        rows = slice(start, start + BATCH // FIRST)
        origins = np.repeat(tracer.offset(positions[rows], normals[rows]), FIRST, axis=0)
        hits = tracer.intersect(origins, _directions(normals[rows], 0, FIRST))
        near = hits.distance < np.repeat(reach[rows] * (TOUCHING * tracer.scale), FIRST)
        out[rows] = ((hits.face >= 0) & near).reshape(-1, FIRST).any(axis=1)
    return out


def find_buried(
    tracer: Tracer,
    positions: NDArray[np.float64],
    normals: NDArray[np.float32],
    reach: NDArray[np.float64],
    face_normals: NDArray[np.float32],
    two_sided: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Which points (N,) are buried. positions, normals (N, 3); reach (N,), the distance to their nearest neighbour."""
    buried = np.ones(len(positions), bool)
    for first, last in ((0, FIRST), (FIRST, ALL)):
        index = np.flatnonzero(buried)
        step = max(1, BATCH // (last - first))
        for start in range(0, len(index), step):
            rows = index[start : start + step]
            directions = _directions(normals[rows], first, last)
            origins = np.repeat(tracer.offset(positions[rows], normals[rows]), last - first, axis=0)
            hits = tracer.intersect(origins, directions)
            enclosed = (hits.face >= 0).reshape(len(rows), -1).all(axis=1)
            if first:
                near = (hits.distance < np.repeat(reach[rows] * tracer.scale, last - first)).reshape(len(rows), -1)
                facing = np.einsum("nx,nx->n", face_normals[hits.face], directions)
                inside = ((facing > 0) & ~two_sided[hits.face]).reshape(len(rows), -1)
                enclosed &= (near | inside).all(axis=1) | (inside.mean(axis=1) > INSIDE)
            buried[rows] = enclosed
    return buried


@njit(cache=True)
def _directions(normals: Any, first: int, last: int) -> Any:
    """Directions `first` to `last` of a fixed set about every normal, distributed as the cosine, (N * count, 3)."""
    out = np.empty((len(normals) * (last - first), 3), np.float32)
    row = 0
    for i in range(len(normals)):
        n = (np.float64(normals[i, 0]), np.float64(normals[i, 1]), np.float64(normals[i, 2]))
        for k in range(first, last):
            u1, u2 = r2_point(k)
            radius, angle = math.sqrt(u1), 2.0 * math.pi * u2
            d = about(n, radius * math.cos(angle), radius * math.sin(angle), math.sqrt(1.0 - u1))
            out[row, 0], out[row, 1], out[row, 2] = d
            row += 1
    return out


def shortest_edges(positions: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Length of the shortest edge at every vertex, (V,); infinite where there are none."""
    out = np.full(len(positions), np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        length = np.linalg.norm(positions[faces[:, a]] - positions[faces[:, b]], axis=1)
        for corner in (a, b):
            np.minimum.at(out, faces[:, corner], length)
    return out
