"""Specular exit radiance of any reflectance model, integrated over the visible sky.

For a receiver with viewer v the integral of L V s(l, v) dl, s the specular lobe with its cosine, is summed over a
quadtree of the sky cube's texels. A cell that is empty, dark or far from the lobe is passed over; one over which the
lobe hardly changes is taken whole, at the mean direction of its light, with the light of its visible texels; any other
is opened, down to single texels. Lobes narrower than a texel are left to `narrow`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import (
    BLINN_PHONG,
    COOK_TORRANCE,
    PHONG,
    ROUGHNESS,
    SHININESS,
    SPECULAR,
    MaterialTable,
    dot,
    lobes_and_density,
    tan2_between,
)
from relightcli.core.lights.environment import SkyCube
from relightcli.core.parts import in_parts
from relightcli.core.shade.narrow import add_suns, sample_lobe, suns
from relightcli.core.sphere import cube

TOP = 8  # side of the quadtree's largest cells, in texels
# A cell is taken whole when the lobe's exponent changes less than this over it; the error is of second order, because
# the cell's light sits at its own mean direction. Measured in tests/core/shade/test_glossy.py.
CHANGE = 0.5
NEGLIGIBLE = 14.0  # exponent beyond which the lobe is below 1e-6 of its peak


@dataclass(frozen=True)
class SkyTree:
    """The sky cube at R/8, R/4, R/2 and R texels a side; and the map it comes from, for narrow lobes.

    first (4,) int64: index of each level's first cell; flux (C, 3) float64; direction (C, 3) float64 unit, mean
    direction of the cell's light; reach (C,) float64: largest angle in radians between it and the cell's corners.
    map (H, W, 3) float32 lat-long radiance, turned by `rotation` radians about +Y; `clamped` the same without its suns.
    sun_direction, sun_flux (S, 3) float64: points of the brightest pixels and what `clamped` lacks there, times sr.
    """

    resolution: int
    first: NDArray[np.int64]
    flux: NDArray[np.float64]
    direction: NDArray[np.float64]
    reach: NDArray[np.float64]
    map: NDArray[np.float32]
    rotation: float
    clamped: NDArray[np.float32]
    sun_direction: NDArray[np.float64]
    sun_flux: NDArray[np.float64]


def sky_tree(sky: SkyCube, radiance: NDArray[np.float32], rotate_degrees: float) -> SkyTree:
    """The quadtree of a sky cube, and the lat-long map (H, W, 3) with its turn that the cube was made from."""
    levels, mean = [], sky.moment.sum(axis=1)
    for shrink in (8, 4, 2, 1):
        r = sky.resolution // shrink
        flux = cube.block_sums(sky.flux, sky.resolution, shrink)
        moment = cube.block_sums(mean, sky.resolution, shrink)
        center = cube.texel_directions(r).reshape(-1, 3)
        length = np.linalg.norm(moment, axis=1, keepdims=True)
        direction = np.where(length > 0, moment / np.maximum(length, 1e-300), center)
        levels.append((flux, direction, _reach(direction, r)))
    sizes = [len(level[0]) for level in levels]
    return SkyTree(
        sky.resolution,
        np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64),
        np.concatenate([level[0] for level in levels]),
        np.concatenate([level[1] for level in levels]),
        np.concatenate([level[2] for level in levels]),
        np.ascontiguousarray(radiance, np.float32),
        math.radians(rotate_degrees),
        *suns(np.ascontiguousarray(radiance, np.float32), math.radians(rotate_degrees)),
    )


def _reach(direction: NDArray[np.float64], r: int) -> NDArray[np.float64]:
    edge = 2.0 * np.arange(r + 1) / r - 1.0
    corners = np.stack([cube.face_directions(f, edge[None, :], edge[:, None]) for f in range(6)])
    around = np.stack([corners[:, i : r + i, j : r + j] for i in (0, 1) for j in (0, 1)], axis=3).reshape(-1, 4, 3)
    cosine = np.einsum("ckx,cx->ck", around, direction).min(axis=1)
    out: NDArray[np.float64] = np.arccos(np.clip(cosine, -1.0, 1.0))
    return out


def specular_radiance(
    bits: NDArray[np.uint8],
    rows: NDArray[np.int64],
    normals: NDArray[np.float32],
    views: NDArray[np.float32],
    material: NDArray[np.int32],
    table: MaterialTable,
    tree: SkyTree,
    threads: int = 1,
) -> NDArray[np.float32]:
    """Integral of L V s dl at the receivers `rows` (M,), times the specular colour: (M, 3) float32.

    bits (N, 6, R, R/8); normals (M, 3), views (M, 3) unit directions to the viewer; material (M,) rows of `table`.
    """
    out = np.zeros((len(rows), 3), np.float32)

    def part(a: int, b: int) -> None:
        _integrate(
            bits,
            rows[a:b],
            normals[a:b],
            views[a:b],
            material[a:b],
            table.model,
            table.parameters,
            tree.resolution,
            tree.first,
            tree.flux,
            tree.direction,
            tree.reach,
            tree.map,
            tree.rotation,
            tree.clamped,
            tree.sun_direction,
            tree.sun_flux,
            out[a:b],
        )

    in_parts(part, len(rows), threads)
    colour = table.parameters[material][:, SPECULAR : SPECULAR + 3]
    return (out * colour).astype(np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def _lobe_width(model, row):  # type: ignore[no-untyped-def]
    """Angle in radians from the lobe's axis, in light directions halved for half-vector lobes, where it is 1/e."""
    if model == COOK_TORRANCE:
        return row[ROUGHNESS]
    width = math.sqrt(2.0 / (row[SHININESS] + 1e-9))
    return 0.5 * width if model == PHONG else width


