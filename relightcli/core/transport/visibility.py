"""Which texels of the sky cube every receiver sees: one bit per texel, traced coarse to fine.

A receiver is a surface point with a unit normal n. Bit t is 1 where n . w_t > 0 and nothing lies along w_t, the centre
of texel t. Cells of `refine` x `refine` texels are probed by one ray each, at a place that changes from receiver to
receiver; a cell is traced texel by texel where it disagrees with one of its eight neighbours, or where the same cell
of a receiver of the same group does. What was not traced takes the value of its cell's probe. A random sample of it is
traced afterwards: cells found wrong are traced with their neighbours, and the share of wrong bits found is reported.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.sphere import cube
from relightcli.core.transport.tracer import Tracer

GROUP = 16  # receivers that share their refinement
CHECKS = 16  # texels per receiver whose inferred value is checked by a ray

BELOW, BLOCKED, OPEN = 0, 1, 2  # state of a probe


@dataclass(frozen=True)
class VisibilityBlock:
    """bits (N, 6, R, R/8) uint8, little bit order along a row; rays cast; of `checked` inferred bits `wrong` were."""

    bits: NDArray[np.uint8]
    rays: int
    checked: int
    wrong: int
    inferred: int


@dataclass(frozen=True)
class _Tables:
    directions: NDArray[np.float32]  # (T, 3)
    neighbours: NDArray[np.int32]  # (cells, 8)
    first_texel: NDArray[np.int32]  # (cells,) flat index of a cell's top left texel
    centers: NDArray[np.float32]  # (cells, 3) a direction in the middle of the cell
    reach: NDArray[np.float32]  # (cells,) greatest distance from it to the cell's texel directions


class _Rays:
    """Room for the rays of one batch, used again for the next: fresh memory would cost more than filling it."""

    def __init__(self, capacity: int) -> None:
        self.origins = np.empty((capacity, 3), np.float32)
        self.directions = np.empty((capacity, 3), np.float32)
        self.target = np.empty(capacity, np.int32)


@lru_cache(maxsize=4)
def _tables(resolution: int, refine: int) -> _Tables:
    cells = resolution // refine
    face, row, column = np.meshgrid(np.arange(6), np.arange(cells), np.arange(cells), indexing="ij")
    first = ((face * resolution + row * refine) * resolution + column * refine).reshape(-1)
    directions = cube.texel_directions(resolution).reshape(-1, 3)
    centers = cube.texel_directions(cells).reshape(-1, 3)
    inside = (np.arange(refine)[:, None] * resolution + np.arange(refine)).reshape(-1)
    reach = np.linalg.norm(directions[first[:, None] + inside] - centers[:, None], axis=2).max(axis=1)
    return _Tables(
        directions.astype(np.float32),
        cube.neighbours(cells),
        first.astype(np.int32),
        centers.astype(np.float32),
        (reach * (1.0 + 1e-5) + 1e-6).astype(np.float32),  # covers the rounding to float32
    )


def horizon_bits(normals: NDArray[np.float32], resolution: int) -> NDArray[np.uint8]:
    """Bits (N, 6, R, R/8) of an empty scene: texel centres above the horizon of each normal (N, 3)."""
    words = np.zeros((len(normals), 6 * resolution * resolution // 64), np.uint64)
    _set_horizon(np.ascontiguousarray(normals, np.float32), _tables(resolution, 1).directions, words)
    return words.view(np.uint8).reshape(len(normals), 6, resolution, resolution // 8)


def trace_visibility(
    tracer: Tracer,
    positions: NDArray[np.float64],
    normals: NDArray[np.float32],
    resolution: int,
    refine: int,
    seed: int,
    batch: int = 64,
) -> VisibilityBlock:
    """Visibility bits of a block of receivers.

    positions (N, 3) float64 world; normals (N, 3) float32 unit; resolution R a power of two from 16 to 256; refine a
    power of two from 1 (trace every texel) to R/4; seed of the checking sample. Receivers should be sorted in space:
    neighbours in the list share rays' coherence and refinement.
    """
    tables = _tables(resolution, refine)
    words = np.zeros((len(positions), 6 * resolution * resolution // 64), np.uint64)
    rays = checked = wrong = inferred = 0
    room = _Rays(min(batch, len(positions)) * 6 * resolution * resolution)
    for start in range(0, len(positions), batch):
        rows = slice(start, min(start + batch, len(positions)))
        origins = tracer.offset(positions[rows], normals[rows])
        counts = _trace_batch(
            tracer, origins, normals[rows], resolution, refine, tables, words[rows], seed + start, room
        )
        rays, checked, wrong, inferred = rays + counts[0], checked + counts[1], wrong + counts[2], inferred + counts[3]
    bits = words.view(np.uint8).reshape(len(positions), 6, resolution, resolution // 8)
    return VisibilityBlock(bits, rays, checked, wrong, inferred)


def _trace_batch(
    tracer: Tracer,
    origins: NDArray[np.float32],
    normals: NDArray[np.float32],
    resolution: int,
    refine: int,
    tables: _Tables,
    words: NDArray[np.uint64],
    seed: int,
    room: _Rays,
) -> tuple[int, int, int, int]:
    n, cells = len(origins), len(tables.first_texel)
    normals = np.ascontiguousarray(normals, np.float32)
    state = np.zeros((n, cells), np.uint8)
    probed = np.full((n, cells), -1, np.int32)
    if refine == 1:
        mark = np.ones((n, cells), np.uint8)
        traced = _trace_cells(tracer, origins, normals, tables, resolution, refine, mark, state, probed, words, room)
        return traced, 0, 0, 0

    # One probe per cell.
    rays = _probes(
        origins,
        normals,
        tables.directions,
        tables.first_texel,
        tables.centers,
        tables.reach,
        resolution,
        refine,
        room.origins,
        room.directions,
        room.target,
        probed,
    )
    blocked = tracer.occluded(room.origins[:rays], room.directions[:rays])
    _store_probes(room.target, blocked, state)

    # Cells that disagree with a neighbour, here or at a receiver of the group, are traced; the others are filled.
    mark = _disagreeing(state, tables.neighbours, GROUP)
    inferred = _fill(
        normals,
        tables.directions,
        tables.first_texel,
        tables.centers,
        tables.reach,
        resolution,
        refine,
        state,
        mark,
        words,
    )
    rays += _trace_cells(tracer, origins, normals, tables, resolution, refine, mark, state, probed, words, room)

    # A random sample of what was filled.
    ray_origins, ray_directions, owner, texel = _checks(
        origins, normals, tables.directions, resolution, refine, mark, np.uint64(seed % 2**64), CHECKS
    )
    blocked = tracer.occluded(ray_origins, ray_directions)
    rays += len(owner)
    again = np.zeros_like(mark)
    wrong = _compare(owner, texel, blocked, words, resolution, refine, tables.neighbours, mark, again)
    if wrong:
        rays += _trace_cells(tracer, origins, normals, tables, resolution, refine, again, state, probed, words, room)
    return rays, len(owner), wrong, inferred


def _trace_cells(
    tracer: Tracer,
    origins: NDArray[np.float32],
    normals: NDArray[np.float32],
    tables: _Tables,
    resolution: int,
    refine: int,
    mark: NDArray[np.uint8],
    state: NDArray[np.uint8],
    probed: NDArray[np.int32],
    words: NDArray[np.uint64],
    room: _Rays,
) -> int:
    """Traces every texel above the horizon of the marked cells but the probed one, whose `state` is known, and writes
    their bits; returns the number of rays."""
    count = _cell_rays(
        origins,
        normals,
        tables.directions,
        tables.first_texel,
        tables.centers,
        tables.reach,
        resolution,
        refine,
        mark,
        state,
        probed,
        words,
        room.origins,
        room.directions,
        room.target,
    )
    blocked = tracer.occluded(room.origins[:count], room.directions[:count])
    _write_bits(room.target, blocked, words.reshape(-1))
    return count


@njit(cache=True)
def _height(normals, directions, i, t):  # type: ignore[no-untyped-def]
    return normals[i, 0] * directions[t, 0] + normals[i, 1] * directions[t, 1] + normals[i, 2] * directions[t, 2]


@njit(cache=True)
def _above(normals, directions, i, t):  # type: ignore[no-untyped-def]
    return _height(normals, directions, i, t) > np.float32(0.0)


@njit(cache=True)
def _set_horizon(normals, directions, words):  # type: ignore[no-untyped-def]
    for i in range(len(normals)):
        for t in range(len(directions)):
            if _above(normals, directions, i, t):
                words[i, t >> 6] |= np.uint64(1) << np.uint64(t & 63)


@njit(cache=True)
def _probes(origins, normals, directions, first, centers, reach, resolution, refine, out_o, out_d, owner, probed):  # type: ignore[no-untyped-def]
    """One ray for each cell that is not below the horizon; `owner` is its cell among those of all receivers, `probed`
    its texel."""
    n, cells = len(origins), len(first)
    count = 0
    area = refine * refine
    for i in range(n):
        # Odd multiplier: over `area` receivers in a row every place of the cell is probed once.
        place = ((i * 5) + (i // area)) % area
        usual = (place // refine) * resolution + place % refine
        x, y, z = origins[i, 0], origins[i, 1], origins[i, 2]
        for c in range(cells):
            height = _height(normals, centers, i, c)
            if height < -reach[c]:
                continue
            found = -1
            if height > reach[c]:  # the whole cell is above the horizon
                found = first[c] + usual
            else:
                for k in range(area):
                    p = (place + k) % area
                    t = first[c] + (p // refine) * resolution + p % refine
                    if _above(normals, directions, i, t):
                        found = t
                        break
            if found >= 0:
                out_o[count, 0] = x
                out_o[count, 1] = y
                out_o[count, 2] = z
                out_d[count, 0] = directions[found, 0]
                out_d[count, 1] = directions[found, 1]
                out_d[count, 2] = directions[found, 2]
                owner[count] = i * cells + c
                probed[i, c] = found
                count += 1
    return count


@njit(cache=True)
def _store_probes(owner, blocked, state):  # type: ignore[no-untyped-def]
    flat = state.reshape(-1)
    for r in range(len(blocked)):
        flat[owner[r]] = BLOCKED if blocked[r] else OPEN


@njit(cache=True)
def _disagreeing(state, neighbours, group):  # type: ignore[no-untyped-def]
    n, cells = state.shape
    mark = np.zeros((n, cells), np.uint8)
    for g in range(0, n, group):
        stop = min(g + group, n)
        for i in range(g, stop):
            for c in range(cells):
                here = state[i, c]
                if here == BELOW:
                    continue
                for k in range(8):
                    there = state[i, neighbours[c, k]]
                    if there != BELOW and there != here:
                        mark[i, c] = 1
                        break
        # A cell whose probes differ between the receivers of a group has an edge in it for some of them.
        for c in range(cells):
            seen = 0
            for i in range(g, stop):
                seen |= state[i, c]
            if seen == (BLOCKED | OPEN):
                for i in range(g, stop):
                    if state[i, c] != BELOW:
                        mark[i, c] = 1
    return mark


@njit(cache=True)
def _fill(normals, directions, first, centers, reach, resolution, refine, state, mark, words):  # type: ignore[no-untyped-def]
    n, cells = state.shape
    inferred = 0
    row = (np.uint64(1) << np.uint64(refine)) - np.uint64(1)
    for i in range(n):
        for c in range(cells):
            if state[i, c] == BELOW or mark[i, c]:
                continue
            if _height(normals, centers, i, c) > reach[c]:  # the whole cell is above the horizon
                inferred += refine * refine
                if state[i, c] == OPEN:
                    for a in range(refine):
                        t = first[c] + a * resolution
                        words[i, t >> 6] |= row << np.uint64(t & 63)
                continue
            for a in range(refine):
                for b in range(refine):
                    t = first[c] + a * resolution + b
                    if _above(normals, directions, i, t):
                        inferred += 1
                        if state[i, c] == OPEN:
                            words[i, t >> 6] |= np.uint64(1) << np.uint64(t & 63)
    return inferred


@njit(cache=True)
def _cell_rays(  # type: ignore[no-untyped-def]
    origins,
    normals,
    directions,
    first,
    centers,
    reach,
    resolution,
    refine,
    mark,
    state,
    probed,
    words,
    out_o,
    out_d,
    target,
):
    """Rays of all texels above the horizon of the marked cells; `target` is their bit in the words of all receivers.

    A probed texel needs no second ray: its bit is set here.
    """
    n, cells = mark.shape
    texels = len(directions)
    count = 0
    for i in range(n):
        x, y, z = origins[i, 0], origins[i, 1], origins[i, 2]
        for c in range(cells):
            if not mark[i, c]:
                continue
            height = _height(normals, centers, i, c)
            if height < -reach[c]:
                continue
            whole = height > reach[c]
            known = probed[i, c]
            if state[i, c] == OPEN:
                words[i, known >> 6] |= np.uint64(1) << np.uint64(known & 63)
            for a in range(refine):
                row = first[c] + a * resolution
                for t in range(row, row + refine):
                    if t == known:
                        continue
                    if whole or _above(normals, directions, i, t):
                        out_o[count, 0] = x
                        out_o[count, 1] = y
                        out_o[count, 2] = z
                        out_d[count, 0] = directions[t, 0]
                        out_d[count, 1] = directions[t, 1]
                        out_d[count, 2] = directions[t, 2]
                        target[count] = i * texels + t
                        count += 1
    return count


@njit(cache=True)
def _write_bits(target, blocked, words):  # type: ignore[no-untyped-def]
    for r in range(len(blocked)):
        t = target[r]
        at = np.uint64(t & 63)
        here = ~(np.uint64(1) << at) & words[t >> 6]
        words[t >> 6] = here | (np.uint64(not blocked[r]) << at)


@njit(cache=True)
def _cell_of(t, resolution, refine):  # type: ignore[no-untyped-def]
    column = t % resolution
    row = (t // resolution) % resolution
    face = t // (resolution * resolution)
    cells = resolution // refine
    return (face * cells + row // refine) * cells + column // refine


@njit(cache=True)
def _checks(origins, normals, directions, resolution, refine, mark, seed, checks):  # type: ignore[no-untyped-def]
    n = len(origins)
    texels = len(directions)
    out_o = np.empty((n * checks, 3), np.float32)
    out_d = np.empty((n * checks, 3), np.float32)
    owner = np.empty(n * checks, np.int32)
    texel = np.empty(n * checks, np.int32)
    count = 0
    for i in range(n):
        # splitmix64, `checks` steps of the sequence for each receiver: no two share a number
        x = (seed + np.uint64(i)) * np.uint64(checks) * np.uint64(0x9E3779B97F4A7C15)
        for _ in range(checks):
            x += np.uint64(0x9E3779B97F4A7C15)
            z = x
            z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            z = z ^ (z >> np.uint64(31))
            t = np.int64((z >> np.uint64(11)) % np.uint64(texels))
            if mark[i, _cell_of(t, resolution, refine)] or not _above(normals, directions, i, t):
                continue
            for c in range(3):
                out_o[count, c] = origins[i, c]
                out_d[count, c] = directions[t, c]
            owner[count] = i
            texel[count] = t
            count += 1
    return out_o[:count], out_d[:count], owner[:count], texel[:count]


@njit(cache=True)
def _compare(owner, texel, blocked, words, resolution, refine, neighbours, mark, again):  # type: ignore[no-untyped-def]
    wrong = 0
    for r in range(len(owner)):
        i, t = owner[r], texel[r]
        is_open = (words[i, t >> 6] >> np.uint64(t & 63)) & np.uint64(1)
        if (is_open == 1) == blocked[r]:
            wrong += 1
            c = _cell_of(t, resolution, refine)
            again[i, c] = 1
            for k in range(8):
                if not mark[i, neighbours[c, k]]:
                    again[i, neighbours[c, k]] = 1
    return wrong
