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

from relightcli.core.lights.latlong import LUMINANCE, texel_of
from relightcli.core.lights.points import Points
from relightcli.core.sphere import cube

LEAST = 0.002  # share of the flux times the error of a cell that is worth being cut
MOST = 8  # cells
PARTS = 4  # along a cell's side
FINEST = 16  # samples of the map along the side of a part, at most


def bright_cells(flux: NDArray[np.float64], error: NDArray[np.floating]) -> NDArray[np.int64]:
    """Rising indices (k,) of the cells to cut: flux (m, 3), error (m,) of each, relative to its light."""
    power = np.abs(flux @ LUMINANCE)
    share = power * error
    found = np.flatnonzero(share > LEAST * power.sum())
    return np.sort(found[np.argsort(-share[found], kind="stable")[:MOST]])


def cut(
    cells: NDArray[np.integer],
    flux: NDArray[np.float64],
    resolution: int,
    radiance: NDArray[np.float32],
    rotate_degrees: float = 0.0,
) -> Points:
    """The lit parts of cells (k, 5) of a cube of `resolution`, which hold the flux (k, 3) of a map (H, W, 3).

    The parts share a cell's flux as samples of the map do that are no farther apart than its pixels, if that takes no
    more than 16 x 16 in a part. All flux is kept.
    """
    turn, pixel = math.radians(math.fmod(rotate_degrees, 360.0)), math.pi / radiance.shape[0]
    directions, light = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for (face, r0, r1, c0, c1), whole in zip(np.asarray(cells).tolist(), flux, strict=True):
        rows, columns = (2.0 * x / resolution - 1.0 for x in (_borders(r0, r1), _borders(c0, c1)))
        wide = max(rows[1] - rows[0], columns[1] - columns[0])
        count = min(max(math.ceil(wide / pixel), 1), FINEST)
        grid = np.zeros((len(rows) - 1, len(columns) - 1, 3))
        axes = np.stack([cube.FACE_AXIS[face], cube.FACE_RIGHT[face], cube.FACE_DOWN[face]])
        _sum_samples(radiance, turn, axes, rows, columns, count, grid)
        part = grid.reshape(-1, 3)
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


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_samples(radiance, turn, axes, rows, columns, count, out):  # type: ignore[no-untyped-def]
    """Radiance of the map, not below 0, times the solid angle of samples, up to a factor: into parts (i, j, 3)."""
    height, width = radiance.shape[0], radiance.shape[1]
    for i in range(len(rows) - 1):
        for j in range(len(columns) - 1):
            area = (rows[i + 1] - rows[i]) * (columns[j + 1] - columns[j])
            for a in range(count):
                t = rows[i] + (rows[i + 1] - rows[i]) * (a + 0.5) / count
                for b in range(count):
                    s = columns[j] + (columns[j + 1] - columns[j]) * (b + 0.5) / count
                    x = axes[0, 0] + s * axes[1, 0] + t * axes[2, 0]
                    y = axes[0, 1] + s * axes[1, 1] + t * axes[2, 1]
                    z = axes[0, 2] + s * axes[1, 2] + t * axes[2, 2]
                    row, column = texel_of(height, width, turn, (x, y, z))
                    weight = area * (1.0 + s * s + t * t) ** -1.5
                    for c in range(3):
                        out[i, j, c] += weight * max(radiance[row, column, c], np.float32(0.0))
