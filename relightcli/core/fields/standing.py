"""What stands still, as it is seen from sites on and in what moves: its shadow on them, and the light that it sends.

Rays go from every site through the centres of a cube map's texels, so that a sky is shared out over them exactly: a
cell that is open sends

    Y_i = sum over the sky's texels t in it of flux_t y_i(w_t)

whatever is smaller than a cell included. A blocked one sends the exit radiance of the corners of the face that was hit,
times w y_i, w the cell's solid angle. Points between sites: see `sites`.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.separable import TERMS
from relightcli.core.lights.environment import SkyCube
from relightcli.core.parts import in_parts
from relightcli.core.shade.bounces import Exit
from relightcli.core.shade.lobe_factors import LobeFactors, axes_of, send_lobe, waves
from relightcli.core.sphere import cube, sh
from relightcli.core.transport.tracer import Tracer

CELLS = 8  # along a face's side


class Views(NamedTuple):
    """From S sites through K = 6 CELLS^2 cells: distance (S, K) float32 in the world, inf where it is open; receiver
    (S, K, 3) int32 at the corners of the face that was hit, -1 where its side sends nothing; share (S, K, 3) float32.
    """

    distance: NDArray[np.float32]
    receiver: NDArray[np.int32]
    share: NDArray[np.float32]


@lru_cache(maxsize=1)
def _directions() -> NDArray[np.float64]:
    return cube.texel_directions(CELLS).reshape(-1, 3)


@lru_cache(maxsize=1)
def _solid_angles() -> NDArray[np.float64]:
    return np.tile(cube.solid_angles(CELLS).reshape(-1), 6)


@lru_cache(maxsize=4)
def _weighed_harmonics(order: int) -> NDArray[np.float64]:
    out: NDArray[np.float64] = sh.harmonics(_directions(), order) * _solid_angles()[:, None]
    return out


def look_around(
    tracer: Tracer,
    positions: NDArray[np.float64],
    faces: NDArray[np.int32],
    front: NDArray[np.int32],
    back: NDArray[np.int32],
    sites: NDArray[np.float64],
) -> Views:
    """Traces from sites (S, 3); tracer over the mesh positions (V, 3), faces (F, 3); front, back (V,): receivers."""
    directions = _directions().astype(np.float32)
    count = len(directions)
    origins = np.repeat(tracer.to_local(sites), count, axis=0)
    hits = tracer.intersect(origins, np.tile(directions, (len(sites), 1)))
    distance = (np.where(hits.face >= 0, hits.distance, np.inf) / tracer.scale).astype(np.float32)
    receiver = np.full((len(origins), 3), -1, np.int32)
    share = np.zeros((len(origins), 3), np.float32)
    _corners(hits.face, hits.u, hits.v, directions, positions, faces, front, back, receiver, share)
    shape = len(sites), count
    return Views(distance.reshape(shape), receiver.reshape(*shape, 3), share.reshape(*shape, 3))


@njit(cache=True)
def _corners(  # type: ignore[no-untyped-def]
    face, u, v, directions, positions, faces, front, back, receiver, share
):
    for r in range(len(face)):
        if face[r] < 0:
            continue
        a, b, c = faces[face[r], 0], faces[face[r], 1], faces[face[r], 2]
        p, q, s = positions[a], positions[b], positions[c]
        e1 = (q[0] - p[0], q[1] - p[1], q[2] - p[2])
        e2 = (s[0] - p[0], s[1] - p[1], s[2] - p[2])
        g = (e1[1] * e2[2] - e1[2] * e2[1], e1[2] * e2[0] - e1[0] * e2[2], e1[0] * e2[1] - e1[1] * e2[0])
        d = directions[r % len(directions)]
        of_vertex = front if g[0] * d[0] + g[1] * d[1] + g[2] * d[2] < 0.0 else back
        receiver[r, 0], receiver[r, 1], receiver[r, 2] = of_vertex[a], of_vertex[b], of_vertex[c]
        share[r, 0], share[r, 1], share[r, 2] = 1.0 - u[r] - v[r], u[r], v[r]


def sky_cells(sky: SkyCube, order: int) -> NDArray[np.float64]:
    """Y (K, 3, N) float64 of every cell; the sky's resolution is a multiple of CELLS."""
    directions = cube.texel_directions(sky.resolution).reshape(-1, 3)
    cell = cube.texel_index(directions, CELLS)
    y = sh.harmonics(directions, order)
    out = np.empty((6 * CELLS * CELLS, 3, order * order))
    for c in range(3):
        for i in range(order * order):
            out[:, c, i] = np.bincount(cell, sky.flux[:, c] * y[:, i], len(out))
    return out


