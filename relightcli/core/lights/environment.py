"""From a latitude-longitude map to the sky cube: exact in power, with the mean direction of every texel's light.

The sphere is cut into meridian strips whose borders are all pixel columns and all meridians through texel corners. In
a strip the pixels and the texels met from pole to pole are two partitions of s = sin(latitude) in [-1, 1]; merging
them gives the solid angle dlambda ds of every overlap. Each pixel's solid angle is thus shared out completely: total
power is kept to rounding, for a one-pixel sun too. A texel's border is taken at its latitude in the middle of the
strip: a constant map stays constant to 4e-3 at 16, 5e-4 at 64 and 1.3e-4 at 256 texels a side in the worst texel, near
the poles, and six to eight times better in the mean square. Between the rims of the side faces, where borders hardly
bend, neighbouring strips go as one that is up to a quarter of a texel wide.
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
    # Pixel columns by rising longitude: column W-1-k spans [-pi + k w, -pi + (k+1) w] + turn.
    columns = -math.pi + (2.0 * math.pi / width) * np.arange(width) + turn
    columns = np.mod(columns + math.pi, 2.0 * math.pi) - math.pi
    borders = np.unique(np.concatenate([columns, *_strip_meridians(resolution, width), [-math.pi, math.pi]]))
    middle = 0.5 * (borders[1:] + borders[:-1])
    k = np.floor(np.mod(middle - turn + math.pi, 2.0 * math.pi) * (width / (2.0 * math.pi))).astype(np.int64)
    column_of = width - 1 - np.clip(k, 0, width - 1)
    row_edges = np.cos(math.pi * np.arange(height + 1) / height)[::-1].copy()  # rising s, from the south pole
    row_half_angles = 0.5 * (np.arcsin(row_edges) + row_edges * np.sqrt(np.maximum(0.0, 1.0 - row_edges**2)))
    source = np.ascontiguousarray(radiance, np.float32)
    table = half_angles_table()
    parts = [np.zeros((6 * resolution * resolution, 3, 4)) for _ in range(2)]
    cuts = (0, len(column_of) // 2, len(column_of))

    def walk(first: int, last: int) -> None:
        for k in range(first, last):
            a, b = cuts[k], cuts[k + 1]
            _walk(
                source, column_of[a:b], borders[a : b + 1], row_edges, row_half_angles, table, resolution, parts[k]
            )  # fmt: skip

    in_parts(walk, 2, 2)
    sky = _dark(resolution)
    _join(parts[0], parts[1], sky.flux, sky.moment)
    return sky


def _dark(resolution: int) -> SkyCube:
    texels = 6 * resolution * resolution
    return SkyCube(resolution, np.zeros((texels, 3)), np.zeros((texels, 3, 3)))


@njit(cache=True, nogil=True)
def _join(one, other, flux, moment):  # type: ignore[no-untyped-def]
    for texel in range(len(one)):
        for c in range(3):
            flux[texel, c] = one[texel, c, 0] + other[texel, c, 0]
            for q in range(3):
                moment[texel, c, q] = one[texel, c, 1 + q] + other[texel, c, 1 + q]


@lru_cache(maxsize=4)
def _strip_meridians(resolution: int, width: int) -> tuple[NDArray[np.float64], ...]:
    """Longitudes of the corners of all texels of the pole faces, which include the borders of the side faces' texels,
    and evenly spaced ones where the `width` columns of the map are wider."""
    half = np.arange(-resolution, resolution + 1, 2)
    i, j = np.meshgrid(half, half, indexing="ij")
    keep = (i != 0) | (j != 0)
    i, j = i[keep], j[keep]
    g = np.gcd(i, j)
    once = g <= 2  # every direction's nearest corner: odd ones have g = 1, even ones 2
    corners = np.arctan2(i[once].astype(np.float64), j[once].astype(np.float64))
    steps = STRIPS * resolution
    if width >= steps:
        return (corners,)
    return corners, -math.pi + (2.0 * math.pi / steps) * np.arange(steps, dtype=np.float64)


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
def _walk(radiance, column_of, borders, row_edges, row_half_angles, table, resolution, out):  # type: ignore[no-untyped-def]
    """The texels of the pole faces, and of the side faces their rims, strip by strip; between the rims a run of strips
    in one column of the map and of texels goes as one."""
    r = resolution
    room = 6 * r + 8
    edges, half_angles, texels = np.empty(room), np.empty(room), np.empty(room, np.int64)
    side_edges, side_half_angles, side = np.empty(r + 1), np.empty(r + 1), np.empty(r, np.int64)
    light = np.empty((len(row_edges) - 1, 3))
    rows = (0, len(light))
    held = -1
    widest, stop = 1.001 * math.pi / (8 * r), 0  # a quarter of a texel in the middle of a face
    for strip in range(len(column_of)):
        low, high = borders[strip], borders[strip + 1]
        if column_of[strip] != held:
            held = column_of[strip]
            take_column(radiance, held, rows, light)
        middle = 0.5 * (low + high)
        sin_l, cos_l = math.sin(middle), math.cos(middle)
        if strip == stop:
            place = _side(sin_l, cos_l, r)
            stop += 1
            while stop < len(column_of) and column_of[stop] == held and borders[stop + 1] - low <= widest:
                other = 0.5 * (borders[stop] + borders[stop + 1])
                if _side(math.sin(other), math.cos(other), r)[:2] != place[:2]:
                    break
                stop += 1
            whole = 0.5 * (low + borders[stop])
            face, column, m = _side(math.sin(whole), math.cos(whole), r)
            for i in range(r + 1):  # tan(latitude) = m v with v = -t from -1 to 1
                v = m * (2.0 * i / r - 1.0)
                side_edges[i], side_half_angles[i] = v / math.sqrt(1.0 + v * v), half_angle(table, v)
            for i in range(r):
                side[i] = (face * r + (r - 1 - i)) * r + column
            first, last = 1, max(r - 1, 1)
            if r == 1:  # cut at the equator
                side_edges[1], side_half_angles[1] = 0.0, 0.0
            if first < last:
                merge_strip(
                    light, rows, row_edges, row_half_angles, side_edges[first : last + 1],
                    side_half_angles[first : last + 1], side[first:last], last - first, whole, borders[stop] - low, out,
                )  # fmt: skip
        if high - low < 1e-14:
            continue
        # -Y face: from the pole outwards; s = x = rho sin, t = -z = -rho cos, with rho = -1 / tan(latitude).
        count = _cap(sin_l, -cos_l, r, 3, table, 0, edges, half_angles, texels)
        for k in range(count + 1):
            edges[k], half_angles[k] = -edges[k], -half_angles[k]
        texels[count] = side[0]
        count += 1
        edges[count], half_angles[count] = side_edges[first], side_half_angles[first]
        merge_strip(
            light, rows, row_edges, row_half_angles, edges, half_angles, texels, count, middle, high - low, out
        )  # fmt: skip
        # +Y face: from the rim inwards; s = x, t = z. Written from the pole outwards, then turned round.
        count = _cap(sin_l, cos_l, r, 2, table, 0, edges, half_angles, texels)
        texels[count] = side[r - 1]
        count += 1
        edges[count], half_angles[count] = side_edges[last], side_half_angles[last]
        texels[:count] = texels[:count][::-1].copy()
        edges[: count + 1] = edges[: count + 1][::-1].copy()
        half_angles[: count + 1] = half_angles[: count + 1][::-1].copy()
        merge_strip(
            light, rows, row_edges, row_half_angles, edges, half_angles, texels, count, middle, high - low, out
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _side(sin_l, cos_l, resolution):  # type: ignore[no-untyped-def]
    """Side face and its column of texels at a longitude; and tan(latitude) over v = -t there."""
    if abs(sin_l) > abs(cos_l):
        face, m = (0 if sin_l > 0 else 1), abs(sin_l)
        right = -cos_l if sin_l > 0 else cos_l
    else:
        face, m = (4 if cos_l > 0 else 5), abs(cos_l)
        right = sin_l if cos_l > 0 else -sin_l
    return face, min(max(math.floor((right / m + 1.0) * 0.5 * resolution), 0), resolution - 1), m


@njit(cache=True, nogil=True)
def take_column(radiance, column, rows, light):  # type: ignore[no-untyped-def]
    """Pixels of a column of a map (H, W, 3), from rows[0] to rows[1] counted from the south pole, to light (H, 3)."""
    for row in range(rows[0], rows[1]):
        for c in range(3):
            light[row, c] = radiance[len(light) - 1 - row, column, c]


@njit(cache=True, nogil=True)
def merge_strip(  # type: ignore[no-untyped-def]
    light, rows, row_edges, row_half_angles, edges, half_angles, places, count, middle, width, out
):
    """Adds the light of a column's pixels, in a strip of `width` radians about the longitude `middle`, to the places
    that the meridian meets.

    light (H, 3) float64: of `take_column`, the pixels from rows[0] to rows[1] take part. row_edges (H + 1,):
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
def _cap(ds, dt, resolution, face, table, first, edges, half_angles, texels):  # type: ignore[no-untyped-def]
    """Texels of a pole face along the ray rho (ds, dt) from the pole to the rim, from place `first` on, and their
    borders as on the northern face. Returns their number."""
    r = resolution
    column = r // 2 if ds >= 0 else r // 2 - 1
    row = r // 2 if dt >= 0 else r // 2 - 1
    step_c = 1 if ds >= 0 else -1
    step_r = 1 if dt >= 0 else -1
    # rho of the next border of a column, and of a row
    across_c = (2.0 / r) / abs(ds) if ds != 0.0 else math.inf
    across_r = (2.0 / r) / abs(dt) if dt != 0.0 else math.inf
    crossed_c, crossed_r = 1, 1
    rim = 1.0 / max(abs(ds), abs(dt))
    edges[first], half_angles[first] = 1.0, 0.25 * math.pi
    count = first
    while True:
        rho_c, rho_r = crossed_c * across_c, crossed_r * across_r
        rho = min(rho_c, rho_r)
        texels[count] = (face * r + row) * r + column
        count += 1
        last = rho >= rim * (1.0 - 1e-12)
        if last:
            rho = rim
        square = 1.0 / (1.0 + rho * rho)
        edges[count] = math.sqrt(square)
        half_angles[count] = 0.25 * math.pi - half_angle(table, rho) + rho * square
        if last:
            return count - first
        if rho_c <= rho:
            crossed_c += 1
            column += step_c
        if rho_r <= rho:
            crossed_r += 1
            row += step_r


