"""Specular light between receivers: what arrives is gathered once per light factor, and sent on by the view factors.

The factors are those of `brdf.separable`, of lobes that are widened to the size of a cell: narrower ones could not be
told from the pattern of the cells.
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
)
from relightcli.core.brdf.sampling import orthonormal_frame
from relightcli.core.brdf.separable import MOST_ORDERS, MOST_TERMS, POLAR, separate
from relightcli.core.lights.environment import SkyCube
from relightcli.core.shade.gather import in_parts
from relightcli.core.sphere import cube

FACTOR_TOLERANCE = 0.1  # relative norm of a lobe that its factors may leave out


class LobeFactors(NamedTuple):
    """Separated lobes of M materials, K = MOST_TERMS terms each, the last ones 0.

    shiny (M,) bool, whether the material has a lobe; highest (M,) int64, its highest order; order (M, K) int64;
    view_factor, light_factor (M, POLAR, K) float32; colour (M, 3) float32, the specular colour.
    """

    shiny: NDArray[np.bool_]
    highest: NDArray[np.int64]
    order: NDArray[np.int64]
    view_factor: NDArray[np.float32]
    light_factor: NDArray[np.float32]
    colour: NDArray[np.float32]


def lobe_factors(table: MaterialTable) -> LobeFactors:
    """Factors of every material with a specular lobe that is not black. Lobes narrower than a cell must be widened."""
    m = len(table.model)
    out = LobeFactors(
        np.zeros(m, bool),
        np.zeros(m, np.int64),
        np.zeros((m, MOST_TERMS), np.int64),
        np.zeros((m, POLAR, MOST_TERMS), np.float32),
        np.zeros((m, POLAR, MOST_TERMS), np.float32),
        table.parameters[:, SPECULAR : SPECULAR + 3].astype(np.float32),
    )
    for index, model in enumerate(table.model):
        if model not in (BLINN_PHONG, COOK_TORRANCE, PHONG) or not out.colour[index].any():
            continue
        factors = separate(int(model), table.parameters[index], FACTOR_TOLERANCE)
        k = len(factors.order)
        out.shiny[index], out.highest[index] = True, factors.order[-1]
        out.order[index, :k] = factors.order
        out.view_factor[index, :, :k] = factors.view_factor
        out.light_factor[index, :, :k] = factors.light_factor
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def waves(factor, order, highest, axes, d, circle, out):  # type: ignore[no-untyped-def]
    """Fills out (2, K): every term's factor at the direction d, times cosine and sine of its order's azimuth.

    factor (POLAR, K), order (K,) of one material; axes: two tangents and the normal, unit; circle (2, MOST_ORDERS) is
    scratch. False below the horizon.
    """
    z = dot(axes[2], d)
    if not z > 0.0:
        return False
    x, y = dot(axes[0], d), dot(axes[1], d)
    radius = math.sqrt(x * x + y * y)
    c1, s1 = (x / radius, y / radius) if radius > 0.0 else (1.0, 0.0)
    place = min(max(math.sqrt(max(0.0, 1.0 - z)) * POLAR - 0.5, 0.0), POLAR - 1.001)
    g = int(place)
    f = np.float32(place - g)
    c, s = 1.0, 0.0
    for m in range(highest + 1):
        circle[0, m], circle[1, m] = c, s
        c, s = c * c1 - s * s1, c * s1 + s * c1
    terms = len(order)
    for k in range(terms):
        out[0, k] = circle[0, order[k]]
        out[1, k] = circle[1, order[k]]
    for k in range(terms):
        value = factor[g, k] + f * (factor[g + 1, k] - factor[g, k])
        out[0, k] *= value
        out[1, k] *= value
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
    """Specular exit radiance without its colour, of view factors `wave` (2, K) and what was `gathered` (6, K); what
    truncation puts below zero is cut off."""
    red = green = blue = np.float32(0.0)
    for k in range(MOST_TERMS):
        red += wave[0, k] * gathered[0, k] + wave[1, k] * gathered[3, k]
        green += wave[0, k] * gathered[1, k] + wave[1, k] * gathered[4, k]
        blue += wave[0, k] * gathered[2, k] + wave[1, k] * gathered[5, k]
    zero = np.float32(0.0)
    return max(red, zero), max(green, zero), max(blue, zero)


@njit(cache=True, nogil=True)
def axes_of(n):  # type: ignore[no-untyped-def]
    """Two tangents of the unit normal, and itself."""
    s, t = orthonormal_frame(n)
    return s, t, n


@njit(cache=True, nogil=True, error_model="numpy")
def _sky_lobes(words, normals, material, factors, directions, flux, resolution, cells, out, row):  # type: ignore[no-untyped-def]
    side = resolution // cells
    wave, circle = np.empty((2, MOST_TERMS), np.float32), np.empty((2, MOST_ORDERS), np.float32)
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
                for b in range(t, t + side):
                    seen += (words[i, b >> 3] >> np.uint8(b & 7)) & np.uint8(1)
            if seen == 0:
                continue
            d = (directions[c, 0], directions[c, 1], directions[c, 2])
            if waves(factors.light_factor[m], factors.order[m], factors.highest[m], axes, d, circle, wave):
                share = np.float32(seen / (side * side))
                gather_lobe(wave, share * flux[c, 0], share * flux[c, 1], share * flux[c, 2], out[row[i]])
