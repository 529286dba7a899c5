"""Light of specular lobes at receivers: prefiltered sky times the visible share of the lobe. [Sun 2007, sec. 4.1]

    B_s = ks sum over k of a_k(theta_o) E_k(r) v_k(r),   r the mirror of w_o,   v_k = integral of V G_k dw

V has the receiver's own horizon in it. The product of two means stands for the mean of the product: it is exact where
the sky or the visibility is constant over the lobe.

v_k of a receiver is a table over its own hemisphere, in the octahedral projection: (x, y) / (|x| + |y| + z), turned by
45 degrees, fills a square whose border is the horizon. v_0 is read from the bits, bilinear between texel centres of a
face. The frame is `lobe_factors.axes_of`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.lights.prefiltered import place_on_cube
from relightcli.core.parts import in_parts
from relightcli.core.shade.lobe_factors import axes_of
from relightcli.core.shade.narrow import cube_texel

# Node spacing in standard deviations of the lobe, on the mean.
_SPACING = 1.75
_RINGS, _AZIMUTHS = 5, 8
# A lobe whose energy is at most this part of its material's greatest is left out.
_NEGLIGIBLE = 1e-4
_FAST = {"reassoc", "contract", "nsz"}


def table_side(degrees: float) -> int:
    """Nodes along a side of the table of one lobe."""
    sigma = math.radians(degrees) / 3.0
    return max(3, math.ceil(math.sqrt(2.0 * math.pi) / (_SPACING * sigma)) + 1)


def lobe_visibility(
    bits: NDArray[np.uint8], normals: NDArray[np.float32], degrees: Sequence[float], threads: int = 1
) -> tuple[NDArray[np.uint8], ...]:
    """Visible shares v_k times 255 of every lobe wider than 0 degrees, in order: (N, n, n) uint8, n = `table_side`.

    bits (N, 6, R, R/8); normals (N, 3) float32 unit. Each share is that of 40 directions of equal weight.
    """
    words = np.ascontiguousarray(bits).reshape(len(bits), -1)
    normals = np.ascontiguousarray(normals, np.float32)
    tables = []
    for degree in degrees:
        if degree == 0.0:
            continue
        n = table_side(degree)
        samples = _samples(n, math.radians(degree) / 3.0)
        table = np.empty((len(bits), n, n), np.uint8)

        def part(a: int, b: int, samples: NDArray[np.float32] = samples, table: NDArray[np.uint8] = table) -> None:
            _shares(words[a:b], normals[a:b], samples, bits.shape[2], table[a:b].reshape(b - a, -1))

        in_parts(part, len(bits), threads)
        tables.append(table)
    return tuple(tables)


def _samples(n: int, sigma: float) -> NDArray[np.float32]:
    """Directions (n n, 40, 3) that spread like the lobe about each node, less what bilinear look-up will add."""
    spacing = math.sqrt(2.0 * math.pi) / (n - 1)
    narrow = math.sqrt(sigma * sigma - spacing * spacing / 6.0)
    u, v = np.meshgrid(*[np.linspace(-1.0, 1.0, n)] * 2, indexing="ij")
    x, y = 0.5 * (u + v), 0.5 * (u - v)
    axis = np.stack([x, y, np.maximum(1.0 - abs(x) - abs(y), 0.0)], -1).reshape(-1, 3)
    axis /= np.sqrt((axis**2).sum(1, keepdims=True))
    away = np.where(abs(axis[:, 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    s = np.cross(away, axis)
    s /= np.sqrt((s**2).sum(1, keepdims=True))
    frame = np.stack([s, np.cross(axis, s), axis], 1)
    angle = narrow * np.sqrt(-2.0 * np.log((np.arange(_RINGS) + 0.5) / _RINGS))[:, None]
    turn = (np.arange(_AZIMUTHS) + 0.6180339887498949 * np.arange(_RINGS)[:, None]) * (2.0 * math.pi / _AZIMUTHS)
    angle = np.broadcast_to(angle, turn.shape)
    local = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], -1).reshape(-1, 3)
    return (local @ frame).astype(np.float32)


def add_lobes(
    bits: NDArray[np.uint8],
    tables: tuple[NDArray[np.uint8], ...],
    skies: tuple[NDArray[np.float32], ...],
    degrees: Sequence[float],
    views: NDArray[np.float32],
    normals: NDArray[np.float32],
    rows: NDArray[np.integer],
    energy: NDArray[np.float32],
    specular: NDArray[np.floating],
    out: NDArray[np.float32],
    threads: int = 1,
) -> None:
    """Adds to out[rows] the light of one material's lobes.

    bits (N, 6, R, R/8), read for the 0 degree lobe alone; tables: of `lobe_visibility`; skies: of `prefiltered_sky`;
    degrees of the lobes; views, normals (N, 3) float32 unit; rows (M,): receivers that have the material; energy
    (POLAR, L) of `direct_model.setting`; specular (3,); out (N, 3) float32. A lobe that the material hardly has is
    skipped.
    """
    words = np.ascontiguousarray(bits).reshape(len(bits), -1)
    ks = np.asarray(specular, np.float32)
    wide = iter(tables)
    of_lobe = [next(wide) if degree > 0.0 else None for degree in degrees]
    used = [k for k in range(len(degrees)) if energy[:, k].max() > _NEGLIGIBLE * energy.max()]
    strength = np.ascontiguousarray(energy.T)

    def part(a: int, b: int) -> None:
        mirror = np.empty((b - a, 6), np.float32)
        share = np.empty(b - a, np.float32)
        facing = np.empty(b - a, np.int64)
        facing = facing[: _mirrors(views, normals, rows[a:b], facing, mirror)]
        for k in used:
            table = of_lobe[k]
            if table is None:
                _share_of_bits(words, facing, bits.shape[2], mirror, share)
            else:
                _share_of_table(table, facing, mirror, share)
            _add_lobe(skies[k], facing, mirror, share, strength[k], ks, out)

    in_parts(part, len(rows), threads)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _shares(words, normals, samples, resolution, table):  # type: ignore[no-untyped-def]
    count = samples.shape[1]
    for i in range(len(words)):
        s, t, n = axes_of((normals[i, 0], normals[i, 1], normals[i, 2]))
        for m in range(len(samples)):
            seen = 0
            for q in range(count):
                x, y, z = samples[m, q, 0], samples[m, q, 1], samples[m, q, 2]
                if not z > np.float32(0.0):
                    continue
                face, row, column = cube_texel(
                    x * s[0] + y * t[0] + z * n[0],
                    x * s[1] + y * t[1] + z * n[1],
                    x * s[2] + y * t[2] + z * n[2],
                    resolution,
                )
                texel = (face * resolution + row) * resolution + column
                seen += (words[i, texel >> 3] >> np.uint8(texel & 7)) & np.uint8(1)
            table[i, m] = (255 * seen + count // 2) // count


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _open(words, i, texel):  # type: ignore[no-untyped-def]
    return np.float32((words[i, texel >> 3] >> np.uint8(texel & 7)) & np.uint8(1))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _mirrors(views, normals, rows, facing, mirror):  # type: ignore[no-untyped-def]
    """Number of the rows that face the viewer, first in `facing`. Of their mirror direction: x, y, z in the receiver's
    frame; face of the cube, and s and t on it."""
    two = np.float32(2.0)
    m = 0
    for i in rows:
        s, t, n = axes_of((normals[i, 0], normals[i, 1], normals[i, 2]))
        vx, vy, vz = views[i, 0], views[i, 1], views[i, 2]
        z = np.float32(n[0] * vx + n[1] * vy + n[2] * vz)
        if not z > np.float32(0.0):
            continue
        facing[m] = i
        mirror[m, 0] = -(s[0] * vx + s[1] * vy + s[2] * vz)
        mirror[m, 1] = -(t[0] * vx + t[1] * vy + t[2] * vz)
        mirror[m, 2] = z
        face, u, v = place_on_cube(two * z * n[0] - vx, two * z * n[1] - vy, two * z * n[2] - vz)
        mirror[m, 3], mirror[m, 4], mirror[m, 5] = face, u, v
        m += 1
    return m


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _share_of_table(table, rows, mirror, share):  # type: ignore[no-untyped-def]
    one, zero = np.float32(1.0), np.float32(0.0)
    center = np.float32(0.5) * np.float32(table.shape[1] - 1)
    top = np.float32(table.shape[1]) - np.float32(1.0001)
    for m in range(len(rows)):
        x, y, z = mirror[m, 0], mirror[m, 1], max(mirror[m, 2], zero)
        scale = center / (abs(x) + abs(y) + z)
        b = max(min((x + y) * scale + center, top), zero)
        c = max(min((x - y) * scale + center, top), zero)
        g, h = int(b), int(c)
        b, c = b - np.float32(g), c - np.float32(h)
        of = table[rows[m]]
        low = (one - c) * np.float32(of[g, h]) + c * np.float32(of[g, h + 1])
        high = (one - c) * np.float32(of[g + 1, h]) + c * np.float32(of[g + 1, h + 1])
        share[m] = np.float32(1.0 / 255.0) * (low + b * (high - low))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _share_of_bits(words, rows, resolution, mirror, share):  # type: ignore[no-untyped-def]
    one, half, zero = np.float32(1.0), np.float32(0.5), np.float32(0.0)
    size = np.float32(resolution)
    for m in range(len(rows)):
        b = max(min((mirror[m, 5] + one) * half * size - half, size - np.float32(1.001)), zero)
        c = max(min((mirror[m, 4] + one) * half * size - half, size - np.float32(1.001)), zero)
        g, h = int(b), int(c)
        b, c = b - np.float32(g), c - np.float32(h)
        texel = (int(mirror[m, 3]) * resolution + g) * resolution + h
        low = (one - c) * _open(words, rows[m], texel) + c * _open(words, rows[m], texel + 1)
        texel += resolution
        high = (one - c) * _open(words, rows[m], texel) + c * _open(words, rows[m], texel + 1)
        share[m] = low + b * (high - low)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _add_lobe(sky, rows, mirror, share, strength, specular, out):  # type: ignore[no-untyped-def]
    one, half, zero = np.float32(1.0), np.float32(0.5), np.float32(0.0)
    polar = np.float32(len(strength) - 1)
    nodes = np.float32(sky.shape[1] - 1)
    for m in range(len(rows)):
        z = mirror[m, 2]
        if not share[m] > zero:
            continue
        p = min(z, np.float32(0.99999)) * polar
        q = int(p)
        a = share[m] * (strength[q] + (p - np.float32(q)) * (strength[q + 1] - strength[q]))
        b = max(min((mirror[m, 5] + one) * half * nodes, nodes - np.float32(1e-3)), zero)
        c = max(min((mirror[m, 4] + one) * half * nodes, nodes - np.float32(1e-3)), zero)
        g, h = int(b), int(c)
        b, c = b - np.float32(g), c - np.float32(h)
        face = sky[int(mirror[m, 3])]
        w0, w1, w2, w3 = a * (one - b) * (one - c), a * (one - b) * c, a * b * (one - c), a * b * c
        e0, e1, e2, e3 = face[g, h], face[g, h + 1], face[g + 1, h], face[g + 1, h + 1]
        i = rows[m]
        out[i, 0] += specular[0] * (w0 * e0[0] + w1 * e1[0] + w2 * e2[0] + w3 * e3[0])
        out[i, 1] += specular[1] * (w0 * e0[1] + w1 * e1[1] + w2 * e2[1] + w3 * e3[1])
        out[i, 2] += specular[2] * (w0 * e0[2] + w1 * e1[2] + w2 * e2[2] + w3 * e3[2])