@njit(cache=True, nogil=True, error_model="numpy")
def _exponent(model, row, tangent):  # type: ignore[no-untyped-def]
    """-log of the lobe at an angle of this tangent from its axis, up to its slow factors."""
    if model == COOK_TORRANCE:
        return tangent * tangent / (row[ROUGHNESS] * row[ROUGHNESS])
    return 0.5 * row[SHININESS] * math.log1p(tangent * tangent)


@njit(cache=True, nogil=True, error_model="numpy")
def _spread(model, row, n, l, v, reach):  # type: ignore[no-untyped-def]  # noqa: E741
    """(least, greatest) exponent of the lobe over the directions within `reach` of l."""
    if model == PHONG:
        nv = dot(n, v)
        axis = (2.0 * nv * n[0] - v[0], 2.0 * nv * n[1] - v[1], 2.0 * nv * n[2] - v[2])
        angle = math.acos(min(1.0, max(-1.0, dot(axis, l))))
        move = reach
    else:
        half = (l[0] + v[0], l[1] + v[1], l[2] + v[2])
        angle = math.atan(math.sqrt(tan2_between(n, half)))
        # |d half| / |d l| is at most 1 / (2 v.h)
        move = reach / max(0.2, math.sqrt(dot(half, half)))
    low = max(0.0, angle - move)
    high = min(1.5, angle + move)
    if low >= 1.5:
        return 1e9, 1e9
    return _exponent(model, row, math.tan(low)), _exponent(model, row, math.tan(high))


