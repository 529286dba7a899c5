"""From a latitude-longitude map to the light of clusters: flux and moment of what arrives through every leaf.

As in `environment`, the sphere is cut into meridian strips, whose borders are the map's columns and those of the leaves
on the side faces; in a strip the pixels and the leaves that its middle meets from pole to pole are two partitions of
s = sin(latitude), so that each pixel's light is shared out completely, whatever the resolution of either. Only the
pixels asked for are visited, and what they bring does not depend on the others: an edit changes the leaves that it
touches, to the bit no others.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.lights.environment import half_angle, half_angles_table, merge_strip, take_column
from relightcli.core.lights.quadtree import Tree, leaf_of_texel
from relightcli.core.parts import in_parts

WIDEST = math.radians(0.36)  # of a strip
BANDS = 8  # of strips, summed apart
FEW = 256  # strips that are not worth cutting into bands


class LeafLight(NamedTuple):
    """flux (m, 3) float64: integral of the radiance over every leaf; moment (m, 3, 3): per colour, of L w."""

    flux: NDArray[np.float64]
    moment: NDArray[np.float64]


class Splitter:
    """Shares maps (H, W, 3) of one size, turned by `rotate_degrees` about +Y, right-handed, over a tree."""

    def __init__(self, tree: Tree, height: int, width: int, rotate_degrees: float = 0.0) -> None:
        self.tree, self.height, self.width = tree, height, width
        turn = math.radians(math.fmod(rotate_degrees, 360.0))
        self._column, self._borders = _strips(width, turn, tree)
        edges = np.cos(math.pi * np.arange(height + 1) / height)[::-1].copy()  # rising s, from the south pole
        self._row_edges = edges
        self._row_half_angles = 0.5 * (np.arcsin(edges) + edges * np.sqrt(np.maximum(0.0, 1.0 - edges**2)))

    def light(
        self, radiance: NDArray[np.float32], threads: int = 1, rows: NDArray[np.int64] | None = None
    ) -> LeafLight:
        """Light of the leaves under a map.

        rows (W, 2): the rows of each column, half open, that count; the others are as black. None: all. The sums do not
        depend on `threads`.
        """
        source = np.ascontiguousarray(radiance, np.float32)
        if rows is None:
            rows = np.tile(np.array([0, self.height]), (self.width, 1))
        strips = np.flatnonzero(rows[self._column, 1] > rows[self._column, 0])
        south = np.ascontiguousarray(self.height - rows[:, ::-1])
        bands = np.array_split(strips, BANDS if len(strips) > FEW else 1)
        parts = [np.zeros((len(self.tree.cell), 3, 4)) for _ in bands]

        def walk(first: int, last: int) -> None:
            for band, out in zip(bands[first:last], parts[first:last], strict=True):
                _walk(
                    source, band, self._column, self._borders, south, self.tree,
                    self._row_edges, self._row_half_angles, half_angles_table(), out,
                )  # fmt: skip

        in_parts(walk, len(bands), threads)
        total = parts[0]
        for part in parts[1:]:
            total += part
        return LeafLight(total[:, :, 0].copy(), total[:, :, 1:].copy())


def leaf_light(
    radiance: NDArray[np.float32],
    tree: Tree,
    rotate_degrees: float = 0.0,
    threads: int = 1,
    rows: NDArray[np.int64] | None = None,
) -> LeafLight:
    """Light of the leaves under one map; see `Splitter`."""
    return Splitter(tree, radiance.shape[0], radiance.shape[1], rotate_degrees).light(radiance, threads, rows)


def _strips(width: int, turn: float, tree: Tree) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Column of the map that each strip lies in, (S,), and the strips' borders, (S + 1,), rising longitudes."""
    even = max(width, math.ceil(2.0 * math.pi / WIDEST))
    columns = -math.pi + (2.0 * math.pi / width) * np.arange(width) + turn
    columns = np.mod(columns + math.pi, 2.0 * math.pi) - math.pi
    spaced = -math.pi + (2.0 * math.pi / even) * np.arange(even + 1)
    borders = np.unique(np.concatenate([columns, tree.meridian, [-math.pi, math.pi], spaced if even > width else []]))
    borders = borders[np.concatenate([[True], np.diff(borders) > 1e-14])]
    middle = 0.5 * (borders[1:] + borders[:-1])
    k = np.floor(np.mod(middle - turn + math.pi, 2.0 * math.pi) * (width / (2.0 * math.pi))).astype(np.int64)
    return width - 1 - np.clip(k, 0, width - 1), borders


