"""Where transfer is simulated: the vertices that faces use, or the points that a fixed camera's pixels see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Receivers:
    """Surface points in an order that keeps neighbours together.

    position (N, 3) float64 world; normal (N, 3) float32 unit, on the side that is lit; object (N,) int32;
    vertex (N,) int32 mesh vertex, or -1; side (N,) int8: 1 front, -1 back (its normal is turned round).
    """

    position: NDArray[np.float64]
    normal: NDArray[np.float32]
    object: NDArray[np.int32]
    vertex: NDArray[np.int32]
    side: NDArray[np.int8]

    def __len__(self) -> int:
        return len(self.position)

    def at(self, rows: NDArray[np.integer[Any]]) -> Receivers:
        """Some of them."""
        return Receivers(self.position[rows], self.normal[rows], self.object[rows], self.vertex[rows], self.side[rows])


def vertex_receivers(
    positions: NDArray[np.float64],
    normals: NDArray[np.float32],
    faces: NDArray[np.int32],
    vertex_object: NDArray[np.int32],
    both_sides: NDArray[np.bool_],
) -> Receivers:
    """One receiver per vertex that a face uses, two where its object is lit from `both_sides` (bool per object)."""
    used = np.zeros(len(positions), bool)
    used[faces.reshape(-1)] = True
    front = np.flatnonzero(used)
    back = np.flatnonzero(used & both_sides[vertex_object])
    vertex = np.concatenate([front, back]).astype(np.int32)
    side = np.concatenate([np.ones(len(front)), -np.ones(len(back))]).astype(np.int8)
    order = spatial_order(positions[vertex], side)
    vertex, side = vertex[order], side[order]
    return Receivers(
        positions[vertex],
        (normals[vertex] * side[:, None]).astype(np.float32),
        vertex_object[vertex].astype(np.int32),
        vertex,
        side,
    )


def receivers_of_vertices(
    vertex: NDArray[np.int32], side: NDArray[np.int8], count: int
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Receiver on the front and on the back of every one of `count` vertices, int32, -1 where there is none.

    vertex, side (N,) of the receivers; those whose vertex is -1 are left out.
    """
    front, back = np.full(count, -1, np.int32), np.full(count, -1, np.int32)
    for out, there in ((front, side > 0), (back, side < 0)):
        index = np.flatnonzero(there & (vertex >= 0))
        out[vertex[index]] = index
    return front, back


def join_receivers(one: Receivers, two: Receivers) -> Receivers:
    """The receivers of `one`, then those of `two`."""
    return Receivers(
        np.concatenate([one.position, two.position]),
        np.concatenate([one.normal, two.normal]),
        np.concatenate([one.object, two.object]),
        np.concatenate([one.vertex, two.vertex]),
        np.concatenate([one.side, two.side]),
    )


def spatial_order(positions: NDArray[np.float64], side: NDArray[np.int8] | None = None) -> NDArray[np.intp]:
    """An order along a Morton curve through the points (N, 3), sides kept apart; stable, the same at any scale."""
    if len(positions) == 0:
        return np.zeros(0, np.intp)
    low = positions.min(axis=0)
    extent = float(np.ptp(positions, axis=0).max())
    # 20 bits an axis
    cell = ((positions - low) * ((2.0**20 - 1.0) / extent if extent > 0 else 0.0)).astype(np.uint64)
    code = np.zeros(len(positions), np.uint64)
    for axis in range(3):
        code |= _spread(cell[:, axis]) << np.uint64(axis)
    if side is not None:
        code |= (side < 0).astype(np.uint64) << np.uint64(63)
    return np.argsort(code, kind="stable")


def _spread(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Two zero bits between any two of the lowest 21 bits."""
    x = x & np.uint64(0x1FFFFF)
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x


def receiver_areas(
    positions: NDArray[np.float64], faces: NDArray[np.int32], vertex: NDArray[np.int32]
) -> NDArray[np.float64]:
    """The part of the surface that each receiver speaks for, (N,): a third of the faces around its `vertex` (N,)."""
    corner = positions[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 6.0
    around = np.zeros(len(positions))
    np.add.at(around, faces.reshape(-1), np.repeat(area, 3))
    return around[vertex]
