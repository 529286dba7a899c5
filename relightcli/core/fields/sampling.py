"""Rays from sample points towards one object, and the sums over what they find.

From a sample outside the bounding sphere, rays go through the cone that the sphere fills; from one inside, everywhere.
They lie on a spherical Fibonacci lattice, turned differently for every sample, so that each stands for the same solid
angle: w = (the cone's solid angle) / (the number of rays).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.sampling import about
from relightcli.core.fields.body import Body, fill_basis
from relightcli.core.sphere import cube
from relightcli.core.transport.sampling import point, stream_key
from relightcli.core.transport.tracer import Tracer

GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


class Found(NamedTuple):
    """What the rays of S samples hit, H hits in the order of their samples.

    start (S + 1,) int64: hits start[s] .. start[s + 1] are those of sample s
    direction (H, 3) float32; point (H, 3) int32: the points at the corners of the face on the side that was hit, -1
    where that side sends nothing; share (H, 3) float32: barycentric weights
    weight (S,) float64: solid angle of every ray, sr; back (S,) int64: how many hits were backs of one-sided faces
    """

    start: NDArray[np.int64]
    direction: NDArray[np.float32]
    point: NDArray[np.int32]
    share: NDArray[np.float32]
    weight: NDArray[np.float64]
    back: NDArray[np.int64]


def sample_points(
    center: NDArray[np.float64], radii: NDArray[np.float64], resolution: int, start: int, stop: int
) -> NDArray[np.float64]:
    """Positions (n, 3) float64 of the samples start .. stop, counted through all shells: shell 6 n n + direction."""
    directions = cube.texel_directions(resolution).reshape(-1, 3)
    index = np.arange(start, stop)
    out: NDArray[np.float64] = center + radii[index // len(directions), None] * directions[index % len(directions)]
    return out


def cone_rays(
    points: NDArray[np.float64], center: NDArray[np.float64], radius: float, count: int, first: int, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Directions (n, count, 3) float32 from points (n, 3) through a sphere, and the solid angle of a ray (n,), sr.

    first: number of the first sample; the result hangs on `seed` and the samples' numbers alone.
    """
    directions = np.empty((len(points), count, 3), np.float32)
    weight = np.empty(len(points))
    _fill_cones(np.ascontiguousarray(points), center, radius, first, seed, _order(count), directions, weight)
    return directions, weight


@lru_cache(maxsize=8)
def _order(count: int) -> NDArray[np.int64]:
    """The lattice's points square by square of the disc that they fill: neighbours are traced together, and hit what
    lies close together in memory."""
    k = np.arange(count)
    radius, phi = np.sqrt((k + 0.5) / count), k * GOLDEN_ANGLE
    x, y = (np.floor(32 * (1 + radius * f(phi))).astype(np.int64) for f in (np.cos, np.sin))
    code = np.zeros(count, np.int64)
    for bit in range(6):
        code |= (x >> bit & 1) << 2 * bit | (y >> bit & 1) << 2 * bit + 1
    return np.argsort(code, kind="stable")


@njit(cache=True)
def _fill_cones(
    points: Any, center: Any, radius: float, first: int, seed: int, order: Any, directions: Any, weight: Any
) -> None:
    count = directions.shape[1]
    for i in range(len(points)):
        x, y, z = center[0] - points[i, 0], center[1] - points[i, 1], center[2] - points[i, 2]
        distance2 = x * x + y * y + z * z
        axis, height = (0.0, 0.0, 1.0), 2.0
        if distance2 > radius * radius:
            distance = math.sqrt(distance2)
            axis = (x / distance, y / distance, z / distance)
            sine2 = radius * radius / distance2
            height = sine2 / (1.0 + math.sqrt(1.0 - sine2))  # 1 - cos of the half-angle
        turn, _ = point(stream_key(seed, first + i, 0), 0, 0)
        weight[i] = 2.0 * math.pi * height / count
        for at in range(count):
            k = order[at]
            down = height * (k + 0.5) / count
            sine = math.sqrt(down * (2.0 - down))
            phi = 2.0 * math.pi * turn + k * GOLDEN_ANGLE
            d = about(axis, sine * math.cos(phi), sine * math.sin(phi), 1.0 - down)
            for c in range(3):
                directions[i, at, c] = d[c]