@njit(cache=True, nogil=True)
def _walk(radiance, strips, columns, borders, south, tree, row_edges, row_half_angles, table, out):  # type: ignore[no-untyped-def]
    room = 6 * tree.resolution + 8
    edges, half_angles, leaves = np.empty(room), np.empty(room), np.empty(room, np.int64)
    light = np.empty((len(row_edges) - 1, 3))
    held = -1
    for strip in strips:
        low, high = borders[strip], borders[strip + 1]
        middle = 0.5 * (low + high)
        column = columns[strip]
        rows = (south[column, 0], south[column, 1])
        if column != held:
            held = column
            take_column(radiance, column, rows, light)
        count = _meridian(tree, math.sin(middle), math.cos(middle), table, edges, half_angles, leaves)
        merge_strip(
            light, rows, row_edges, row_half_angles, edges, half_angles, leaves, count, middle, high - low, out
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _meridian(tree, sin_l, cos_l, table, edges, half_angles, leaves):  # type: ignore[no-untyped-def]
    """Leaves met along a meridian from the south to the north pole, with the s = sin(latitude) of their borders.

    Returns their number n; leaf k spans edges[k]..edges[k + 1]. half_angles: the antiderivative of cos(latitude).
    """
    r = tree.resolution
    # -Y face: from the pole outwards; s = x = rho sin, t = -z = -rho cos, with rho = -1 / tan(latitude).
    count = _cap(tree, sin_l, -cos_l, 3, table, 0, edges, half_angles, leaves)
    for k in range(count + 1):
        edges[k], half_angles[k] = -edges[k], -half_angles[k]
    # Side face: tan(latitude) = m v with v = -t from -1 to 1.
    if abs(sin_l) > abs(cos_l):
        face = 0 if sin_l > 0 else 1
        m = abs(sin_l)
        right = -cos_l if sin_l > 0 else cos_l
    else:
        face = 4 if cos_l > 0 else 5
        m = abs(cos_l)
        right = sin_l if cos_l > 0 else -sin_l
    column = min(max(math.floor((right / m + 1.0) * 0.5 * r), 0), r - 1)
    row = r
    while row > 0:
        leaf = leaf_of_texel(tree, face, row - 1, column)
        row = tree.cell[leaf, 1]
        v = m * (1.0 - 2.0 * row / r)
        leaves[count] = leaf
        count += 1
        edges[count] = v / math.sqrt(1.0 + v * v)
        half_angles[count] = half_angle(table, v)
    # +Y face: from the rim inwards; s = x, t = z. Written from the pole outwards, then turned round.
    start = count
    count += _cap(tree, sin_l, cos_l, 2, table, start, edges, half_angles, leaves)
    i, j = start, count - 1
    while i < j:
        leaves[i], leaves[j] = leaves[j], leaves[i]
        i += 1
        j -= 1
    i, j = start, count
    while i < j:
        edges[i], edges[j] = edges[j], edges[i]
        half_angles[i], half_angles[j] = half_angles[j], half_angles[i]
        i += 1
        j -= 1
    return count


@njit(cache=True, nogil=True)
def _cap(tree, ds, dt, face, table, first, edges, half_angles, leaves):  # type: ignore[no-untyped-def]
    """Leaves of a pole face along the ray rho (ds, dt) from the pole to the rim, from place `first` on, and their
    borders as on the northern face. Returns their number."""
    r = tree.resolution
    half = 0.5 * r
    rim = 1.0 / max(abs(ds), abs(dt))
    # In texels the ray is half + rho half d; an even face has a border at its middle.
    column = r // 2 if r % 2 or ds >= 0 else r // 2 - 1
    row = r // 2 if r % 2 or dt >= 0 else r // 2 - 1
    edges[first], half_angles[first] = 1.0, 0.25 * math.pi
    count = first
    while True:
        leaf = leaf_of_texel(tree, face, row, column)
        r0, r1, c0, c1 = tree.cell[leaf, 1], tree.cell[leaf, 2], tree.cell[leaf, 3], tree.cell[leaf, 4]
        rho_c = ((c1 if ds > 0 else c0) - half) / (half * ds) if ds != 0.0 else math.inf
        rho_r = ((r1 if dt > 0 else r0) - half) / (half * dt) if dt != 0.0 else math.inf
        rho = min(rho_c, rho_r)
        leaves[count] = leaf
        count += 1
        last = rho >= rim * (1.0 - 1e-12)
        if last:
            rho = rim
        square = 1.0 / (1.0 + rho * rho)
        edges[count] = math.sqrt(square)
        half_angles[count] = 0.25 * math.pi - half_angle(table, rho) + rho * square
        if last:
            return count - first
        new_column, new_row = math.floor(half + rho * half * ds), math.floor(half + rho * half * dt)
        column = (c1 if ds > 0 else c0 - 1) if rho_c <= rho else min(max(new_column, c0), c1 - 1)
        row = (r1 if dt > 0 else r0 - 1) if rho_r <= rho else min(max(new_row, r0), r1 - 1)
        column, row = min(max(column, 0), r - 1), min(max(row, 0), r - 1)
