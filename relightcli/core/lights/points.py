"""The few small and bright places of a map that deserve light of their own: a sun, a lamp.

A cluster's visible fraction blurs the shadow of a light that is much smaller than the cluster. What lies in one texel
of a fine cube and has a good part of all flux is therefore taken out of the map and handed over as points, for which
rays can tell exactly who sees them: one point, or where the part is large up to three a side, for the penumbra.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.lights.latlong import texel_solid_angles
from relightcli.core.sphere import cube

RESOLUTION = 256  # of the cube: 0.35 degrees
WIDEST = math.radians(0.75)  # of a pixel: larger ones are no points but areas
LEAST = 0.01  # of the map's flux
MOST = 24  # texels
FINER = (0.05, 0.3)  # of the map's flux: from here on 2, and 3, points along the side of a texel


class Points(NamedTuple):
    """direction (K, 3) unit, mean of what each holds; flux (K, 3); both float64."""

    direction: NDArray[np.float64]
    flux: NDArray[np.float64]


def both(one: Points, other: Points) -> Points:
    """Those of one, then those of the other."""
    return Points(*(np.concatenate(pair) for pair in zip(one, other, strict=True)))


class Rows(NamedTuple):
    """Luminance of the flux of every row of a map, and of its brightest pixel's radiance, (H,) float64."""

    flux: NDArray[np.float64]
    peak: NDArray[np.float64]


def row_light(radiance: NDArray[np.float32], known: Rows | None = None, rows: NDArray[np.int64] | None = None) -> Rows:
    """Light of the rows of a map (H, W, 3). rows (k,): those in which it differs from the map that `known` is of."""
    height, width = radiance.shape[:2]
    found = Rows(np.empty(height), np.empty(height)) if known is None else Rows(known.flux.copy(), known.peak.copy())
    chosen = np.arange(height) if known is None or rows is None else rows
    _row_light(np.ascontiguousarray(radiance, np.float32), texel_solid_angles(height, width), chosen, *found)
    return found


def split_points(
    radiance: NDArray[np.float32], rotate_degrees: float = 0.0, light: Rows | None = None
) -> tuple[NDArray[np.float32], Points, NDArray[np.int64]]:
    """A map (H, W, 3) without its points, the points as they lie after a turn by `rotate_degrees` about +Y, and the
    flat indices of the pixels that went into them, rising. The map is returned as it is if there are none.

    light: that of its rows, if it is known.
    """
    height, width = radiance.shape[:2]
    none = Points(np.zeros((0, 3)), np.zeros((0, 3)))
    if math.pi / height > WIDEST or 2.0 * math.pi / width > WIDEST:
        return radiance, none, np.zeros(0, np.int64)
    solid = texel_solid_angles(height, width)
    source = np.ascontiguousarray(radiance, np.float32)
    rows, peaks = row_light(source) if light is None else light
    least = LEAST * float(rows.sum())
    # The mean over a texel and the pixels on its rim: if it has enough, one of them is as bright.
    level = least / (16.0 * math.pi / (6 * RESOLUTION**2) + solid)
    bright = _brighter(source, level, peaks) if least > 0.0 else np.zeros(0, np.int64)
    if len(bright) == 0:
        return radiance, none, bright
    row, column = np.divmod(bright, width)
    turn = math.radians(math.fmod(rotate_degrees, 360.0))
    d = pixel_parts(row, column, (height, width), turn, 1).reshape(-1, 3)
    flux = source.reshape(-1, 3)[bright].astype(np.float64) * solid[row, None]
    texel, owner = np.unique(cube.texel_index(d, RESOLUTION), return_inverse=True)
    total = np.bincount(owner, _luminance(flux), len(texel))
    chosen = np.argsort(-total, kind="stable")[:MOST]
    chosen = np.sort(chosen[total[chosen] >= least])
    if len(chosen) == 0:
        return radiance, none, np.zeros(0, np.int64)
    found = []
    for k in chosen:
        own = np.flatnonzero(owner == k)
        parts = 1 + int(np.searchsorted(FINER, total[k] / float(rows.sum()), side="right"))
        found.append(_points(row[own], column[own], flux[own], (height, width), turn, parts))
    taken = bright[np.isin(owner, chosen)]
    rest = source.copy()
    rest.reshape(-1, 3)[taken] = 0.0
    return rest, Points(*(np.concatenate(part) for part in zip(*found, strict=True))), taken


