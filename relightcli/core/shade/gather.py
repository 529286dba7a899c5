"""Who sees whom, with what weight: the hits of `transport.hits` and the blocked parts of their cells."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.sphere import cube


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


@lru_cache(maxsize=2)
def _texel_moments(resolution: int) -> NDArray[np.float32]:
    """(6 R R, 4) float32: integral of the direction over every texel (at its centre), and its solid angle."""
    directions = cube.texel_directions(resolution).reshape(-1, 3)
    solid = np.tile(cube.solid_angles(resolution).reshape(-1), 6)[:, None]
    return np.concatenate([directions * solid, solid], axis=1).astype(np.float32)


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
    moments = _texel_moments(resolution)
    normals = np.ascontiguousarray(normals, np.float32)

    def part(a: int, b: int) -> None:
        _weigh(flat[a:b], words[a:b], normals[a:b], moments, resolution, start[a:b], out)

    in_parts(part, len(hits), threads)
    return out


def join(parts: list[Gather]) -> Gather:
    """The entries of consecutive ranges of receivers in one."""
    if len(parts) == 1:
        return parts[0]
    counts = np.concatenate([np.diff(part.start) for part in parts])
    return Gather(
        parts[0].cells,
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        np.concatenate([part.source for part in parts]),
        np.concatenate([part.cell for part in parts]),
        np.concatenate([part.cosine for part in parts]),
        np.concatenate([part.solid_angle for part in parts]),
    )


def in_parts(work: Callable[[int, int], None], count: int, threads: int) -> None:
    cuts = np.linspace(0, count, 8 * max(1, threads) + 1).astype(int)
    with ThreadPoolExecutor(max(1, threads)) as pool:
        for job in [pool.submit(work, a, b) for a, b in itertools.pairwise(cuts.tolist()) if b > a]:
            job.result()


@njit(cache=True, nogil=True)
def _weigh(flat, words, normals, moments, resolution, start, out):  # type: ignore[no-untyped-def]
    cells = out.cells
    side = resolution // cells
    for i in range(len(flat)):
        z = start[i]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        for c in range(flat.shape[1]):
            if flat[i, c] == 0:
                continue
            face, row, column = c // (cells * cells), (c // cells) % cells, c % cells
            w = s = np.float32(0.0)
            for a in range(side):
                t = (face * resolution + row * side + a) * resolution + column * side
                for b in range(t, t + side):
                    if (words[i, b >> 3] >> np.uint8(b & 7)) & np.uint8(1):
                        continue
                    height = nx * moments[b, 0] + ny * moments[b, 1] + nz * moments[b, 2]
                    if height > np.float32(0.0):
                        w += height
                        s += moments[b, 3]
            out.source[z], out.cell[z], out.cosine[z], out.solid_angle[z] = flat[i, c] - 1, c, w, s
            z += 1
