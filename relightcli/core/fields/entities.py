"""Entities of a scene: fields put somewhere, and which of them lies before which as a point sees them. [Pan 2007, 5]

An entity's own frame goes to the world by x -> scale * rotation x + translation. Entities are sorted by the distance to
the nearest point of their surface, which the paper leaves undefined: by their centres, a small ball behind a large wall
would come before it. The distance taken is that to the entity's box and to its bounding sphere, whichever is larger:
both hold the entity, and for boxes, walls and balls one of them is the surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.fields.field import Field, SourceField
from relightcli.core.fields.interpolate import CORNERS, Grid, locate_one, make_grid, shell_steps
from relightcli.core.parts import in_parts
from relightcli.core.sphere.rotation import rotation_matrices

_MANY = 4096  # points: fewer are looked up sooner than shared out


class Transfer(Protocol):
    """The transfer of an object's samples, in whichever form it is kept."""

    def reflect(self, light: NDArray[np.floating], which: NDArray[np.integer]) -> NDArray[np.float32]:
        """Radiance (k, 3, N) float32 of the object seen from samples `which` (k,), light (m, 3, N) at its proxies."""


@dataclass(frozen=True)
class PlainTransfer:
    """Transfer (samples, m, N, N, C) float32 as it was simulated."""

    transfer: NDArray[np.float32]

    def reflect(self, light: NDArray[np.floating], which: NDArray[np.integer]) -> NDArray[np.float32]:
        out = np.empty((len(which), 3, light.shape[2]), np.float32)
        values = np.ascontiguousarray(light, np.float32)
        _reflect(np.ascontiguousarray(self.transfer), np.asarray(which, np.int64), values, out)
        return out


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _reflect(transfer, which, light, out):  # type: ignore[no-untyped-def]
    """A matrix (n, n) at a time, entry beside entry; the light is laid out as these are."""
    m, n, colours = transfer.shape[1], transfer.shape[2], transfer.shape[4]
    flat = transfer.reshape(transfer.shape[0], m, n * n * colours)
    laid = np.empty((m, 3, n * n), np.float32)
    for k in range(m):
        for c in range(3):
            for i in range(n):
                laid[k, c, i * n : (i + 1) * n] = light[k, c]
    terms = np.empty((3, n * n), np.float32)
    for r in range(len(which)):
        terms[:] = np.float32(0.0)
        for k in range(m):
            own = flat[which[r], k]
            red, green, blue = laid[k, 0], laid[k, 1], laid[k, 2]
            if colours == 1:
                for x in range(n * n):
                    terms[0, x] += own[x] * red[x]
                    terms[1, x] += own[x] * green[x]
                    terms[2, x] += own[x] * blue[x]
            else:
                for x in range(n * n):
                    terms[0, x] += own[3 * x] * red[x]
                    terms[1, x] += own[3 * x + 1] * green[x]
                    terms[2, x] += own[3 * x + 2] * blue[x]
        for c in range(3):
            for i in range(n):
                total = np.float32(0.0)
                for j in range(n):
                    total += terms[c, i * n + j]
                out[r, c, i] = total


@dataclass(frozen=True)
class Surroundings:
    """What an entity does to the light around it, in its own frame, wherever it is put.

    grid about center (3,); box (2, 3), least and greatest corner of the surface; radius of its bounding sphere
    occlusion (samples, N) float32, None if it blocks nothing; transfer, None if it reflects nothing; radiance
    (samples, N, 3) float32 that it emits, None if none; proxies (m, 3), none without transfer.
    """

    grid: Grid
    center: NDArray[np.float64]
    box: NDArray[np.float64]
    radius: float
    occlusion: NDArray[np.float32] | None = None
    transfer: Transfer | None = None
    radiance: NDArray[np.float32] | None = None
    proxies: NDArray[np.float64] | None = None