def splat(sky: SkyCube) -> SkyCube:
    """Shares the light of every texel among the four texels whose centres surround the light's mean direction.

    The weights are bilinear on the face (across its borders the nearest texel of the next face takes part). Summed
    against visibility bits this is light times bilinearly interpolated visibility: a sun smaller than a texel casts
    its shadow at the right place, softened over one texel, and even light stays where it was. Flux and moments keep
    their totals and the moments their true directions.
    """
    out = _dark(sky.resolution)
    _splat(sky.flux, sky.moment, sky.resolution, _padded_index(sky.resolution), out.flux, out.moment)
    return out


@lru_cache(maxsize=4)
def _padded_index(resolution: int) -> NDArray[np.int32]:
    """Flat texel index (6, R+2, R+2) of each face with a border of one texel from its neighbours."""
    c = np.concatenate([[-1.0 - 1.0 / resolution], cube.texel_centers(resolution), [1.0 + 1.0 / resolution]])
    return np.stack(
        [cube.texel_index(cube.face_directions(f, c[None, :], c[:, None]), resolution) for f in range(6)]
    ).astype(np.int32)


@njit(cache=True, nogil=True)
def _splat(flux, moment, resolution, padded, to_flux, to_moment):  # type: ignore[no-untyped-def]
    for texel in range(len(flux)):
        total = flux[texel, 0] + flux[texel, 1] + flux[texel, 2]
        if total == 0.0:
            continue
        face = texel // (resolution * resolution)
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
