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
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.lights.environment import SkyCube
from relightcli.core.shade.gather import in_parts
from relightcli.core.sphere import cube

# exp(x) as (1 + x / 2^10)^(2^10): within 1e-3 of the peak.
_POWER = 1024.0
# A lobe is summed over this many standard deviations.
_REACH = 4.5
# Node spacing in standard deviations, on the mean; and what source texels may be at most.
_SPACING, _SOURCE = 0.6, 0.62


def prefiltered_sky(
    sky: SkyCube, degrees: Sequence[float], mirror: SkyCube | None = None, threads: int = 1
) -> tuple[NDArray[np.float32], ...]:
    """One array (6, n+1, n+1, 4) float32 per lobe: red, green, blue radiance [face, row, column], and 0.

    degrees: of the lobes, as in `SpecularLobes`; mirror: the sky of the 0 degree lobe, `sky` if not given.
    """
    return tuple(
        _gaussian(sky, degree, threads) if degree > 0.0 else _corners(sky if mirror is None else mirror)
        for degree in degrees
    )


def _corners(sky: SkyCube) -> NDArray[np.float32]:
    around, share = _meeting_texels(sky.resolution)
    radiance = (sky.flux / np.tile(cube.solid_angles(sky.resolution).reshape(-1), 6)[:, None]).astype(np.float32)
    out = np.zeros((len(around), 4), np.float32)
    for k in range(8):
        out[:, :3] += share[:, k, None] * radiance[around[:, k]]
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


def _gaussian(sky: SkyCube, degrees: float, threads: int) -> NDArray[np.float32]:
    sigma = math.radians(degrees) / 3.0
    n = max(4, round(0.5 * math.pi / (_SPACING * sigma)))
    spacing = math.sqrt(4.0 * math.pi / 6.0) / n
    narrow = math.sqrt(sigma * sigma - spacing * spacing / 6.0)
    source = sky.resolution
    while source > 8 and 0.5 * math.pi / (source // 2) <= _SOURCE * sigma:
        source //= 2
    shrink = sky.resolution // source
    flux = sky.flux.reshape(6, source, shrink, source, shrink, 3).sum(axis=(2, 4)).reshape(-1, 3)
    moment = sky.moment.sum(axis=1).reshape(6, source, shrink, source, shrink, 3).sum(axis=(2, 4)).reshape(-1, 3)
    length = np.sqrt((moment**2).sum(1, keepdims=True))
    center = cube.texel_directions(source).reshape(-1, 3)
    direction = np.where(length > 0.0, moment / np.where(length > 0.0, length, 1.0), center)
    tile = max(1, source // 8)
    tiles = cube.texel_directions(source // tile).reshape(-1, 3)
    node = _nodes(n).reshape(-1, 3).astype(np.float32)
    out = np.zeros((len(node), 4), np.float32)
    # exp(-t^2 / (2 sigma^2)) over its integral, with x = 2 - 2 cos t for t^2 as in `_convolve`.
    end = min(math.pi, _REACH * narrow)
    t = np.linspace(0.0, end, 4001)
    scale = 1.0 / (2.0 * math.pi * float(np.trapezoid(np.exp(-0.5 * (t / narrow) ** 2) * np.sin(t), t)))
    arguments = (
        _by_tile(np.concatenate([direction, scale * flux], axis=1), source, tile),
        tiles.astype(np.float32),
        np.float32(math.cos(min(math.pi, end + 1.5 / (source // tile)))),
        np.float32(2.0 - 2.0 * math.cos(end)),
        np.float32(-0.5 / (narrow * narrow * _POWER)),
    )
    in_parts(lambda a, b: _convolve(node[a:b], *arguments, out[a:b]), len(node), threads)
    return out.reshape(6, n + 1, n + 1, 4)


def _by_tile(values: NDArray[np.float64], source: int, tile: int) -> NDArray[np.float32]:
    """Per tile of texels, which are in rows: (tiles, 6, tile tile) float32 of values (6 R R, 6)."""
    side = source // tile
    found = values.reshape(6, side, tile, side, tile, 6).transpose(0, 1, 3, 5, 2, 4)
    return np.ascontiguousarray(found.reshape(6 * side * side, 6, tile * tile), np.float32)


def _nodes(n: int) -> NDArray[np.float64]:
    """Directions (6, n+1, n+1, 3) of the corners of n x n texels per face."""
    edge = 2.0 * np.arange(n + 1) / n - 1.0
    return np.stack([cube.face_directions(face, edge[None, :], edge[:, None]) for face in range(6)])


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _convolve(node, light, tiles, near, end, exponent, out):  # type: ignore[no-untyped-def]
    """light (tiles, 6, texels): direction, and flux over the kernel's integral. The exponential is a power, so that the
    loop over a tile becomes vector instructions."""
    one, two = np.float32(1.0), np.float32(2.0)
    for m in range(len(node)):
        x, y, z = node[m, 0], node[m, 1], node[m, 2]
        red = green = blue = np.float32(0.0)
        for c in range(len(tiles)):
            if x * tiles[c, 0] + y * tiles[c, 1] + z * tiles[c, 2] < near:
                continue
            of = light[c]
            for t in range(of.shape[1]):
                q = max(two - two * (x * of[0, t] + y * of[1, t] + z * of[2, t]), np.float32(0.0))
                # t^2 = q + q^2 / 12 + q^3 / 90 + ... of the chord's square q
                w = one + exponent * q * (one + q * (np.float32(1.0 / 12.0) + q * np.float32(1.0 / 90.0)))
                w *= w
                w *= w
                w *= w
                w *= w
                w *= w
                w *= w
                w *= w
                w *= w
                w *= w
                w *= w
                w = w if q < end else np.float32(0.0)
                red += w * of[3, t]
                green += w * of[4, t]
                blue += w * of[5, t]
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