def _points(
    row: NDArray[np.int64],
    column: NDArray[np.int64],
    flux: NDArray[np.float64],
    size: tuple[int, int],
    turn: float,
    parts: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (K, 3) and flux (K, 3) of the pixels of a texel, as `parts` x `parts` points or a few more.

    Few pixels are cut, many are gathered by the texels of a cube that is `parts` times finer.
    """
    cuts = math.ceil(parts / math.sqrt(len(row)))
    d = pixel_parts(row, column, size, turn, cuts).reshape(-1, 3)
    flux = np.repeat(flux / cuts**2, cuts**2, axis=0)
    texel = np.arange(len(d)) if 1 < len(d) == parts**2 else cube.texel_index(d, RESOLUTION * parts)
    kinds, owner = np.unique(texel, return_inverse=True)
    weight = flux.sum(axis=1)
    mean = np.stack([np.bincount(owner, weight * d[:, x], len(kinds)) for x in range(3)], axis=1)
    summed: NDArray[np.float64] = np.stack([np.bincount(owner, flux[:, c], len(kinds)) for c in range(3)], axis=1)
    return mean / np.linalg.norm(mean, axis=1, keepdims=True), summed


def pixel_parts(
    row: NDArray[np.int64], column: NDArray[np.int64], size: tuple[int, int], turn: float, parts: int
) -> NDArray[np.float64]:
    """Directions (n, parts, parts, 3) of n pixels' parts of equal solid angle; turn: of the map about +Y, radians."""
    height, width = size
    place = (np.arange(parts) + 0.5) / parts
    top, bottom = np.cos(np.pi * row / height), np.cos(np.pi * (row + 1) / height)
    sine = (top[:, None] + (bottom - top)[:, None] * place)[:, :, None]
    longitude = (np.pi * (1.0 - 2.0 * (column[:, None] + place) / width) + turn)[:, None, :]
    cosine = np.sqrt(np.maximum(1.0 - sine * sine, 0.0))
    sine = np.broadcast_to(sine, (len(row), parts, parts))
    return np.stack([np.sin(longitude) * cosine, sine, np.cos(longitude) * cosine], axis=-1)


def _luminance(flux: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.2126 * flux[:, 0] + 0.7152 * flux[:, 1] + 0.0722 * flux[:, 2]


@njit(cache=True, nogil=True)
def _row_light(radiance, solid, chosen, flux, peak):  # type: ignore[no-untyped-def]
    for i in chosen:
        total, most = 0.0, np.float32(0.0)
        for j in range(radiance.shape[1]):
            y = _luminance_of(radiance, i, j)
            total += y
            most = max(most, y)
        flux[i], peak[i] = total * solid[i], most


@njit(cache=True, nogil=True)
def _luminance_of(radiance, i, j):  # type: ignore[no-untyped-def]
    return (
        np.float32(0.2126) * radiance[i, j, 0]
        + np.float32(0.7152) * radiance[i, j, 1]
        + np.float32(0.0722) * radiance[i, j, 2]
    )


def _brighter(
    radiance: NDArray[np.float32], level: NDArray[np.float64], peaks: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Flat indices of the pixels as bright as their row's level."""
    rows = np.flatnonzero(peaks >= level)
    out = np.empty(4096, np.int64)
    while True:
        count = _find_brighter(radiance, level, rows, out)
        if count <= len(out):
            return out[:count]
        out = np.empty(count, np.int64)


@njit(cache=True, nogil=True)
def _find_brighter(radiance, level, rows, out):  # type: ignore[no-untyped-def]
    count = 0
    for i in rows:
        for j in range(radiance.shape[1]):
            if _luminance_of(radiance, i, j) >= level[i]:
                if count < len(out):
                    out[count] = i * radiance.shape[1] + j
                count += 1
    return count