def light_from_sky(views: Views, cells: NDArray[np.float64], threads: int = 1) -> NDArray[np.float32]:
    """Light (S, 3, N) float32 of the sky past what stands, in the world's frame."""
    k = len(cells)
    out = np.zeros((len(views.distance), cells.size // k))
    flat = np.ascontiguousarray(cells.reshape(k, -1))
    in_parts(lambda a, b: _add_open(views.distance[a:b], flat, out[a:b]), len(out), threads)
    return out.reshape(-1, *cells.shape[1:]).astype(np.float32)


@njit(cache=True, nogil=True)
def _add_open(distance, cells, out):  # type: ignore[no-untyped-def]
    for s in range(len(distance)):
        for k in range(distance.shape[1]):
            if distance[s, k] == np.inf:
                out[s] += cells[k]


def light_from_surfaces(
    views: Views, exits: NDArray[np.float32], order: int, covered: NDArray[np.bool_], threads: int = 1
) -> NDArray[np.float32]:
    """Light (S, 3, N) float32 that the surfaces send whose exit radiance is exits (receivers, 3). Where some corners of
    a face are covered (receivers,), the others speak for it."""
    y = _weighed_harmonics(order)
    out = np.zeros((len(views.distance), 3, order * order))

    def part(a: int, b: int) -> None:
        _add_hits(views.receiver[a:b], views.share[a:b], exits, y, covered, out[a:b])

    in_parts(part, len(out), threads)
    return out.astype(np.float32)


@njit(cache=True, nogil=True)
def _add_hits(receiver, share, exits, y, covered, out):  # type: ignore[no-untyped-def]
    for s in range(len(receiver)):
        for k in range(receiver.shape[1]):
            clear = 0.0
            for j in range(3):
                if receiver[s, k, j] >= 0 and not covered[receiver[s, k, j]]:
                    clear += share[s, k, j]
            if clear <= 0.0:
                continue
            for c in range(3):
                total = 0.0
                for j in range(3):
                    if receiver[s, k, j] >= 0 and not covered[receiver[s, k, j]]:
                        total += share[s, k, j] * exits[receiver[s, k, j], c]
                total /= clear
                for i in range(y.shape[1]):
                    out[s, c, i] += total * y[k, i]


def light_from_lobes(
    views: Views,
    light: Exit,
    normals: NDArray[np.float32],
    material: NDArray[np.int32],
    factors: LobeFactors,
    order: int,
    covered: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Light (S, 3, N) float32 of the surfaces' specular lobes, as `shade.bounces` sends it; of a face, that of the
    corner next to the hit. normals, material of the receivers."""
    directions, y = _directions(), _weighed_harmonics(order)
    out = np.zeros((len(views.distance), 3, order * order))
    _add_lobes(views.receiver, views.share, directions, light, normals, material, factors, y, covered, out)
    return out.astype(np.float32)


@njit(cache=True, error_model="numpy")
def _add_lobes(  # type: ignore[no-untyped-def]
    receiver, share, directions, light, normals, material, factors, y, covered, out
):
    wave = np.empty((2, TERMS), np.float32)
    for s in range(len(receiver)):
        for k in range(receiver.shape[1]):
            at, most = -1, np.float32(0.0)
            for j in range(3):
                r = receiver[s, k, j]
                if r >= 0 and not covered[r] and share[s, k, j] > most:
                    at, most = r, share[s, k, j]
            if at < 0 or light.row[at] < 0:
                continue
            m = material[at]
            axes = axes_of((np.float64(normals[at, 0]), np.float64(normals[at, 1]), np.float64(normals[at, 2])))
            back = (-directions[k, 0], -directions[k, 1], -directions[k, 2])
            if not waves(factors.view_factor[m], axes, back, wave):
                continue
            found = send_lobe(wave, light.lobe[light.row[at]])
            for c in range(3):
                sent = max(found[c] * factors.colour[m, c], 0.0)
                for i in range(y.shape[1]):
                    out[s, c, i] += sent * y[k, i]


def unhidden(
    views: Views, sites: NDArray[np.float64], centers: NDArray[np.float64], radii: NDArray[np.float64], threads: int = 1
) -> NDArray[np.float32]:
    """Share (S, E) of balls, centers (E, 3), radii (E,), that nothing standing hides from the sites: of the cells in a
    ball's cone, which is taken as wide as a cell at least, those that nothing blocks before the ball's middle."""
    out = np.ones((len(sites), len(centers)), np.float32)
    p = np.ascontiguousarray(sites)

    def part(a: int, b: int) -> None:
        _unhidden(views.distance[a:b], _directions(), _solid_angles(), p[a:b], centers, radii, out[a:b])

    in_parts(part, len(sites), threads)
    return out


@njit(cache=True, nogil=True)
def _unhidden(distance, directions, solid, sites, centers, radii, out):  # type: ignore[no-untyped-def]
    narrow = 1.0 / math.sqrt(1.0 + 2.0 / (CELLS * CELLS))  # a cone of a larger cosine may have no cell's centre in it
    for s in range(len(sites)):
        nearest = np.inf
        for k in range(len(directions)):
            nearest = min(nearest, distance[s, k])
        for e in range(len(centers)):
            x, y, z = centers[e, 0] - sites[s, 0], centers[e, 1] - sites[s, 1], centers[e, 2] - sites[s, 2]
            far2 = x * x + y * y + z * z
            if far2 <= radii[e] * radii[e] or nearest * nearest >= far2:
                continue
            least = math.sqrt(far2) * min(math.sqrt(1.0 - radii[e] * radii[e] / far2), narrow)
            total = hidden = 0.0
            for k in range(len(directions)):
                # Distance of the middle of the ball's chord along the cell's direction.
                middle = directions[k, 0] * x + directions[k, 1] * y + directions[k, 2] * z
                if middle >= least:
                    total += solid[k]
                    if distance[s, k] < middle:
                        hidden += solid[k]
            if total > 0.0:
                out[s, e] = 1.0 - hidden / total
