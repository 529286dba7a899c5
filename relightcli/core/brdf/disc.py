"""The upper hemisphere as a grid of cells on the unit disc, by orthographic projection. [Sun 2007, sec. 4.3]

A direction w with w.n > 0 is the point p = (w_x, w_y) of the disc (n is the third axis), and dA = cos(theta) dw: a sum
over cells of equal area carries the cosine already. The cells are those of an N x N grid over [-1, 1]^2 whose centre
is inside the disc. What the others hold of the disc is shared out evenly, so that every cell has the area pi/n and all
of them together have exactly pi; the grid's own areas sum to within 4 % of that (N >= 8), 1 % (N = 32).

N is even, so no cell lies on an axis, and the 8 symmetries of the square map cells to cells. A mirror direction -p is
a symmetry: the mirror direction of a cell is a cell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relightcli.errors import InputError

RESOLUTION = 32

# Points of a cell, per axis, over which a view direction is averaged.
_SUB = 4


@dataclass(frozen=True, eq=False)
class DiscGrid:
    """n cells of an N x N grid.

    position (n, 2) float64, centres p; direction (n, 3) float64 unit; lookup (N, N) int64, [column of x, row of y] to
    the cell, or to the nearest one where the centre is outside the disc; images (8, n) int64, cell to cell under the
    turns by 0, 90, 180 and 270 degrees and under each of them followed by a reflection; octant (m,) int64, the cells
    with x >= y > 0, one for each orbit of the symmetries.
    """

    resolution: int
    position: NDArray[np.float64]
    direction: NDArray[np.float64]
    lookup: NDArray[np.int64]
    images: NDArray[np.int64]
    octant: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.position)

    @property
    def area(self) -> float:
        """dA = cos(theta) dw of every cell, sr."""
        return math.pi / len(self)

    @property
    def mirror(self) -> NDArray[np.int64]:
        """(n,) int64: the cell of -p."""
        return self.images[2]


@lru_cache(maxsize=8)
def disc_grid(resolution: int = RESOLUTION) -> DiscGrid:
    """The grid of N = `resolution` cells across. Raises InputError unless N is even and at least 2."""
    if resolution < 2 or resolution % 2:
        raise InputError(f"disc resolution is {resolution}; expected an even number of at least 2.")
    n = resolution
    # Odd integers over N: distances from the axis, free of rounding.
    axis = np.arange(1 - n, n, 2)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    kept = x * x + y * y < n * n
    cell = np.stack([x[kept], y[kept]], -1)
    lookup = np.full((n, n), -1, np.int64)
    lookup[kept] = np.arange(len(cell))
    outside = np.stack([x[~kept], y[~kept]], -1)
    lookup[~kept] = ((outside[:, None, :] - cell) ** 2).sum(-1).argmin(1)
    position = cell / n
    direction = np.concatenate([position, np.sqrt(1.0 - (position**2).sum(1))[:, None]], 1)
    turns = [cell]
    for _ in range(3):
        turns.append(np.stack([-turns[-1][:, 1], turns[-1][:, 0]], -1))
    both = turns + [turned[:, ::-1] for turned in turns]
    images = np.stack([lookup[tuple(((image + n - 1) // 2).T)] for image in both])
    octant = np.flatnonzero((cell[:, 0] >= cell[:, 1]) & (cell[:, 1] > 0))
    return DiscGrid(resolution, position, direction, lookup, images, octant)


def sub_directions(grid: DiscGrid, cells: NDArray[np.int64]) -> NDArray[np.float64]:
    """4 x 4 directions in each of `cells` (k,): (k, 16, 3) float64. Those beyond the disc's rim are all zero."""
    offset = (2 * np.arange(_SUB) + 1 - _SUB) / (_SUB * grid.resolution)
    dx, dy = np.meshgrid(offset, offset, indexing="ij")
    p = grid.position[cells][:, None, :] + np.stack([dx.ravel(), dy.ravel()], -1)
    z2 = 1.0 - (p**2).sum(-1)
    out = np.concatenate([p, np.sqrt(np.maximum(z2, 0.0))[..., None]], -1)
    out[z2 <= 0.0] = 0.0
    return out


def cell_of(grid: DiscGrid, directions: NDArray[np.float64]) -> NDArray[np.int64]:
    """The cell (...) that a direction (..., 3) of the upper hemisphere falls into."""
    n = grid.resolution
    k = np.clip(np.floor((directions[..., :2] + 1.0) * (0.5 * n)).astype(np.int64), 0, n - 1)
    return grid.lookup[k[..., 0], k[..., 1]]


def bilinear(grid: DiscGrid, directions: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Cells (..., 4) and weights (..., 4), summing to 1, of bilinear interpolation at directions (..., 3).

    Corners without a cell drop out and the others share their weight; where none of the four is a cell, the point is
    first drawn in to the radius 1 - 1/N. Both keep the symmetries of the square. Centres of cells return themselves.
    """
    p = directions[..., :2]
    index, weight = _corners(grid, p)
    lost = weight.sum(-1) == 0.0
    if lost.any():
        radius = np.sqrt((p[lost] ** 2).sum(-1, keepdims=True))
        index[lost], weight[lost] = _corners(grid, p[lost] * ((1.0 - 1.0 / grid.resolution) / radius))
    return index, weight / weight.sum(-1, keepdims=True)


def _corners(grid: DiscGrid, p: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    n = grid.resolution
    at = (p + 1.0) * (0.5 * n) - 0.5
    low = np.floor(at).astype(np.int64)
    part = at - low
    index = np.empty((*p.shape[:-1], 4), np.int64)
    weight = np.empty(index.shape)
    for k, (i, j) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        x, y = low[..., 0] + i, low[..., 1] + j
        cx, cy = 2 * x + 1 - n, 2 * y + 1 - n
        w = np.where(i, part[..., 0], 1.0 - part[..., 0]) * np.where(j, part[..., 1], 1.0 - part[..., 1])
        weight[..., k] = np.where(cx * cx + cy * cy < n * n, w, 0.0)
        index[..., k] = grid.lookup[np.clip(x, 0, n - 1), np.clip(y, 0, n - 1)]
    return index, weight


def spread(grid: DiscGrid, rows: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Rows for the octant's view cells, (..., m, n), to all view cells by symmetry: (..., n, n) float64.

    out[g o, g i] = rows[o, i] for the 8 symmetries g, averaged where several g lead to the same o.
    """
    out = np.zeros((*rows.shape[:-2], len(grid), len(grid)))
    count = np.zeros(len(grid))
    for image in grid.images:
        view = image[grid.octant]
        out[..., view[:, None], image[None, :]] += rows
        count[view] += 1
    out /= count[:, None]
    return out


def fold(grid: DiscGrid, values: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """The mean over the 8 symmetries as rows of the octant, (..., m, n), of values (..., n, n). Undone by `spread`."""
    out = np.zeros((*values.shape[:-2], len(grid.octant), len(grid)))
    for image in grid.images:
        out += values[..., image[grid.octant][:, None], image[None, :]]
    return out / len(grid.images)
