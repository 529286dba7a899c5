"""A sky convolved with Gaussian lobes, one cube for every width. [Sun 2007, sec. 4.1]

    E_k(r) = integral of L(w) G_k(angle(w, r)) dw,   the G_k of `brdf.specular_lobes`, of integral 1

at the nodes of a grid on every face of a cube, (n + 1) x (n + 1) with the face's border, so that a look-up never leaves
its face. Light is summed as points, at the mean direction of what every texel holds: a sun keeps its place and its
energy. For 0 degrees, a delta, a node has the mean radiance of the up to four texels that meet there; so light between
the nodes keeps its energy too, and a finer sky may be given for it.

Bilinear look-up widens a lobe by itself, by the variance spacing^2 / 6 per axis; the Gaussian is narrower by as much.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.lights.environment import SkyCube
from relightcli.core.parts import in_parts
from relightcli.core.sphere import cube

# A lobe is summed over this many standard deviations.
_REACH = 4.0
# Texels along the side of a tile.
_TILE = 4
# Node spacing in standard deviations, on the mean; and what source texels may be at most.
_SPACING, _SOURCE = 0.6, 0.62


def prefiltered_sky(
    sky: SkyCube, degrees: Sequence[float], mirror: SkyCube | None = None, threads: int = 1
) -> tuple[NDArray[np.float32], ...]:
    """One array (6, n+1, n+1, 4) float32 per lobe: red, green, blue radiance [face, row, column], and 0.

    degrees: of the lobes, as in `SpecularLobes`; mirror: the sky of the 0 degree lobe, `sky` if not given.
    """
    lights: dict[int, NDArray[np.float32]] = {}  # by the resolution that lobes take light from
    found = []
    for degree in degrees:
        if degree == 0.0:
            found.append(_corners(sky if mirror is None else mirror))
            continue
        plan = _plan(sky.resolution, degree, threads)
        if plan.source not in lights:
            lights[plan.source] = _light(sky, plan.source)
        found.append(_gaussian(plan, lights[plan.source], threads))
    return tuple(found)


def _corners(sky: SkyCube) -> NDArray[np.float32]:
    around, share = _meeting_texels(sky.resolution)
    radiance = (sky.flux / np.tile(cube.solid_angles(sky.resolution).reshape(-1), 6)[:, None]).astype(np.float32)
    out = np.zeros((len(around), 4), np.float32)
    _meet(around, share, radiance, out)
    r = sky.resolution
    return out.reshape(6, r + 1, r + 1, 4)


@lru_cache(maxsize=2)
def _meeting_texels(r: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Texels (m, 8) around the nodes of an R x R grid per face, some repeated, and their shares of the solid angle."""
    node = _nodes(r).reshape(-1, 3)
    # A step from a corner to each side finds the texels that meet there.
    step = np.stack(np.meshgrid((-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0), indexing="ij"), -1).reshape(-1, 3) / (8.0 * r)
    around = np.sort(cube.texel_index(node[:, None] + step, r), axis=1)
    first = np.ones(around.shape, bool)
    first[:, 1:] = around[:, 1:] != around[:, :-1]
    weight = np.tile(cube.solid_angles(r).reshape(-1), 6)[around] * first
    return around, (weight / weight.sum(1, keepdims=True)).astype(np.float32)


class _Plan(NamedTuple):
    """Where the light of a lobe comes from. The tiles near node m are tile[start[m] : start[m + 1]], and weight
    (pairs, T) float32 is the lobe's kernel, of integral 1, at the centres of their T texels."""

    node: NDArray[np.float32]
    start: NDArray[np.int64]
    tile: NDArray[np.int32]
    weight: NDArray[np.float32]
    source: int
    narrow: float


