"""The few cells of a clustering that hold a good part of a map's light, cut into smaller lights.

A cluster's error is made for any light in it; what a map makes of it is its share of all flux times that error. A
window or a screen that fills a corner of one cell may hold half the light of a room: one value per receiver then costs
percents, where the sum over thousands of dimmer cells averages its errors out. Cells whose share of the error is large
are therefore summed as up to 4 x 4 lights, each in the middle of its part, whose visibility rays can tell.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.lights.latlong import LUMINANCE, texel_of, texel_solid_angles
from relightcli.core.lights.points import Points
from relightcli.core.sphere import cube

LEAST = 0.002  # share of the flux times the error of a cell that is worth being cut
MOST = 8  # cells
TIE = 1e-3  # shares of the error that differ by less are alike: cells are cut together, or not at all
PARTS = 4  # along a cell's side
FINE, FINEST = 16, 32  # lights along the side of a part that pixels are cut for; of a pixel's side, at most


def bright_cells(flux: NDArray[np.float64], error: NDArray[np.floating]) -> NDArray[np.int64]:
    """Rising indices (k,) of the cells to cut: flux (m, 3), error (m,) of each, relative to its light."""
    power = np.abs(flux @ LUMINANCE)
    share = power * error
    least = LEAST * float(power.sum())
    if len(share) > MOST:
        least = max(least, float(np.partition(share, -MOST - 1)[-MOST - 1]) * (1.0 + TIE))
    return np.flatnonzero(share > least)


def cut(
    cells: NDArray[np.integer],
    flux: NDArray[np.float64],
    resolution: int,
    radiance: NDArray[np.float32],
    rotate_degrees: float = 0.0,
) -> Points:
    """The lit parts of cells (k, 5) of a cube of `resolution`, which hold the flux (k, 3) of a map (H, W, 3).

    A part's share is its solid angle times the mean radiance of the lights in it that pixels are cut into, if they are
    not much smaller than parts. So even light stays even, and all flux is kept.
    """
    turn = math.radians(math.fmod(rotate_degrees, 360.0))
    height = radiance.shape[0]
    solid, sines = texel_solid_angles(*radiance.shape[:2]), np.cos(math.pi * np.arange(height + 1) / height)
    directions, light = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for (face, r0, r1, c0, c1), whole in zip(np.asarray(cells).tolist(), flux, strict=True):
        rows, columns = (2.0 * x / resolution - 1.0 for x in (_borders(r0, r1), _borders(c0, c1)))
        grid = np.zeros((len(rows) - 1, len(columns) - 1, 4))
        axes = np.stack([cube.FACE_AXIS[face], cube.FACE_RIGHT[face], cube.FACE_DOWN[face]])
        narrow = min(rows[1] - rows[0], columns[1] - columns[0]) / FINE
        finer = min(max(math.ceil(math.pi / height / narrow), 1), FINEST)
        about = _pixels_about(face, columns, rows, radiance.shape, turn)
        _sum_pixels(radiance, solid, sines, turn, axes, rows, columns, finer, *about, grid)
        s0, s1, t0, t1 = columns[None, :-1], columns[None, 1:], rows[:-1, None], rows[1:, None]
        area = cube.rectangle_solid_angles(s0, s1, t0, t1, (s1 - s0) * (t1 - t0))
        part = (grid[..., :3] / grid[..., 3:] * area[..., None]).reshape(-1, 3)
        total = part.sum(axis=0)
        share = np.where(total > 0.0, part / np.where(total > 0.0, total, 1.0), 1.0 / len(part))
        s, t = (0.5 * (x[1:] + x[:-1]) for x in (columns, rows))
        middle = cube.face_directions(face, s[None, :], t[:, None]).reshape(-1, 3)
        found = share * whole
        lit = found.any(axis=1)
        directions.append(middle[lit])
        light.append(found[lit])
    return Points(np.concatenate(directions), np.concatenate(light))


def _borders(first: int, last: int) -> NDArray[np.float64]:
    return np.linspace(first, last, min(PARTS, last - first) + 1)


def _pixels_about(
    face: int, s: NDArray[np.float64], t: NDArray[np.float64], shape: tuple[int, ...], turn: float
) -> tuple[int, int, int, int]:
    """First and last row, first column and number of columns, modulo the map's, of the pixels that meet a rectangle."""
    height, width = shape[:2]
    # Latitudes have their extremes at corners and nearest to the face's axes.
    near = [np.array([x[0], x[-1], min(max(0.0, x[0]), x[-1])]) for x in (s, t)]
    d = cube.face_directions(face, near[0][None, :], near[1][:, None])
    polar = np.arccos(np.clip(d[..., 1], -1.0, 1.0)) * (height / math.pi)
    rows = max(math.floor(polar.min() - 1e-6), 0), min(math.ceil(polar.max() + 1e-6), height)
    if face in (2, 3) and not near[0][2] and not near[1][2]:  # holds the pole
        return *rows, 0, width
    corners = d[:2, :2].reshape(4, 3)
    longitude = np.arctan2(corners[:, 0], corners[:, 2])
    apart = np.mod(longitude - longitude[0] + math.pi, 2.0 * math.pi) - math.pi
    place = 0.5 * width * (1.0 - (longitude[0] + apart - turn) / math.pi)
    first = math.floor(place.min() - 1e-6)
    return *rows, first, min(math.ceil(place.max() + 1e-6) - first, width)


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_pixels(radiance, solid, sines, turn, axes, rows, columns, finer, top, bottom, left, count, out):  # type: ignore[no-untyped-def]
    """Flux of pixels, each as finer x finer lights and not below 0, and their solid angles, into parts (i, j, 4)."""
    height, width = radiance.shape[0], radiance.shape[1]
    across, down = (len(columns) - 1) / (columns[-1] - columns[0]), (len(rows) - 1) / (rows[-1] - rows[0])
    for column in range(left, left + count):
        own = column % width
        for b in range(finer):
            longitude = math.pi * (1.0 - 2.0 * (column + (b + 0.5) / finer) / width) + turn
            sin_l, cos_l = math.sin(longitude), math.cos(longitude)
            for row in range(top, bottom):
                weight = solid[row] / (finer * finer)
                for a in range(finer):
                    y = sines[row] + (sines[row + 1] - sines[row]) * (a + 0.5) / finer
                    level = math.sqrt(max(1.0 - y * y, 0.0))
                    x, z = sin_l * level, cos_l * level
                    w = x * axes[0, 0] + y * axes[0, 1] + z * axes[0, 2]
                    if w <= 0.0:
                        continue
                    s = (x * axes[1, 0] + y * axes[1, 1] + z * axes[1, 2]) / w
                    t = (x * axes[2, 0] + y * axes[2, 1] + z * axes[2, 2]) / w
                    i, j = math.floor((t - rows[0]) * down), math.floor((s - columns[0]) * across)
                    if 0 <= i < len(rows) - 1 and 0 <= j < len(columns) - 1:
                        for c in range(3):
                            out[i, j, c] += weight * max(radiance[row, own, c], np.float32(0.0))
                        out[i, j, 3] += weight
    for i in range(len(rows) - 1):
        for j in range(len(columns) - 1):
            if out[i, j, 3] == 0.0:  # in the middle of a large pixel
                s, t = 0.5 * (columns[j] + columns[j + 1]), 0.5 * (rows[i] + rows[i + 1])
                d = (
                    axes[0, 0] + s * axes[1, 0] + t * axes[2, 0],
                    axes[0, 1] + s * axes[1, 1] + t * axes[2, 1],
                    axes[0, 2] + s * axes[1, 2] + t * axes[2, 2],
                )
                row, own = texel_of(height, width, turn, d)
                for c in range(3):
                    out[i, j, c] = max(radiance[row, own, c], np.float32(0.0))
                out[i, j, 3] = 1.0