@njit(cache=True, nogil=True, error_model="numpy")
def _integrate(  # type: ignore[no-untyped-def]
    bits,
    rows,
    normals,
    views,
    material,
    models,
    parameters,
    resolution,
    first,
    flux,
    direction,
    reach,
    radiance,
    rotation,
    clamped,
    sun_direction,
    sun_flux,
    out,
):
    tiles = resolution // TOP
    level_of = np.empty(64, np.int64)
    row_of = np.empty(64, np.int64)
    column_of = np.empty(64, np.int64)
    for m in range(len(rows)):
        k = material[m]
        model, row = models[k], parameters[k]
        if model not in (BLINN_PHONG, COOK_TORRANCE, PHONG):
            continue
        n = (np.float64(normals[m, 0]), np.float64(normals[m, 1]), np.float64(normals[m, 2]))
        v = (np.float64(views[m, 0]), np.float64(views[m, 1]), np.float64(views[m, 2]))
        if not dot(n, v) > 0.0:
            continue
        i = rows[m]
        width = _lobe_width(model, row)
        # Seen at a low angle a lobe is narrower still.
        if width * min(1.0, 3.0 * dot(n, v)) < 2.0 / resolution:
            if width > 0.5 * math.pi / len(radiance):
                sample_lobe(bits, i, n, v, model, row, resolution, clamped, rotation, out, m)
                add_suns(bits, i, n, v, model, row, resolution, sun_direction, sun_flux, out, m)
            else:
                sample_lobe(bits, i, n, v, model, row, resolution, radiance, rotation, out, m)
            continue
        red = green = blue = 0.0
        for face in range(6):
            for tr in range(tiles):
                for tc in range(tiles):
                    mask = np.uint64(0)
                    for b in range(TOP):
                        mask |= np.uint64(bits[i, face, tr * TOP + b, tc]) << np.uint64(8 * b)
                    if mask == np.uint64(0):
                        continue
                    stack = 1
                    level_of[0], row_of[0], column_of[0] = 0, 0, 0
                    while stack > 0:
                        stack -= 1
                        level, r, c = level_of[stack], row_of[stack], column_of[stack]
                        size = TOP >> level
                        inside = _block(size) << np.uint64(8 * r + c)
                        seen = mask & inside
                        if seen == np.uint64(0):
                            continue
                        side = resolution // size
                        cell = (face * side + (tr * TOP + r) // size) * side + (tc * TOP + c) // size + first[level]
                        if flux[cell, 0] == 0.0 and flux[cell, 1] == 0.0 and flux[cell, 2] == 0.0:
                            continue
                        l = (direction[cell, 0], direction[cell, 1], direction[cell, 2])  # noqa: E741
                        if level < 3:
                            low, high = _spread(model, row, n, l, v, reach[cell])
                            if low > NEGLIGIBLE:
                                continue
                            near_horizon = dot(n, l) < 2.0 * reach[cell]
                            if near_horizon or (high - low) * math.exp(-0.5 * low) > CHANGE:
                                half = size // 2
                                for q in range(4):
                                    level_of[stack] = level + 1
                                    row_of[stack] = r + (q >> 1) * half
                                    column_of[stack] = c + (q & 1) * half
                                    stack += 1
                                continue
                        _, s, _, _ = lobes_and_density(model, row, n, l, v)
                        if s == 0.0:
                            continue
                        if seen == inside:
                            red += s * flux[cell, 0]
                            green += s * flux[cell, 1]
                            blue += s * flux[cell, 2]
                            continue
                        for a in range(r, r + size):
                            for b in range(c, c + size):
                                if (seen >> np.uint64(8 * a + b)) & np.uint64(1):
                                    t = (face * resolution + tr * TOP + a) * resolution + tc * TOP + b + first[3]
                                    red += s * flux[t, 0]
                                    green += s * flux[t, 1]
                                    blue += s * flux[t, 2]
        out[m, 0] = red
        out[m, 1] = green
        out[m, 2] = blue


@njit(cache=True, nogil=True)
def _block(size):  # type: ignore[no-untyped-def]
    """Bits of a size x size block in the top left corner of an 8 x 8 mask, rows of 8."""
    if size == 8:
        return np.uint64(0xFFFFFFFFFFFFFFFF)
    if size == 4:
        return np.uint64(0x0F0F0F0F)
    if size == 2:
        return np.uint64(0x0303)
    return np.uint64(1)