def _gaussian(plan: _Plan, light: NDArray[np.float32], threads: int) -> NDArray[np.float32]:
    out = np.zeros((len(plan.node), 4), np.float32)
    steep = np.float32(1.0 / plan.narrow**2)
    in_parts(
        lambda a, b: _convolve(plan.node[a:b], plan.start[a : b + 1], plan.tile, plan.weight, light, steep, out[a:b]),
        len(plan.node),
        threads,
    )
    n = math.isqrt(len(plan.node) // 6)
    return out.reshape(6, n, n, 4)


def _light(sky: SkyCube, source: int) -> NDArray[np.float32]:
    """Flux of texels that are source to a face's side, and the way from their centre to their light's mean direction:
    (tiles, 6, T)."""
    tile = min(_TILE, source)
    out = np.empty((6 * (source // tile) ** 2, 6, tile * tile), np.float32)
    _sum_texels(sky.flux, sky.moment, source, sky.resolution // source, tile, _centers(source), out)
    return out


@lru_cache(maxsize=8)
def _centers(source: int) -> NDArray[np.float64]:
    return np.ascontiguousarray(cube.texel_directions(source).reshape(-1, 3), np.float64)


@lru_cache(maxsize=8)
def _plan(resolution: int, degrees: float, threads: int) -> _Plan:
    sigma = math.radians(degrees) / 3.0
    n = max(4, round(0.5 * math.pi / (_SPACING * sigma)))
    spacing = math.sqrt(4.0 * math.pi / 6.0) / n
    narrow = math.sqrt(sigma * sigma - spacing * spacing / 6.0)
    source = resolution
    while source > 8 and 0.5 * math.pi / (source // 2) <= _SOURCE * sigma:
        source //= 2
    end = min(math.pi, _REACH * narrow)
    t = np.linspace(0.0, end, 4001)
    integral = 2.0 * math.pi * float(np.trapezoid(np.exp(-0.5 * (t / narrow) ** 2) * np.sin(t), t))
    node = _nodes(n).reshape(-1, 3).astype(np.float32)
    side = source // min(_TILE, source)
    tiles = cube.texel_directions(side).reshape(-1, 3).astype(np.float32)
    reach = (np.float32(math.cos(min(math.pi, end + 1.5 / side))), 2.0 - 2.0 * math.cos(end))
    center = _by_tile(cube.texel_directions(source).reshape(-1, 3), source)
    count = np.zeros(len(node), np.int64)
    in_parts(lambda a, b: _count(node[a:b], tiles, center, *reach, count[a:b]), len(node), threads)
    start = np.concatenate([[0], np.cumsum(count)])
    tile = np.empty(start[-1], np.int32)
    weight = np.empty((start[-1], center.shape[2]), np.float32)
    kernel = (-0.5 / narrow**2, 1.0 / integral)
    in_parts(
        lambda a, b: _weigh(node[a:b], start[a:b], tiles, center, *reach, *kernel, tile, weight),
        len(node),
        threads,
    )
    return _Plan(node, start, tile, weight, source, narrow)


def _by_tile(values: NDArray[np.float64], source: int) -> NDArray[np.float32]:
    """Per tile of texels, which are in rows: (tiles, k, T) float32 of values (6 R R, k)."""
    tile = min(_TILE, source)
    side = source // tile
    found = values.reshape(6, side, tile, side, tile, -1).transpose(0, 1, 3, 5, 2, 4)
    return np.ascontiguousarray(found.reshape(6 * side * side, -1, tile * tile), np.float32)


def _nodes(n: int) -> NDArray[np.float64]:
    """Directions (6, n+1, n+1, 3) of the corners of n x n texels per face."""
    edge = 2.0 * np.arange(n + 1) / n - 1.0
    return np.stack([cube.face_directions(face, edge[None, :], edge[:, None]) for face in range(6)])


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_texels(flux, moment, source, shrink, tile, center, out):  # type: ignore[no-untyped-def]
    fine, side = source * shrink, source // tile
    sums = np.empty((2, 3))  # flux by colour, moment of all colours
    for texel in range(len(center)):
        face, row, column = texel // (source * source), texel // source % source, texel % source
        sums[:] = 0.0
        for i in range(row * shrink, (row + 1) * shrink):
            for j in range(column * shrink, (column + 1) * shrink):
                of = (face * fine + i) * fine + j
                for c in range(3):
                    sums[0, c] += flux[of, c]
                    for axis in range(3):
                        sums[1, axis] += moment[of, c, axis]
        to = out[(face * side + row // tile) * side + column // tile]
        place = row % tile * tile + column % tile
        length = math.sqrt(sums[1, 0] ** 2 + sums[1, 1] ** 2 + sums[1, 2] ** 2)
        for c in range(3):
            to[c, place] = sums[0, c]
            to[3 + c, place] = sums[1, c] / length - center[texel, c] if length > 0.0 else 0.0


@njit(cache=True, nogil=True)
def _meet(around, share, radiance, out):  # type: ignore[no-untyped-def]
    for m in range(len(around)):
        for k in range(8):
            for c in range(3):
                out[m, c] += share[m, k] * radiance[around[m, k], c]


@njit(cache=True, nogil=True)
def _reached(x, y, z, tiles, center, near, end, c):  # type: ignore[no-untyped-def]
    """Whether any texel of tile c has a centre whose chord's square from the node is below `end`."""
    if x * tiles[c, 0] + y * tiles[c, 1] + z * tiles[c, 2] < near:  # none by far
        return False
    for t in range(center.shape[2]):
        dx, dy, dz = x - center[c, 0, t], y - center[c, 1, t], z - center[c, 2, t]
        if dx * dx + dy * dy + dz * dz < end:
            return True
    return False


@njit(cache=True, nogil=True)
def _count(node, tiles, center, near, end, count):  # type: ignore[no-untyped-def]
    for m in range(len(node)):
        x, y, z = node[m, 0], node[m, 1], node[m, 2]
        for c in range(len(tiles)):
            count[m] += _reached(x, y, z, tiles, center, near, end, c)


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(node, start, tiles, center, near, end, exponent, scale, tile, weight):  # type: ignore[no-untyped-def]
    for m in range(len(node)):
        x, y, z = node[m, 0], node[m, 1], node[m, 2]
        p = start[m]
        for c in range(len(tiles)):
            if not _reached(x, y, z, tiles, center, near, end, c):
                continue
            tile[p] = c
            for t in range(center.shape[2]):
                # Not 2 - 2 cos, of which single precision keeps three digits within a degree.
                dx, dy, dz = x - center[c, 0, t], y - center[c, 1, t], z - center[c, 2, t]
                q = dx * dx + dy * dy + dz * dz
                # t^2 = q + q^2 / 12 + q^3 / 90 + ... of the chord's square q
                square = q * (1.0 + q * (1.0 / 12.0 + q * (1.0 / 90.0)))
                weight[p, t] = scale * math.exp(exponent * square) if q < end else 0.0
            p += 1


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _convolve(node, start, tile, weight, light, steep, out):  # type: ignore[no-untyped-def]
    """light (tiles, 6, T): flux, and the way from a texel's centre to its light; steep: 1 over the kernel's variance.
    The kernel is exp(steep r . way) times that at the centre; the series is within 1 % of the peak."""
    one = np.float32(1.0)
    for m in range(len(node)):
        x, y, z = steep * node[m, 0], steep * node[m, 1], steep * node[m, 2]
        red = green = blue = np.float32(0.0)
        for p in range(start[m], start[m + 1]):
            of, w = light[tile[p]], weight[p]
            for t in range(w.shape[0]):
                u = x * of[3, t] + y * of[4, t] + z * of[5, t]
                v = w[t] * (one + u * (one + u * (np.float32(0.5) + u * np.float32(1.0 / 6.0))))
                red += v * of[0, t]
                green += v * of[1, t]
                blue += v * of[2, t]
        out[m, 0], out[m, 1], out[m, 2] = red, green, blue


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def place_on_cube(x: Any, y: Any, z: Any) -> Any:
    """Face and the coordinates s, t in [-1, 1] on it of a direction, float32 that is not 0."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        w = np.float32(1.0) / ax
        return (0, -z * w, -y * w) if x > 0 else (1, z * w, -y * w)
    if ay >= az:
        w = np.float32(1.0) / ay
        return (2, x * w, z * w) if y > 0 else (3, x * w, -z * w)
    w = np.float32(1.0) / az
    return (4, x * w, -y * w) if z > 0 else (5, -x * w, -y * w)