def of_object(field: Field, box: NDArray[np.float64], transfer: Transfer | None = None) -> Surroundings:
    """An object; `transfer` takes the place of the field's own."""
    n = field.occlusion.shape[-1]
    plain = PlainTransfer(field.transfer.reshape(-1, *field.transfer.shape[2:]))
    return Surroundings(
        make_grid(field.radii, field.resolution, field.valid),
        field.center,
        np.asarray(box, np.float64),
        field.radius,
        field.occlusion.reshape(-1, n),
        transfer or plain,
        None,
        field.proxies,
    )


def of_light(field: SourceField) -> Surroundings:
    """A local light: it blocks nothing."""
    grid = make_grid(field.radii, field.resolution)
    box = np.stack([field.center - field.radius, field.center + field.radius])
    n = field.radiance.shape[-2]
    return Surroundings(grid, field.center, box, field.radius, radiance=field.radiance.reshape(-1, n, 3))


@dataclass(frozen=True)
class Entity:
    """Surroundings somewhere: rotation (3, 3), translation (3,), scale > 0, the same along all axes."""

    own: Surroundings
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    scale: float = 1.0
    turns: dict[int, NDArray[np.float64]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def proxies(self) -> NDArray[np.float64]:
        """Proxies in the world, (m, 3)."""
        if self.own.proxies is None:
            return np.zeros((0, 3))
        found: NDArray[np.float64] = self.scale * (self.own.proxies @ self.rotation.T) + self.translation
        return found

    def turn(self, order: int) -> NDArray[np.float64]:
        """(N, N): coefficients in the entity's frame to those in the world's."""
        if order not in self.turns:
            turn_together([self], order)
        return self.turns[order]


def turn_together(entities: list[Entity], order: int) -> None:
    """Makes the turns that are missing of all entities at once, which costs little more than one."""
    new = [entity for entity in entities if order not in entity.turns]
    if new:
        turns = rotation_matrices(np.stack([e.rotation for e in new]), order)
        for entity, turn in zip(new, turns, strict=True):
            entity.turns[order] = turn


class Lookup(NamedTuple):
    """Where points read the entities' fields.

    sample (T,) int64: the samples that are read, in their entity's own list; those of entity e are start[e] to
    start[e + 1], start (E + 1,)
    place (n, E, 8) int32 among them, weight (n, E, 8) float32
    nearest (n, E) int32: entities from near to far, one that is left out -1 at the end
    inside (n, E) bool: points within the innermost shell of an entity that is not left out
    """

    sample: NDArray[np.int64]
    start: NDArray[np.int64]
    place: NDArray[np.int32]
    weight: NDArray[np.float32]
    nearest: NDArray[np.int32]
    inside: NDArray[np.bool_]

    def part(self, e: int) -> slice:
        return slice(int(self.start[e]), int(self.start[e + 1]))

    def points(self, rows: slice | NDArray[np.int64]) -> Lookup:
        """The same for some of the points."""
        return self._replace(
            place=self.place[rows], weight=self.weight[rows], nearest=self.nearest[rows], inside=self.inside[rows]
        )

    def read(self, count: int) -> NDArray[np.bool_]:
        """Which of the first `count` samples these points read, (count,)."""
        found = np.zeros(count, np.bool_)
        _mark(self.place, self.weight, found)
        return found


def look_up(entities: list[Entity], points: NDArray[np.floating], skip: NDArray[np.int32], threads: int = 1) -> Lookup:
    """Looks up all entities but number skip (n,) (-1: none) at points (n, 3) of the world."""
    p = np.ascontiguousarray(points, np.float64)
    count = len(entities)
    threads = threads if len(p) >= _MANY else 1
    first = np.concatenate([[0], np.cumsum([len(e.own.grid.stand_in) for e in entities])]).astype(np.int64)
    place, weight = np.zeros((len(p), count, CORNERS), np.int32), np.zeros((len(p), count, CORNERS), np.float32)
    distance, nearest = np.empty((len(p), count)), np.empty((len(p), count), np.int32)
    read = np.zeros(int(first[-1]), np.bool_)
    inside = np.zeros((len(p), count), np.bool_)
    skip = np.ascontiguousarray(skip, np.int32)

    def visit(a: int, b: int) -> None:
        for e, entity in enumerate(entities):
            own = entity.own
            frame = entity.rotation, entity.translation, float(entity.scale), own.center, own.box, float(own.radius)
            _visit(
                p[a:b],
                skip[a:b],
                e,
                first[e],
                *frame,
                *own.grid,
                place[a:b],
                weight[a:b],
                distance[a:b],
                inside[a:b],
                read,
            )
        _order(distance[a:b], skip[a:b], nearest[a:b])

    in_parts(visit, len(p), threads)
    found = np.flatnonzero(read)
    number = np.zeros(len(read), np.int32)
    number[found] = np.arange(len(found), dtype=np.int32)
    in_parts(lambda a, b: _renumber(number, weight[a:b], place[a:b]), len(p), threads)
    start = np.searchsorted(found, first)
    return Lookup(found - np.repeat(first[:-1], np.diff(start)), start, place, weight, nearest, inside)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _visit(  # type: ignore[no-untyped-def]
    points, skip, e, start, rotation, translation, scale, center, box, radius, radii, logarithmic, padded, stand_in,
    clear, index, weight, distance, inside, read,
):  # fmt: skip
    steps = shell_steps(radii, logarithmic)
    # Into the entity's frame, about its centre: turned by the inverse, which is the transpose.
    turn, t = rotation / scale, (translation[0], translation[1], translation[2])
    low = (box[0, 0] - center[0], box[0, 1] - center[1], box[0, 2] - center[2])
    high = (box[1, 0] - center[0], box[1, 1] - center[1], box[1, 2] - center[2])
    for i in range(len(points)):
        if skip[i] == e:
            distance[i, e] = np.inf
            continue
        a, b, c = points[i, 0] - t[0], points[i, 1] - t[1], points[i, 2] - t[2]
        x = turn[0, 0] * a + turn[1, 0] * b + turn[2, 0] * c - center[0]
        y = turn[0, 1] * a + turn[1, 1] * b + turn[2, 1] * c - center[1]
        z = turn[0, 2] * a + turn[1, 2] * b + turn[2, 2] * c - center[2]
        square = x * x + y * y + z * z
        bx, by, bz = max(low[0] - x, x - high[0]), max(low[1] - y, y - high[1]), max(low[2] - z, z - high[2])
        outside = max(bx, 0.0) ** 2 + max(by, 0.0) ** 2 + max(bz, 0.0) ** 2
        to_box = math.sqrt(outside) if outside > 0.0 else max(bx, by, bz)
        distance[i, e] = scale * max(to_box, math.sqrt(square) - radius)
        inside[i, e] = square < steps[0, 0]
        own, w = index[i, e], weight[i, e]
        locate_one(x, y, z, steps, logarithmic, padded, stand_in, clear, own, w)
        for k in range(CORNERS):
            own[k] += start
            if w[k] > 0.0:
                read[own[k]] = True


@njit(cache=True, nogil=True)
def _order(distance, skip, nearest):  # type: ignore[no-untyped-def]
    """Insertion sort, stable: of two at the same distance the first in the list comes first."""
    count = distance.shape[1]
    for i in range(len(distance)):
        for e in range(count):
            k = e
            while k > 0 and distance[i, nearest[i, k - 1]] > distance[i, e]:
                nearest[i, k] = nearest[i, k - 1]
                k -= 1
            nearest[i, k] = e
        if skip[i] >= 0:  # at an infinite distance: the last
            nearest[i, count - 1] = -1


@njit(cache=True, nogil=True)
def _renumber(number, weight, place):  # type: ignore[no-untyped-def]
    for i in range(place.shape[0]):
        for e in range(place.shape[1]):
            for k in range(place.shape[2]):
                place[i, e, k] = number[place[i, e, k]] if weight[i, e, k] > 0.0 else 0


@njit(cache=True, nogil=True)
def _mark(place, weight, found):  # type: ignore[no-untyped-def]
    for i in range(place.shape[0]):
        for e in range(place.shape[1]):
            for k in range(place.shape[2]):
                if weight[i, e, k] > 0.0 and place[i, e, k] < len(found):
                    found[place[i, e, k]] = True
