"""Quadtrees over the faces of a cube of environment lights, whose leaves are clusters of lights.

A cell is a rectangle of texels, (face, row0, row1, column0, column1), half open. The root of each face holds it all; a
cell splits at (row0 + row1) // 2 and (column0 + column1) // 2 into up to four children, so that any resolution works
[Johan and Nishita, sec. 4; Figs 2, 3]. Rows of children: upper left, upper right, lower left, lower right; halves
without texels are left out.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.sphere import cube

Cell = tuple[int, int, int, int, int]
GRID = 256  # places along a face from which the descent starts, at most


class Tree(NamedTuple):
    """Nodes of all six trees as kernels read them; made by `build_tree`.

    resolution R; cell (m, 5) int32: the leaves; of the nodes, middle (n, 2) int32: row and column at which one splits,
    child (n, 4) int32: node of each quarter, -1 where there is none, and leaf (n,) int32: index of the leaf, -1 for
    others; start (6, G, G) int32: the deepest node that holds all of a place; meridian (B,) float64: longitudes at
    which leaves of the side faces end.
    """

    resolution: int
    cell: NDArray[np.int32]
    middle: NDArray[np.int32]
    child: NDArray[np.int32]
    leaf: NDArray[np.int32]
    start: NDArray[np.int32]
    meridian: NDArray[np.float64]


def roots(resolution: int) -> list[Cell]:
    """The six faces."""
    return [(face, 0, resolution, 0, resolution) for face in range(6)]


def lights(cell: Cell) -> int:
    """Texels of a cell."""
    return (cell[2] - cell[1]) * (cell[4] - cell[3])


def children(cell: Cell) -> list[Cell]:
    """Its up to four parts; none if it is a single texel."""
    face, r0, r1, c0, c1 = cell
    if lights(cell) <= 1:
        return []
    r, c = (r0 + r1) // 2, (c0 + c1) // 2
    parts = [(face, r0, r, c0, c), (face, r0, r, c, c1), (face, r, r1, c0, c), (face, r, r1, c, c1)]
    return [part for part in parts if lights(part)]


def overlay(one: Iterable[Cell], other: Iterable[Cell], resolution: int) -> list[Cell]:
    """The leaves of the largest tree of which both trees' leaves are nodes or runs of leaves, in the trees' order."""
    trees, out = (set(one), set(other)), []
    stack = [(cell, False, False) for cell in roots(resolution)[::-1]]
    while stack:
        cell, *reached = stack.pop()
        a, b = (done or cell in tree for done, tree in zip(reached, trees, strict=True))
        if a and b:
            out.append(cell)
        else:
            stack += [(part, a, b) for part in children(cell)[::-1]]
    return out


def samples(cell: Cell, resolution: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Flat texel index (S,) of up to nine lights of a cell, and their directions (S, 3).

    Corners, middles of the edges and the middle; all where there are no more than nine. [sec. 4.1]
    """
    face, r0, r1, c0, c1 = cell
    if lights(cell) <= 9:
        rows, columns = np.arange(r0, r1), np.arange(c0, c1)
    else:
        rows, columns = (np.unique([a, (a + b - 1) // 2, b - 1]) for a, b in ((r0, r1), (c0, c1)))
    row, column = (x.reshape(-1) for x in np.meshgrid(rows, columns, indexing="ij"))
    s, t = (2.0 * column + 1.0) / resolution - 1.0, (2.0 * row + 1.0) / resolution - 1.0
    return (face * resolution + row) * resolution + column, cube.face_directions(face, s, t)


def solid_angles(cells: NDArray[np.integer], resolution: int) -> NDArray[np.float64]:
    """Exact solid angles (C,) of cells (C, 5), sr."""

    _, r0, r1, c0, c1 = np.asarray(cells, np.int64).T
    s0, s1, t0, t1 = ((2.0 * x - resolution) / resolution for x in (c0, c1, r0, r1))
    area = 4.0 * (r1 - r0) * (c1 - c0) / (float(resolution) * resolution)
    return cube.rectangle_solid_angles(s0, s1, t0, t1, area)


def build_tree(leaves: Iterable[Cell], resolution: int) -> Tree:
    """The tree whose leaves are the given cells, in their order. Raises ValueError if they do not tile the faces."""
    index: dict[Cell, int] = {}
    for cell in leaves:
        if cell in index:
            raise ValueError(f"cell {cell} is given twice")
        index[cell] = len(index)
    cells, nodes, leaf = roots(resolution), [], []
    found = 0
    at = 0
    while at < len(cells):
        cell = cells[at]
        at += 1
        _, r0, r1, c0, c1 = cell
        k = index.get(cell, -1)
        leaf.append(k)
        parts = [-1] * 4
        if k >= 0:
            found += 1
        else:
            inner = children(cell)
            if not inner:
                raise ValueError(f"no leaf holds texel {cell}")
            r, c = (r0 + r1) // 2, (c0 + c1) // 2
            for part in inner:
                parts[2 * (part[1] >= r) + (part[3] >= c)] = len(cells)
                cells.append(part)
        nodes.append(((r0 + r1) // 2, (c0 + c1) // 2, *parts))
    if found != len(index):
        raise ValueError(f"{len(index) - found} of {len(index)} cells are no nodes of the tree, or lie in others")
    table = np.array(nodes, np.int32)
    child, middle = np.ascontiguousarray(table[:, 2:]), np.ascontiguousarray(table[:, :2])
    grid = min(resolution, GRID)
    start = np.empty((6, grid, grid), np.int32)
    _fill_start(resolution, middle, child, start)
    tiles = np.array(list(index), np.int32)
    return Tree(resolution, tiles, middle, child, np.array(leaf, np.int32), start, _meridians(tiles, resolution))


def _meridians(cell: NDArray[np.int32], resolution: int) -> NDArray[np.float64]:
    found = []
    for face in (0, 1, 4, 5):
        column = np.unique(cell[cell[:, 0] == face, 3:5])
        d = cube.face_directions(face, 2.0 * column / resolution - 1.0, np.zeros(len(column)))
        found.append(np.arctan2(d[:, 0], d[:, 2]))
    return np.concatenate(found)


@njit(cache=True)
def _fill_start(resolution, middle, child, start):  # type: ignore[no-untyped-def]
    grid = start.shape[1]
    for face in range(6):
        for i in range(grid):
            for j in range(grid):
                # The place in texels, a little larger than it is for roundings.
                top, bottom = i * resolution / grid - 1e-9, (i + 1) * resolution / grid + 1e-9
                left, right = j * resolution / grid - 1e-9, (j + 1) * resolution / grid + 1e-9
                node = face
                while True:
                    r, c = middle[node, 0], middle[node, 1]
                    down, across = -1, -1
                    if bottom < r:
                        down = 0
                    elif top > r:
                        down = 1
                    if right < c:
                        across = 0
                    elif left > c:
                        across = 1
                    if down < 0 or across < 0 or child[node, 2 * down + across] < 0:
                        break
                    node = child[node, 2 * down + across]
                start[face, i, j] = node


@njit(cache=True, nogil=True)
def leaf_of_texel(tree: Tree, face: int, row: int, column: int) -> int:
    """Leaf that holds a texel."""
    grid = tree.start.shape[1]
    node = tree.start[
        face, (2 * row + 1) * grid // (2 * tree.resolution), (2 * column + 1) * grid // (2 * tree.resolution)
    ]
    while tree.leaf[node] < 0:
        quarter = 2 * (row >= tree.middle[node, 0]) + (column >= tree.middle[node, 1])
        node = tree.child[node, quarter]
    return tree.leaf[node]


def leaves_at(tree: Tree, directions: NDArray[np.floating]) -> NDArray[np.int64]:
    """Leaf (N,) that holds each direction (N, 3)."""
    texel = cube.texel_index(directions, tree.resolution)
    side = tree.resolution
    out = np.empty(len(texel), np.int64)
    _leaves_of(tree, texel // (side * side), texel // side % side, texel % side, out)
    return out


def first_leaves(tree: Tree, cells: NDArray[np.integer]) -> NDArray[np.int64]:
    """First leaf (m,) of cells (m, 5) that are nodes of the tree, whose leaves are in its order."""
    face, row, _, column, _ = np.asarray(cells, np.int64).T
    out = np.empty(len(cells), np.int64)
    _leaves_of(tree, face, row, column, out)
    return out


@njit(cache=True)
def _leaves_of(tree, face, row, column, out):  # type: ignore[no-untyped-def]
    for k in range(len(out)):
        out[k] = leaf_of_texel(tree, face[k], row[k], column[k])
