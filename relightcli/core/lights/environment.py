"""From a latitude-longitude map to the sky cube: exact in power, with the mean direction of every texel's light.

The sphere is cut into meridian strips whose borders are all pixel columns and all meridians through texel corners. In
a strip the pixels and the texels met from pole to equator are two partitions of s = sin(latitude); merging them gives
the solid angle dlambda ds of every overlap. Each pixel's solid angle is thus shared out completely: total power is kept
to rounding, for a one-pixel sun too. A texel's border is taken at its latitude in the middle of the strip: a constant
map stays constant to 4e-3 at 16, 5e-4 at 64 and 1.3e-4 at 256 texels a side in the worst texel, near the poles, and six
to eight times better in the mean square. Between the rims of the side faces, where borders hardly bend, neighbouring
strips go as one that is up to a quarter of a texel wide.

The cube looks the same after quarter turns about the axis and mirrored at the equator. So strips are those of the
sector about +Z, cut at the columns of all its four turns, and each overlap is worked out once for eight pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.parts import in_parts
from relightcli.core.sphere import cube

TABLE = 1 << 13
LANES = 24  # quarters of the sphere, hemispheres and colours, fastest last
STRIPS = 8  # meridian strips for each texel along a face's side, at least


@dataclass(frozen=True)
class SkyCube:
    """Light on the texels of a 6 x R x R cube, flat texel index first.

    flux   (6 R R, 3) float64: integral of L dw over the texel, per colour (radiance times sr)
    moment (6 R R, 3, 3) float64: integral of L w dw, per colour, then x, y, z
    """

    resolution: int
    flux: NDArray[np.float64]
    moment: NDArray[np.float64]

    def radiance(self) -> NDArray[np.float64]:
        """Mean radiance of every texel, (6, R, R, 3)."""
        r = self.resolution
        return self.flux.reshape(6, r, r, 3) / cube.solid_angles(r)[..., None]


def latlong_to_cube(radiance: NDArray[np.float32], resolution: int, rotate_degrees: float = 0.0) -> SkyCube:
    """Integrates a lat-long map (H, W, 3), constant over each pixel, over the texels of a cube of R x R faces.

    Image row 0 is the north pole (+Y); column x in [0, 1] has longitude pi (1 - 2 x), direction (sin lon cos lat,
    sin lat, cos lon cos lat). The map is first turned by `rotate_degrees` about +Y, right-handed.
    """
    height, width = radiance.shape[:2]
    turn = math.radians(math.fmod(rotate_degrees, 360.0))
    columns, borders = _strips(resolution, width, turn)
    rows = (height + 1) // 2
    row_edges = np.maximum(np.cos(math.pi * np.arange(rows + 1) / height), 0.0)  # falling s, from a pole to the equator
    row_edges[-1] = 0.0
    row_half_angles = 0.5 * (np.arcsin(row_edges) + row_edges * np.sqrt(np.maximum(0.0, 1.0 - row_edges**2)))
    source = np.ascontiguousarray(radiance, np.float32)
    table = half_angles_table()
    sums = np.zeros((resolution * (resolution - resolution // 2 + (resolution + 1) // 2), 4, LANES))
    # Halves meet in no texel but those of a middle column.
    cuts = (0, int(np.searchsorted(borders, -1e-13)), len(columns))

    def walk(first: int, last: int) -> None:
        for k in range(first, last):
            a, b = cuts[k], cuts[k + 1]
            _walk(source, columns[a:b], borders[a : b + 1], row_edges, row_half_angles, table, resolution, sums)

    threads = 1 if resolution % 2 else 2
    in_parts(walk, 2, threads)
    sky = _dark(resolution)
    in_parts(lambda a, b: _unfold(sums, resolution, (a, b), sky.flux, sky.moment), 2, threads)
    return sky


def _dark(resolution: int) -> SkyCube:
    texels = 6 * resolution * resolution
    return SkyCube(resolution, np.zeros((texels, 3)), np.zeros((texels, 3, 3)))


def _strips(resolution: int, width: int, turn: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Strips of the sector of longitudes from -pi/4 to pi/4: the columns of a turned map that each, and its turns by
    quarters, lie in, (S, 4), and the borders, (S + 1,)."""
    columns = np.mod((2.0 * math.pi / width) * np.arange(width) + turn + 0.25 * math.pi, 0.5 * math.pi) - 0.25 * math.pi
    ends = [-0.25 * math.pi, 0.0, 0.25 * math.pi]
    borders = np.unique(np.concatenate([columns, *_meridians(resolution, width), ends]))
    borders = borders[np.concatenate([[True], np.diff(borders) > 1e-14])]
    middle = 0.5 * (borders[1:] + borders[:-1])[:, None] + 0.5 * math.pi * np.arange(4)
    k = np.floor(np.mod(middle - turn + math.pi, 2.0 * math.pi) * (width / (2.0 * math.pi))).astype(np.int64)
    return width - 1 - np.clip(k, 0, width - 1), borders


