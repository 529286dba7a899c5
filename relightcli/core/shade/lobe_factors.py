"""Specular light between receivers: what arrives is gathered once per light factor, and sent on by the view factors.

The factors are those of `brdf.separable`, of lobes that are widened to what the factors can hold, which is also more
than a cell: narrower lobes could not be told from the pattern of the cells.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import (
    BLINN_PHONG,
    COOK_TORRANCE,
    PHONG,
    SPECULAR,
    MaterialTable,
    dot,
    widen,
)
from relightcli.core.brdf.sampling import orthonormal_frame
from relightcli.core.brdf.separable import LEAST_WIDTH, POLAR, ROWS, TERMS, separate
from relightcli.core.lights.environment import SkyCube
from relightcli.core.parts import in_parts
from relightcli.core.sphere import cube
from relightcli.core.sphere.lattice import r2_point
from relightcli.core.transport.light_visibility import point_count
from relightcli.core.transport.local_lights import LocalLights, sample_light


class LobeFactors(NamedTuple):
    """Separated lobes of M materials: shiny (M,) bool, whether there is one; view_factor, light_factor (M, POLAR, K)
    float32; colour (M, 3) float32, the specular colour. K = TERMS."""

    shiny: NDArray[np.bool_]
    view_factor: NDArray[np.float32]
    light_factor: NDArray[np.float32]
    colour: NDArray[np.float32]


def lobe_factors(table: MaterialTable) -> LobeFactors:
    """Factors of every material with a specular lobe that is not black, widened to LEAST_WIDTH if need be."""
    table = widen(table, LEAST_WIDTH)
    m = len(table.model)
    out = LobeFactors(
        np.zeros(m, bool),
        np.zeros((m, POLAR, TERMS), np.float32),
        np.zeros((m, POLAR, TERMS), np.float32),
        table.parameters[:, SPECULAR : SPECULAR + 3].astype(np.float32),
    )
    for index, model in enumerate(table.model):
        if model in (BLINN_PHONG, COOK_TORRANCE, PHONG) and out.colour[index].any():
            factors = separate(int(model), table.parameters[index])
            out.shiny[index] = True
            out.view_factor[index], out.light_factor[index] = factors.view_factor, factors.light_factor
    return out


def lobe_rows(material: NDArray[np.int32], factors: LobeFactors) -> NDArray[np.int32]:
    """Place of every receiver with a lobe among them, (N,) int32, -1 for the others. material (N,)."""
    shiny = factors.shiny[material]
    row = np.cumsum(shiny).astype(np.int32) - 1
    return np.where(shiny, row, -1).astype(np.int32)


def sky_lobes(
    bits: NDArray[np.uint8],
    normals: NDArray[np.float32],
    material: NDArray[np.int32],
    factors: LobeFactors,
    sky: SkyCube,
    out: NDArray[np.float32],
    row: NDArray[np.int32],
    threads: int = 1,
) -> None:
    """Adds to `out` (G, 6, K) what shiny receivers gather of the sky, a cube of 6 C C cells.

    bits (N, 6, R, R/8), normals (N, 3), material (N,), row (N,) of the same receivers. A cell counts by the share of
    its texels that is visible.
    """
    words = np.ascontiguousarray(bits).reshape(len(bits), -1)
    directions = cube.texel_directions(sky.resolution).reshape(-1, 3)
    flux = np.ascontiguousarray(sky.flux, np.float32)

    def part(a: int, b: int) -> None:
        _sky_lobes(
            words[a:b],
            normals[a:b],
            material[a:b],
            factors,
            directions,
            flux,
            bits.shape[2],
            sky.resolution,
            out,
            row[a:b],
        )

    in_parts(part, len(bits), threads)


# Order of sums is free, so that loops over the terms become vector instructions.
FAST = {"reassoc", "contract", "nsz"}
_ROW_0, _ROW_1 = ROWS[:2]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def waves(factor, axes, d, out):  # type: ignore[no-untyped-def]
    """Fills out (2, K): every term's factor at the direction d, times cosine and sine of its order's azimuth.

    factor (POLAR, K) of one material; axes: two tangents and the normal, unit. False below the horizon.
    """
    z = dot(axes[2], d)
    if not z > 0.0:
        return False
    x, y = dot(axes[0], d), dot(axes[1], d)
    square = x * x + y * y
    scale = 1.0 / math.sqrt(square) if square > 0.0 else 0.0
    # Powers of e^(i phi), four at a time: a chain of single ones would wait for each.
    c1, s1 = np.float32(x * scale), np.float32(y * scale)
    c2, s2 = c1 * c1 - s1 * s1, np.float32(2.0) * c1 * s1
    c4, s4 = c2 * c2 - s2 * s2, np.float32(2.0) * c2 * s2
    c, s = out[0], out[1]
    c[0], c[1], c[2], c[3] = np.float32(1.0), c1, c2, c2 * c1 - s2 * s1
    s[0], s[1], s[2], s[3] = np.float32(0.0), s1, s2, c2 * s1 + s2 * c1
    for m in range(4, _ROW_0):
        c[m] = c[m - 4] * c4 - s[m - 4] * s4
        s[m] = c[m - 4] * s4 + s[m - 4] * c4
    for m in range(_ROW_1):
        c[_ROW_0 + m], s[_ROW_0 + m] = c[m], s[m]
    for k in range(_ROW_0 + _ROW_1, TERMS):
        c[k], s[k] = np.float32(1.0), np.float32(0.0)
    place = min(max(math.sqrt(max(0.0, 1.0 - z)) * POLAR - 0.5, 0.0), POLAR - 1.001)
    g = int(place)
    f = np.float32(place - g)
    low, high = factor[g], factor[g + 1]
    for k in range(len(low)):
        value = low[k] + f * (high[k] - low[k])
        c[k] *= value
        s[k] *= value
    return True


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def gather_lobe(wave, red, green, blue, out):  # type: ignore[no-untyped-def]
    """out (6, K) += light factors `wave` (2, K) times a flux: rows are cosines of red, green, blue, then sines."""
    terms = wave.shape[1]  # not the constant: loops of unknown length become vector instructions, known ones do not
    for part in range(2):
        for k in range(terms):
            out[3 * part, k] += wave[part, k] * red
        for k in range(terms):
            out[3 * part + 1, k] += wave[part, k] * green
        for k in range(terms):
            out[3 * part + 2, k] += wave[part, k] * blue


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def send_lobe(wave, gathered):  # type: ignore[no-untyped-def]
    """Specular exit radiance without its colour, of view factors `wave` (2, K) and what was `gathered` (6, K).

    Truncated lobes have places below zero. They stay, or the light would grow with every interreflection.
    """
    red = green = blue = np.float32(0.0)
    for k in range(TERMS):
        red += wave[0, k] * gathered[0, k] + wave[1, k] * gathered[3, k]
        green += wave[0, k] * gathered[1, k] + wave[1, k] * gathered[4, k]
        blue += wave[0, k] * gathered[2, k] + wave[1, k] * gathered[5, k]
    return red, green, blue


@njit(cache=True, nogil=True)
def axes_of(n):  # type: ignore[no-untyped-def]
    """Two tangents of the unit normal, and itself."""
    s, t = orthonormal_frame(n)
    return s, t, n


@njit(cache=True, nogil=True, error_model="numpy")
def _sky_lobes(words, normals, material, factors, directions, flux, resolution, cells, out, row):  # type: ignore[no-untyped-def]
    side = resolution // cells
    width = min(side, 8)  # texels of a cell in one byte
    mask = np.uint8((1 << width) - 1)
    ones = np.zeros(256, np.int64)
    for value in range(1, 256):
        ones[value] = ones[value >> 1] + (value & 1)
    wave = np.empty((2, TERMS), np.float32)
    for i in range(len(words)):
        if row[i] < 0:
            continue
        m = material[i]
        axes = axes_of((np.float64(normals[i, 0]), np.float64(normals[i, 1]), np.float64(normals[i, 2])))
        for c in range(len(flux)):
            if flux[c, 0] == 0.0 and flux[c, 1] == 0.0 and flux[c, 2] == 0.0:
                continue
            face, r, column = c // (cells * cells), (c // cells) % cells, c % cells
            seen = 0
            for a in range(side):
                t = (face * resolution + r * side + a) * resolution + column * side
                for b in range(t, t + side, width):
                    seen += ones[(words[i, b >> 3] >> np.uint8(b & 7)) & mask]
            if seen == 0:
                continue
            d = (directions[c, 0], directions[c, 1], directions[c, 2])
            if waves(factors.light_factor[m], axes, d, wave):
                share = np.float32(seen / (side * side))
                gather_lobe(wave, share * flux[c, 0], share * flux[c, 1], share * flux[c, 2], out[row[i]])


def local_lobes(
    bits: NDArray[np.uint8],
    lights: LocalLights,
    positions: NDArray[np.float64],
    normals: NDArray[np.float32],
    material: NDArray[np.int32],
    factors: LobeFactors,
    out: NDArray[np.float32],
    row: NDArray[np.int32],
    threads: int = 1,
) -> None:
    """Adds to `out` (G, 6, K) what shiny receivers, at `row` (N,), gather of the lights per light factor."""

    def part(a: int, b: int) -> None:
        _gather_points(
            bits[a:b],
            lights,
            positions[a:b],
            normals[a:b].astype(np.float64),
            material[a:b],
            factors,
            point_count(lights),
            out,
            row[a:b],
        )

    in_parts(part, len(bits), threads)


@njit(cache=True, nogil=True, error_model="numpy")
def _gather_points(bits, lights, positions, normals, material, factors, points, out, row):  # type: ignore[no-untyped-def]
    wave = np.empty((2, TERMS), np.float32)
    for i in range(len(bits)):
        if row[i] < 0:
            continue
        p = (positions[i, 0], positions[i, 1], positions[i, 2])
        axes = axes_of((normals[i, 0], normals[i, 1], normals[i, 2]))
        m = material[i]
        for k in range(points):
            if not (bits[i, k >> 3] >> np.uint8(k & 7)) & np.uint8(1):
                continue
            u1, u2 = r2_point(k)
            d, _, radiance, density = sample_light(lights, p, u1, u2)
            if waves(factors.light_factor[m], axes, d, wave):
                w = 1.0 / (density * points)
                red, green, blue = np.float32(w * radiance[0]), np.float32(w * radiance[1]), np.float32(w * radiance[2])
                gather_lobe(wave, red, green, blue, out[row[i]])
