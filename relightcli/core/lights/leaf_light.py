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

from relightcli.core.lights.environment import half_angle, half_angles_table
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
        self,
        radiance: NDArray[np.float32],
        threads: int = 1,
        rows: NDArray[np.int64] | None = None,
        less: NDArray[np.float32] | None = None,
    ) -> LeafLight:
        """Light of the leaves under a map.

        rows (W, 2): the rows of each column, half open, that count; the others are as black. None: all. less: a map of
        the same size that is taken off it, pixel by pixel. The sums do not depend on `threads`.
        """
        source = np.ascontiguousarray(radiance, np.float32)
        off = np.zeros((0, 0, 3), np.float32) if less is None else np.ascontiguousarray(less, np.float32)
        if rows is None:
            rows = np.tile(np.array([0, self.height]), (self.width, 1))
        strips = np.flatnonzero(rows[self._column, 1] > rows[self._column, 0])
        south = np.ascontiguousarray(self.height - rows[:, ::-1])
        bands = np.array_split(strips, BANDS if len(strips) > FEW else 1)
        parts = [np.zeros((len(self.tree.cell), 3, 4)) for _ in bands]

        def walk(first: int, last: int) -> None:
            for band, out in zip(bands[first:last], parts[first:last], strict=True):
                _walk(
                    source, off, band, self._column, self._borders, south, self.tree,
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
def _walk(radiance, off, strips, columns, borders, south, tree, row_edges, row_half_angles, table, out):  # type: ignore[no-untyped-def]
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
            _take_column(radiance, off, column, rows, light)
        count = _meridian(tree, math.sin(middle), math.cos(middle), table, edges, half_angles, leaves)
        _merge_strip(
            light, rows, row_edges, row_half_angles, edges, half_angles, leaves, count, middle, high - low, out
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _take_column(radiance, off, column, rows, light):  # type: ignore[no-untyped-def]
    """Pixels of a column of a map (H, W, 3), from rows[0] to rows[1] counted from the south pole, to light (H, 3); less
    those of another map, if it has any."""
    for row in range(rows[0], rows[1]):
        for c in range(3):
            light[row, c] = radiance[len(light) - 1 - row, column, c]
            if len(off):
                light[row, c] -= off[len(light) - 1 - row, column, c]


@njit(cache=True, nogil=True)
def _merge_strip(  # type: ignore[no-untyped-def]
    light, rows, row_edges, row_half_angles, edges, half_angles, places, count, middle, width, out
):
    """Adds the light of a column's pixels, in a strip of `width` radians about the longitude `middle`, to the places
    that the meridian meets.

    light (H, 3) float64: of `_take_column`, the pixels from rows[0] to rows[1] take part. row_edges (H + 1,):
    s = sin(latitude) of the rows' borders; edges: the same of the `count` places; half_angles: antiderivatives of
    cos(latitude) over s there. out (P, 3, 4): per place and colour the flux and the moment.
    """
    # integral of (sin, cos) of the longitude over the strip
    wx = 2.0 * math.sin(middle) * math.sin(0.5 * width)
    wz = 2.0 * math.cos(middle) * math.sin(0.5 * width)
    row, k = rows[0], 0
    s, below = row_edges[row], row_half_angles[row]
    if edges[0] > s:
        high = rows[1]  # row_edges[row] <= edges[0] < row_edges[high]
        while high - row > 1:
            half = (row + high) >> 1
            if row_edges[half] <= edges[0]:
                row = half
            else:
                high = half
        s, below = edges[0], half_angles[0]
    while k + 1 < count and edges[k + 1] <= s:
        k += 1
    while row < rows[1] and k < count:
        end = edges[k + 1]
        # of a place, per colour: light over s, over s times cos(latitude), over s^2 / 2
        r0 = r1 = r2 = g0 = g1 = g2 = b0 = b1 = b2 = 0.0
        while True:
            whole = row_edges[row + 1] <= end
            top = row_edges[row + 1] if whole else end
            above = row_half_angles[row + 1] if whole else half_angles[k + 1]
            if top > s:
                area, across, level = top - s, above - below, 0.5 * (top * top - s * s)
                red, green, blue = light[row, 0], light[row, 1], light[row, 2]
                r0, r1, r2 = r0 + red * area, r1 + red * across, r2 + red * level
                g0, g1, g2 = g0 + green * area, g1 + green * across, g2 + green * level
                b0, b1, b2 = b0 + blue * area, b1 + blue * across, b2 + blue * level
                s, below = top, above
            if not whole:
                break
            row += 1
            if row == rows[1]:
                break
        to = out[places[k]]
        to[0, 0], to[0, 1], to[0, 2], to[0, 3] = (
            to[0, 0] + width * r0, to[0, 1] + wx * r1, to[0, 2] + width * r2, to[0, 3] + wz * r1
        )  # fmt: skip
        to[1, 0], to[1, 1], to[1, 2], to[1, 3] = (
            to[1, 0] + width * g0, to[1, 1] + wx * g1, to[1, 2] + width * g2, to[1, 3] + wz * g1
        )  # fmt: skip
        to[2, 0], to[2, 1], to[2, 2], to[2, 3] = (
            to[2, 0] + width * b0, to[2, 1] + wx * b1, to[2, 2] + width * b2, to[2, 3] + wz * b1
        )  # fmt: skip
        k += 1


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
