"""Who sees whom, with what weight: the hits of `transport.hits` and the blocked parts of their cells."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.parts import in_parts
from relightcli.core.sphere import cube

Zeros = Callable[[tuple[int, ...], Any], NDArray[Any]]


class Gather(NamedTuple):
    """Who sees whom: entries of receiver i are start[i] to start[i + 1].

    start (N + 1,) int64; source (Z,) int32, the receiver seen; cell (Z,) int16, of the 6 C C; cosine (Z,) float32,
    n . m_c with m_c the integral of the direction over the blocked part of the cell; solid_angle (Z,) float32 of that
    part, sr.
    """

    cells: int
    start: NDArray[np.int64]
    source: NDArray[np.int32]
    cell: NDArray[np.int16]
    cosine: NDArray[np.float32]
    solid_angle: NDArray[np.float32]


class _Tables(NamedTuple):
    """moment (6 R R, 4) float32: direction times solid angle, and solid angle, of every texel; blocked (6 R R / 4, 16,
    4): their sums over those of four texels in a row whose bit in a number from 0 to 15 is 0; center (6 C C, 3): unit;
    reach (6 C C,): how far from it the cell's texels are."""

    moment: NDArray[np.float32]
    blocked: NDArray[np.float32]
    center: NDArray[np.float32]
    reach: NDArray[np.float32]


@lru_cache(maxsize=2)
def _tables(resolution: int, cells: int) -> _Tables:
    side = resolution // cells
    directions = cube.texel_directions(resolution)
    solid = np.tile(cube.solid_angles(resolution), (6, 1, 1))[..., None]
    moment = np.concatenate([directions * solid, solid], axis=3).reshape(-1, 4)
    clear = 1.0 - (np.arange(16)[:, None] >> np.arange(4) & 1)  # (16, 4): texels whose bit is 0
    center = cube.texel_directions(cells)
    inside = directions.reshape(6, cells, side, cells, side, 3)
    reach = np.linalg.norm(inside - center[:, :, None, :, None], axis=5).max(axis=(2, 4))
    return _Tables(
        moment.astype(np.float32),
        np.ascontiguousarray(clear @ moment.reshape(-1, 4, 4), np.float32),
        center.reshape(-1, 3).astype(np.float32),
        (reach.reshape(-1) * (1.0 + 1e-5) + 1e-6).astype(np.float32),  # covers the rounding to float32
    )


def build_gather(
    hits: NDArray[np.int32], bits: NDArray[np.uint8], normals: NDArray[np.float32], threads: int = 1
) -> Gather:
    """From hits (N, 6, C, C), as `transport.hits` makes them, and visibility bits (N, 6, R, R/8); normals (N, 3)."""
    cells, resolution = hits.shape[2], bits.shape[2]
    flat = hits.reshape(len(hits), -1)
    count = np.count_nonzero(flat, axis=1)
    start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    z = int(start[-1])
    out = Gather(
        cells,
        start,
        np.empty(z, np.int32),
        np.empty(z, np.int16),
        np.empty(z, np.float32),
        np.empty(z, np.float32),
    )
    words = np.ascontiguousarray(bits).reshape(len(bits), -1)
    tables = _tables(resolution, cells)
    normals = np.ascontiguousarray(normals, np.float32)

    def part(a: int, b: int) -> None:
        _weigh(flat[a:b], words[a:b], normals[a:b], tables, resolution, start[a:b], out)

    in_parts(part, len(hits), threads)
    return out


def join(parts: list[Gather]) -> Gather:
    """The entries of consecutive ranges of receivers in one. The list is emptied: no more than one column is in memory
    twice."""
    if len(parts) == 1:
        return parts[0]
    cells, counts = parts[0].cells, np.concatenate([np.diff(part.start) for part in parts])
    columns = [list(column) for column in zip(*(part[2:] for part in parts), strict=True)]
    parts.clear()
    whole: list[NDArray[Any]] = []
    for column in columns:
        whole.append(np.concatenate(column))
        column.clear()
    return Gather(cells, np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), *whole)


def collect(parts: Iterable[Gather], receivers: int, entries: int, zeros: Zeros) -> Gather:
    """`join` where memory does not hold the parts: `receivers` and `entries` that they have together, and what makes
    arrays from a shape and a type."""
    start = np.zeros(receivers + 1, np.int64)
    columns = [zeros((entries,), kind) for kind in (np.int32, np.int16, np.float32, np.float32)]
    at = z = cells = 0
    for part in parts:
        n, more, cells = len(part.start) - 1, len(part.source), part.cells
        start[at + 1 : at + n + 1] = z + part.start[1:]
        for column, own in zip(columns, part[2:], strict=True):
            column[z : z + more] = own
        at, z = at + n, z + more
    return Gather(cells, start, *columns)


def pick(gather: Gather, rows: NDArray[np.int64]) -> Gather:
    """The entries of some receivers, (M,), which become 0 to M - 1."""
    counts = gather.start[rows + 1] - gather.start[rows]
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    index = np.repeat(gather.start[rows] - start[:-1], counts) + np.arange(start[-1])
    return Gather(gather.cells, start, *(column[index] for column in gather[2:]))


def replace_rows(gather: Gather, rows: NDArray[np.int64], part: Gather) -> Gather:
    """The gather with the entries of receivers rows (M,), rising, in the place of its own; part has M receivers."""
    count = np.diff(gather.start)
    count[rows] = np.diff(part.start)
    start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    stays = np.ones(len(count), bool)
    stays[rows] = False
    new = np.repeat(~stays, count)  # the entries that come from `part`
    old = np.repeat(stays, np.diff(gather.start))

    def put(mine: NDArray[Any], other: NDArray[Any]) -> NDArray[Any]:
        out = np.empty(len(new), mine.dtype)
        out[new], out[~new] = other, mine[old]
        return out

    return Gather(
        gather.cells,
        start,
        put(gather.source, part.source),
        put(gather.cell, part.cell),
        put(gather.cosine, part.cosine),
        put(gather.solid_angle, part.solid_angle),
    )


@njit(cache=True, nogil=True)
def _weigh(flat, words, normals, tables, resolution, start, out):  # type: ignore[no-untyped-def]
    cells = out.cells
    side = resolution // cells
    fours = side % 4 == 0
    for i in range(len(flat)):
        z = start[i]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        for c in range(flat.shape[1]):
            if flat[i, c] == 0:
                continue
            face, row, column = c // (cells * cells), (c // cells) % cells, c % cells
            first = (face * resolution + row * side) * resolution + column * side
            o = tables.center[c]
            w = s = np.float32(0.0)
            if fours and nx * o[0] + ny * o[1] + nz * o[2] > tables.reach[c]:  # all of the cell is above the horizon
                x = y = v = np.float32(0.0)
                for a in range(first, first + side * resolution, resolution):
                    for t in range(a, a + side, 4):
                        m = tables.blocked[t >> 2, (words[i, t >> 3] >> np.uint8(t & 4)) & np.uint8(15)]
                        x += m[0]
                        y += m[1]
                        v += m[2]
                        s += m[3]
                w = nx * x + ny * y + nz * v
            else:
                for a in range(first, first + side * resolution, resolution):
                    for t in range(a, a + side):
                        if (words[i, t >> 3] >> np.uint8(t & 7)) & np.uint8(1):
                            continue
                        m = tables.moment[t]
                        height = nx * m[0] + ny * m[1] + nz * m[2]
                        if height > np.float32(0.0):
                            w += height
                            s += m[3]
            out.source[z], out.cell[z], out.cosine[z], out.solid_angle[z] = flat[i, c] - 1, c, w, s
            z += 1