def trace(
    tracer: Tracer,
    body: Body,
    origins: NDArray[np.float32],
    directions: NDArray[np.float32],
    weight: NDArray[np.float64],
) -> Found:
    """What rays hit: origins (n, 3) in the tracer's frame, directions (n, k, 3), weight (n,) of their rays."""
    n, count = directions.shape[:2]
    flat = np.ascontiguousarray(directions.reshape(-1, 3))
    hits = tracer.intersect(np.repeat(origins, count, axis=0), flat)
    found = np.flatnonzero(hits.face >= 0)
    start = np.zeros(n + 1, np.int64)
    np.cumsum(np.bincount(found // count, minlength=n), out=start[1:])
    points, share = np.empty((len(found), 3), np.int32), np.empty((len(found), 3), np.float32)
    back = np.zeros(n, np.int64)
    _corners(body, found, count, hits.face, hits.u, hits.v, flat, points, share, back)
    return Found(start, flat[found], points, share, weight, back)


@njit(cache=True)
def _corners(
    body: Any, found: Any, count: int, face: Any, u: Any, v: Any, directions: Any, points: Any, share: Any, back: Any
) -> None:
    p = body.positions
    for i in range(len(found)):
        r = found[i]
        a, b, c = body.faces[face[r], 0], body.faces[face[r], 1], body.faces[face[r], 2]
        e1 = (p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2])
        e2 = (p[c, 0] - p[a, 0], p[c, 1] - p[a, 1], p[c, 2] - p[a, 2])
        g = (e1[1] * e2[2] - e1[2] * e2[1], e1[2] * e2[0] - e1[0] * e2[2], e1[0] * e2[1] - e1[1] * e2[0])
        facing = -(g[0] * directions[r, 0] + g[1] * directions[r, 1] + g[2] * directions[r, 2])
        of_vertex = body.front if facing > 0.0 else body.back
        points[i, 0], points[i, 1], points[i, 2] = of_vertex[a], of_vertex[b], of_vertex[c]
        share[i, 0], share[i, 1], share[i, 2] = 1.0 - u[r] - v[r], u[r], v[r]
        if points[i, 0] < 0:
            back[r // count] += 1


def gather(
    found: Found,
    harmonics: NDArray[np.float32],
    exits: NDArray[np.float32],
    body: Body,
    frames: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Coefficients (S, N, K) float32 of the radiance that samples see, for K lights at once:

        out_i = sum over hits of w y_i(direction) sum over corners of share sum over b of g_b(-direction) e_b

    harmonics (H, N), y_i of the directions; exits (P, terms, K), e_b; frames (P, 3, 3) of the points.
    """
    out = np.zeros((len(found.weight), harmonics.shape[1], exits.shape[2]), np.float32)
    _gather(found, harmonics, exits, body.lobe, frames, body.order, out)
    return out


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _gather(found: Any, harmonics: Any, exits: Any, lobe: Any, frames: Any, order: int, out: Any) -> None:
    terms, lights = exits.shape[1], exits.shape[2]
    basis = np.ones(terms)
    w = np.empty(3)
    radiance = np.empty(lights, np.float32)
    for s in range(len(out)):
        total = out[s]
        for r in range(found.start[s], found.start[s + 1]):
            if found.point[r, 0] < 0:
                continue
            radiance[:] = np.float32(0.0)
            for corner in range(3):
                p = found.point[r, corner]
                if terms > 1:
                    for c in range(3):
                        w[c] = -found.direction[r, c]
                    fill_basis(lobe, frames[p], w, order, basis)
                for b in range(terms):
                    f = np.float32(found.share[r, corner] * basis[b])
                    row = exits[p, b]
                    for k in range(lights):
                        radiance[k] += f * row[k]
            for i in range(out.shape[1]):
                f = np.float32(found.weight[s]) * harmonics[r, i]
                for k in range(lights):
                    total[i, k] += f * radiance[k]


def blocked(found: Found, harmonics: NDArray[np.float32]) -> NDArray[np.float64]:
    """Coefficients (S, N) float64 of what the hits hide: sum of w y_i; harmonics (H, N)."""
    out = np.zeros((len(found.weight), harmonics.shape[1]))
    _sum_up(found.start, harmonics, found.weight, out)
    return out


@njit(cache=True)
def _sum_up(start: Any, harmonics: Any, weight: Any, out: Any) -> None:
    for s in range(len(out)):
        for r in range(start[s], start[s + 1]):
            for i in range(out.shape[1]):
                out[s, i] += harmonics[r, i]
        out[s] *= weight[s]