@lru_cache(maxsize=4)
def _meridians(resolution: int, width: int) -> tuple[NDArray[np.float64], ...]:
    """Longitudes in the sector of the corners of all texels of a pole face, which include the borders of the side
    faces' texels, and evenly spaced ones where the `width` columns of the map are wider."""
    half = np.arange(-resolution, resolution + 1, 2)
    i, j = np.meshgrid(half, half, indexing="ij")
    keep = (j > 0) & (np.abs(i) <= j)
    i, j = i[keep], j[keep]
    once = np.gcd(i, j) <= 2  # every direction's nearest corner: odd ones have g = 1, even ones 2
    corners = np.arctan2(i[once].astype(np.float64), j[once].astype(np.float64))
    steps = STRIPS * resolution
    if width >= steps:
        return (corners,)
    quarter = -(-steps // 4)
    return corners, -0.25 * math.pi + (0.5 * math.pi / quarter) * np.arange(quarter, dtype=np.float64)


@lru_cache(maxsize=1)
def half_angles_table() -> NDArray[np.float64]:
    """(atan x + x / (1 + x^2)) / 2 for x from 0 to 1.5, in steps so small that between them it is straight to 1e-8: the
    antiderivative of cos(latitude) = sqrt(1 - s^2) over s, at the latitude whose tangent is x."""
    x = np.linspace(0.0, 1.5, TABLE + 1)
    return 0.5 * (np.arctan(x) + x / (1.0 + x * x))


@njit(cache=True, nogil=True)
def half_angle(table, x):  # type: ignore[no-untyped-def]
    place = abs(x) * (TABLE / 1.5)
    k = int(place)
    value = table[k] + (place - k) * (table[k + 1] - table[k])
    return value if x >= 0.0 else -value


@njit(cache=True, nogil=True)
def _walk(radiance, columns, borders, row_edges, row_half_angles, table, resolution, out):  # type: ignore[no-untyped-def]
    """Strips of the sector about +Z from the pole to the equator, for all eighths of the sphere: the texels of the pole
    face and the first of the side face strip by strip; below it a run of strips in one column of the map and of texels
    goes as one."""
    r = resolution
    below, half = r // 2 * r, (r + 1) // 2  # first place of the side face; its rows above the equator
    first_side = r * r - below
    room = 2 * r + 8
    edges, half_angles, places = np.empty(room), np.empty(room), np.empty(room, np.int64)
    side_edges, side_half_angles, side = np.empty(half + 1), np.empty(half + 1), np.empty(half, np.int64)
    rows = len(row_edges) - 1
    light = np.empty((rows, LANES), np.float32)
    sums = np.zeros((3, LANES))
    held = np.full(4, -1)
    widest, stop = 1.001 * math.pi / (8 * r), 0  # a quarter of a texel in the middle of a face
    for strip in range(len(columns)):
        low, high = borders[strip], borders[strip + 1]
        for quarter in range(4):
            if columns[strip, quarter] != held[quarter]:
                held[quarter] = columns[strip, quarter]
                _take_column(radiance, held[quarter], quarter, light)
        middle = 0.5 * (low + high)
        if strip == stop:
            column = _side_column(middle, r)
            stop += 1
            while stop < len(columns) and borders[stop + 1] - low <= widest:
                if (columns[stop] != held).any():
                    break
                if _side_column(0.5 * (borders[stop] + borders[stop + 1]), r) != column:
                    break
                stop += 1
            whole, width = 0.5 * (low + borders[stop]), borders[stop] - low
            m = math.cos(whole)
            for i in range(half + 1):  # tan(latitude) = m v with v = -t from 1 to 0
                v = m * max(1.0 - 2.0 * i / r, 0.0)
                side_edges[i], side_half_angles[i] = v / math.sqrt(1.0 + v * v), half_angle(table, v)
            for i in range(half):
                side[i] = first_side + i * r + column
            if half > 1:
                _merge(
                    light, row_edges, row_half_angles, side_edges[1:], side_half_angles[1:], side[1:], half - 1,
                    whole, width, sums, out,
                )  # fmt: skip
        count = _cap(math.sin(middle), math.cos(middle), r, table, edges, half_angles, places)
        places[count] = side[0]
        count += 1
        edges[count], half_angles[count] = side_edges[1], side_half_angles[1]
        _merge(
            light, row_edges, row_half_angles, edges, half_angles, places, count, middle, high - low, sums, out
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _side_column(longitude, resolution):  # type: ignore[no-untyped-def]
    return min(max(math.floor((math.tan(longitude) + 1.0) * 0.5 * resolution), 0), resolution - 1)


@njit(cache=True, nogil=True)
def _take_column(radiance, column, quarter, light):  # type: ignore[no-untyped-def]
    """Pixels of a column of a map (H, W, 3) to the lanes of its quarter in light (rows, LANES), from either pole on."""
    height = len(radiance)
    at = 6 * quarter
    for row in range(len(light)):
        for c in range(3):
            light[row, at + c] = radiance[row, column, c]
            light[row, at + 3 + c] = radiance[height - 1 - row, column, c]


@njit(cache=True, nogil=True, fastmath={"contract"})
def _merge(light, row_edges, row_half_angles, edges, half_angles, places, count, middle, width, sums, out):  # type: ignore[no-untyped-def]
    """Adds the light of pixels, in a strip of `width` radians about the longitude `middle`, to the places that its
    meridian meets, in all lanes.

    light (rows, LANES): of `_take_column`; row_edges (rows + 1,): s = sin(latitude) of their borders, falling; edges:
    the same of the `count` places; half_angles: antiderivatives of cos(latitude) over s there. sums (3, LANES): room,
    zero. out (P, 4, LANES): flux, and moment along x, y, z.
    """
    # integral of (sin, cos) of the longitude over the strip
    wx = 2.0 * math.sin(middle) * math.sin(0.5 * width)
    wz = 2.0 * math.cos(middle) * math.sin(0.5 * width)
    row, last = 0, len(light)
    s, above = edges[0], half_angles[0]
    high = last  # row_edges[row] >= s > row_edges[high]
    while high - row > 1:
        half = (row + high) >> 1
        if row_edges[half] >= s:
            row = half
        else:
            high = half
    for k in range(count):
        end = edges[k + 1]
        while True:
            whole = row_edges[row + 1] >= end and row + 1 < last
            to = row_edges[row + 1] if whole else end
            under = row_half_angles[row + 1] if whole else half_angles[k + 1]
            if to < s:
                # light over s, over s times cos(latitude), over s^2 / 2
                area, across, level = s - to, above - under, 0.5 * (s * s - to * to)
                of = light[row]
                for lane in range(LANES):
                    value = np.float64(of[lane])
                    sums[0, lane] += area * value
                    sums[1, lane] += across * value
                    sums[2, lane] += level * value
                s, above = to, under
            if not whole:
                break
            row += 1
        place = out[places[k]]
        for lane in range(LANES):
            place[0, lane] += width * sums[0, lane]
            place[1, lane] += wx * sums[1, lane]
            place[2, lane] += width * sums[2, lane]
            place[3, lane] += wz * sums[1, lane]
            sums[0, lane] = sums[1, lane] = sums[2, lane] = 0.0


@njit(cache=True, nogil=True)
def _cap(ds, dt, resolution, table, edges, half_angles, places):  # type: ignore[no-untyped-def]
    """Texels of the pole face, from row R // 2 on, along the ray rho (ds, dt) from the pole to the rim at t = 1, with
    the s = sin(latitude) of their borders. Returns their number."""
    r = resolution
    odd = r % 2
    column = r // 2 if odd or ds >= 0 else r // 2 - 1
    row = 0
    step = 1 if ds >= 0 else -1
    # rho of the next border of a column, and of a row
    across_c = (1.0 / r) / abs(ds) if ds != 0.0 else math.inf
    across_r = (1.0 / r) / dt
    crossed_c = crossed_r = 2 - odd
    rim = 1.0 / dt
    edges[0], half_angles[0] = 1.0, 0.25 * math.pi
    count = 0
    while True:
        rho_c, rho_r = crossed_c * across_c, crossed_r * across_r
        rho = min(rho_c, rho_r)
        places[count] = row * r + column
        count += 1
        last = rho >= rim * (1.0 - 1e-12)
        if last:
            rho = rim
        square = 1.0 / (1.0 + rho * rho)
        edges[count] = math.sqrt(square)
        half_angles[count] = 0.25 * math.pi - half_angle(table, rho) + rho * square
        if last:
            return count
        if rho_c <= rho:
            crossed_c += 2
            column += step
        if rho_r <= rho:
            crossed_r += 2
            row += 1


@njit(cache=True, nogil=True)
def _unfold(sums, resolution, hemispheres, flux, moment):  # type: ignore[no-untyped-def]
    """Places (P, 4, LANES) of the sector to the texels of the cube, for every quarter turn and a range of the
    hemispheres: 0 north, 1 south."""
    r = resolution
    cap = r * r - r // 2 * r
    for place in range(len(sums)):
        side = place >= cap
        row, column = (place - cap) // r if side else place // r + r // 2, place % r
        if not side and (column + 1 < r - 1 - row or column > row + 1):  # beyond the sector
            continue
        for lane in range(8):
            quarter, south = lane >> 1, lane & 1
            if not hemispheres[0] <= south < hemispheres[1]:
                continue
            if side:
                face = (4, 0, 5, 1)[quarter]
                i, j = (r - 1 - row if south else row), column
            else:
                face = 3 if south else 2
                # A quarter turn takes the column's axis to the row's one, and that to the other way of the column's.
                i, j = ((row, column), (r - 1 - column, row), (r - 1 - row, r - 1 - column), (column, r - 1 - row))[
                    quarter
                ]
                if south:
                    i = r - 1 - i
            texel = (face * r + i) * r + j
            for c in range(3):
                at = 3 * lane + c
                x, y, z = sums[place, 1, at], sums[place, 2, at], sums[place, 3, at]
                flux[texel, c] += sums[place, 0, at]
                to = moment[texel, c]
                if quarter == 0:
                    to[0], to[2] = to[0] + x, to[2] + z
                elif quarter == 1:
                    to[0], to[2] = to[0] + z, to[2] - x
                elif quarter == 2:
                    to[0], to[2] = to[0] - x, to[2] - z
                else:
                    to[0], to[2] = to[0] - z, to[2] + x
                to[1] += -y if south else y


def splat(sky: SkyCube, threads: int = 1) -> SkyCube:
    """Shares the light of every texel among the four texels whose centres surround the light's mean direction.

    The weights are bilinear on the face (across its borders the nearest texel of the next face takes part). Summed
    against visibility bits this is light times bilinearly interpolated visibility: a sun smaller than a texel casts
    its shadow at the right place, softened over one texel, and even light stays where it was. Flux and moments keep
    their totals and the moments their true directions.
    """
    out, padded = _dark(sky.resolution), _padded_index(sky.resolution)

    def within(first: int, last: int) -> None:
        _splat(sky.flux, sky.moment, sky.resolution, padded, (first, last), False, out.flux, out.moment)

    in_parts(within, 6, threads)
    _splat(sky.flux, sky.moment, sky.resolution, padded, (0, 6), True, out.flux, out.moment)
    return out


@lru_cache(maxsize=4)
def _padded_index(resolution: int) -> NDArray[np.int32]:
    """Flat texel index (6, R+2, R+2) of each face with a border of one texel from its neighbours."""
    c = np.concatenate([[-1.0 - 1.0 / resolution], cube.texel_centers(resolution), [1.0 + 1.0 / resolution]])
    return np.stack(
        [cube.texel_index(cube.face_directions(f, c[None, :], c[:, None]), resolution) for f in range(6)]
    ).astype(np.int32)


@njit(cache=True, nogil=True)
def _splat(flux, moment, resolution, padded, faces, rims, to_flux, to_moment):  # type: ignore[no-untyped-def]
    """Of some faces: the texels along their borders, whose light can go to another face, or all others."""
    area, end = resolution * resolution, resolution - 1
    for texel in range(faces[0] * area, faces[1] * area):
        row, column = texel % area // resolution, texel % resolution
        if (row == 0 or row == end or column == 0 or column == end) != rims:
            continue
        total = flux[texel, 0] + flux[texel, 1] + flux[texel, 2]
        if total == 0.0:
            continue
        face = texel // area
        # mean direction of the light, as a point (s, t) of the face
        x = moment[texel, 0, 0] + moment[texel, 1, 0] + moment[texel, 2, 0]
        y = moment[texel, 0, 1] + moment[texel, 1, 1] + moment[texel, 2, 1]
        z = moment[texel, 0, 2] + moment[texel, 1, 2] + moment[texel, 2, 2]
        if face == 0:
            s, t = -z / x, -y / x
        elif face == 1:
            s, t = -z / x, y / x
        elif face == 2:
            s, t = x / y, z / y
        elif face == 3:
            s, t = -x / y, z / y
        elif face == 4:
            s, t = x / z, -y / z
        else:
            s, t = x / z, y / z
        a = (s + 1.0) * 0.5 * resolution + 0.5  # column in the padded face, texel centres at whole numbers
        b = (t + 1.0) * 0.5 * resolution + 0.5
        j = min(max(math.floor(a), 0), resolution)
        i = min(max(math.floor(b), 0), resolution)
        fa, fb = a - j, b - i
        for di in range(2):
            for dj in range(2):
                w = (fb if di else 1.0 - fb) * (fa if dj else 1.0 - fa)
                if w == 0.0:
                    continue
                target = padded[face, i + di, j + dj]
                for c in range(3):
                    to_flux[target, c] += w * flux[texel, c]
                    for q in range(3):
                        to_moment[target, c, q] += w * moment[texel, c, q]
