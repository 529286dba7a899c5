"""Visibility bits past things that have come to stand elsewhere since the bits were traced.

Only texels that are still open and lie in the direction of one of the blockers' bounding balls are traced, against the
blockers alone: what comes out is what tracing the whole scene would have given, texel by texel.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.sphere import cube
from relightcli.core.transport.tracer import Tracer

BATCH = 64  # receivers whose rays are traced together
COARSE = 16  # cells along a cube face in which balls are looked for
ROUNDING = 1e-5  # radians, of directions in float32


PARTS = 64  # balls about a mesh, at most: a bit each


class Balls(NamedTuple):
    """Bounding balls of a mesh's parts, after a first one of all of it: center (B, 3), radius (B,), float64."""

    center: NDArray[np.float64]
    radius: NDArray[np.float64]


def bounding_balls(positions: NDArray[np.float64], faces: NDArray[np.int32], most: int = PARTS) -> Balls:
    """Balls about the boxes of at most `most` parts of equally many faces (F, 3), F >= 1, cut across their longest
    extent again and again."""
    middle = positions[faces].mean(axis=1)
    parts, balls = [np.arange(len(faces))], [_ball(positions[np.unique(faces)])]
    while len(parts) < most and len(parts[0]) > 1:
        halves = []
        for part in parts:
            along = middle[part][:, np.ptp(middle[part], axis=0).argmax()]
            order = part[np.argsort(along, kind="stable")]
            halves += [half for half in np.array_split(order, 2) if len(half)]
        parts = sorted(halves, key=len, reverse=True)
    balls += [_ball(positions[np.unique(faces[part])]) for part in parts]
    return Balls(np.array([center for center, _ in balls]), np.array([radius for _, radius in balls]))


def _ball(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return center, math.sqrt(float(((points - center) ** 2).sum(axis=1).max())) * (1.0 + 1e-9)


def block(
    tracer: Tracer,
    balls: Balls,
    positions: NDArray[np.float64],
    normals: NDArray[np.float32],
    bits: NDArray[np.uint8],
) -> tuple[NDArray[np.int64], NDArray[np.uint8], int]:
    """The receivers that blockers take light from, rising, their bits (M, 6, R, R/8) past them, and the rays traced.

    tracer of the blockers alone; balls about all of them; positions (N, 3) float64, normals (N, 3), bits
    (N, 6, R, R/8) of the receivers.
    """
    resolution = bits.shape[2]
    cells = min(COARSE, resolution)
    directions = cube.texel_directions(resolution).reshape(-1, 3).astype(np.float32)
    centers = cube.texel_directions(cells).reshape(-1, 3)
    reach = math.sqrt(2.0) / cells  # on the face's plane, and so no smaller as an angle
    side = resolution // cells
    owner, texel = (np.empty(BATCH * len(directions), np.int32) for _ in range(2))
    towards = np.empty((BATCH * len(directions), 3), np.float32)
    rows, found, rays = [], [], 0
    for start in range(0, len(bits), BATCH):
        part = slice(start, start + BATCH)
        own = np.ascontiguousarray(bits[part]).reshape(len(bits[part]), -1)
        origin, normal = positions[part], np.ascontiguousarray(normals[part], np.float32)
        mark = _mark(origin, normal, balls.center, balls.radius, centers, reach)
        count = _rays(origin, balls.center, balls.radius, mark, own, directions, cells, side, owner, towards, texel)
        blocked = tracer.occluded(tracer.offset(origin, normal)[owner[:count]], towards[:count])
        rays += count
        if not blocked.any():
            continue
        own = own.copy()
        _clear(own, owner, texel, blocked)
        changed = np.unique(owner[:count][blocked])
        rows.append(start + changed.astype(np.int64))
        found.append(own[changed])
    if not rows:
        return np.zeros(0, np.int64), np.zeros((0, *bits.shape[1:]), np.uint8), rays
    return np.concatenate(rows), np.concatenate(found).reshape(-1, *bits.shape[1:]), rays


@njit(cache=True)
def _mark(points, normals, centers, radii, directions, reach):  # type: ignore[no-untyped-def]
    """Balls that may be seen through cells (N, C): a bit for each but the first."""
    mark = np.zeros((len(points), len(directions)), np.uint64)
    cells = np.empty(len(directions), np.int64)
    for i in range(len(points)):
        count = len(directions)
        for c in range(count):
            cells[c] = c
        for b in range(len(centers)):
            x, y, z = centers[b, 0] - points[i, 0], centers[b, 1] - points[i, 1], centers[b, 2] - points[i, 2]
            if normals[i, 0] * x + normals[i, 1] * y + normals[i, 2] * z <= -radii[b]:  # below the horizon
                if b == 0:
                    break
                continue
            far = math.sqrt(x * x + y * y + z * z)
            least = _least(far, radii[b], reach)
            found = 0
            for k in range(count):
                c = cells[k]
                if x * directions[c, 0] + y * directions[c, 1] + z * directions[c, 2] >= least:
                    if b == 0:  # the ball of all: no other cell needs to be looked at again
                        cells[found] = c
                        found += 1
                    else:
                        mark[i, c] |= np.uint64(1) << np.uint64(b - 1)
            if b == 0:
                count = found
    return mark


@njit(cache=True)
def _least(far, radius, reach):  # type: ignore[no-untyped-def]
    """Least product of a direction and the way to a ball's centre, `far` long, for the ball to be within `reach`."""
    angle = math.pi if far <= radius else math.asin(radius / far) + reach
    return -2.0 * far if angle >= math.pi else far * math.cos(angle)


@njit(cache=True)
def _rays(points, centers, radii, mark, bits, directions, cells, side, owner, towards, texel):  # type: ignore[no-untyped-def]
    """The open texels towards balls: fills owner, towards and texel, returns how many."""
    resolution = cells * side
    count = 0
    way, least = np.empty((len(centers), 3)), np.empty(len(centers))
    own = np.empty(len(centers), np.int64)
    for i in range(len(mark)):
        for b in range(1, len(centers)):
            for k in range(3):
                way[b, k] = centers[b, k] - points[i, k]
            far = math.sqrt(way[b, 0] ** 2 + way[b, 1] ** 2 + way[b, 2] ** 2)
            least[b] = _least(far, radii[b], ROUNDING)
        for c in range(mark.shape[1]):
            if mark[i, c] == np.uint64(0):
                continue
            number = 0
            for b in range(1, len(centers)):
                if (mark[i, c] >> np.uint64(b - 1)) & np.uint64(1):
                    own[number] = b
                    number += 1
            face, row, column = c // (cells * cells), (c // cells) % cells, c % cells
            first = (face * resolution + row * side) * resolution + column * side
            for a in range(side):
                for t in range(first + a * resolution, first + a * resolution + side):
                    if not (bits[i, t >> 3] >> np.uint8(t & 7)) & np.uint8(1):
                        continue
                    d = directions[t]
                    for k in range(number):
                        b = own[k]
                        if way[b, 0] * d[0] + way[b, 1] * d[1] + way[b, 2] * d[2] >= least[b]:
                            owner[count], texel[count] = i, t
                            towards[count] = d
                            count += 1
                            break
    return count


@njit(cache=True)
def _clear(bits, owner, texel, blocked):  # type: ignore[no-untyped-def]
    for r in range(len(blocked)):
        if blocked[r]:
            t = texel[r]
            bits[owner[r], t >> 3] &= ~(np.uint8(1) << np.uint8(t & 7))
