"""Direct light of adjustable glossy materials by precomputed transfer tensors. [Sun 2007, Eq. 3-4, sec. 4.1]

    B(w_o) = kd I0(K) + ks sum over k of W(w_o, k) I0(k),   I0(k) = sum over t of T(t, k) L(t),
    T(t, k) = V(t) U(k, w_t) (n.w_t)+ dOmega(t)

for the texels t of the sky cube, the K light factors U of a `DirectModel` and, as factor K, the diffuse 1/pi. W are the
view factors of a material (`direct_model.setting`), made when it is set; T knows nothing of the material.

T of a receiver is kept as Haar coefficients of T dOmega on the cube's faces, one set of indices for all factors: those
of the largest  area(c)^2 sum over k of (g(k) T(c, k))^2, area being that of the coefficient's support (`haar`) and g
the part that the factor takes in radiance (`LightFactors`). Ranked by area, light that is broad comes out best, as in
`haar.truncated_cosine_transfer`. Values are rounded to 8 bits, with one scale per receiver and factor.

Factors are orthogonal functions and so have either sign, and so have coefficients: nothing is cut off at 0 before all
parts of the picture are added up.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.direct_model import LightFactors
from relightcli.core.parts import in_parts
from relightcli.core.shade.lobe_factors import axes_of
from relightcli.core.sphere import cube, haar

KEEP = 96
# Order of sums is free, so that loops become vector instructions.
_FAST = {"reassoc", "contract", "nsz"}
_STEPS = 127.0


def direct_transfer(
    bits: NDArray[np.uint8],
    normals: NDArray[np.float32],
    factors: LightFactors,
    keep: int = KEEP,
    threads: int = 1,
) -> tuple[NDArray[np.integer[Any]], NDArray[np.float32], NDArray[np.int8]]:
    """Transfer of every receiver, ready for `direct_light`.

    bits (N, 6, R, R/8) uint8 visibility; normals (N, 3) float32 unit; keep: coefficients, at most 6 R R. Returns index
    (N, keep) rising, uint16 or for R > 64 int32; scale (N, K+1) float32; value (N, K+1, keep) int8: a coefficient is
    scale x value, sr sr^-1 = 1.
    """
    index, coefficients = direct_coefficients(bits, normals, factors, keep, threads)
    scale, value = quantise(coefficients)
    return index, scale, value


def direct_coefficients(
    bits: NDArray[np.uint8],
    normals: NDArray[np.float32],
    factors: LightFactors,
    keep: int = KEEP,
    threads: int = 1,
) -> tuple[NDArray[np.integer[Any]], NDArray[np.float32]]:
    """`direct_transfer` before rounding: index (N, keep), coefficients (N, K+1, keep) float32."""
    resolution = bits.shape[2]
    texels = 6 * resolution * resolution
    keep = min(keep, texels)
    words = np.ascontiguousarray(bits).reshape(len(bits), -1)
    normals = np.ascontiguousarray(normals, np.float32)
    directions = cube.texel_directions(resolution).reshape(-1, 3).astype(np.float32)
    solid_angle = cube.solid_angles(resolution).reshape(-1).astype(np.float32)
    area2 = haar.support_areas(resolution).reshape(-1) ** 2
    importance2 = factors.importance**2
    index = np.empty((len(bits), keep), np.uint16 if texels <= 1 << 16 else np.int32)
    value = np.empty((len(bits), factors.table.shape[2], keep), np.float32)

    def part(a: int, b: int) -> None:
        _transfer(
            words[a:b],
            normals[a:b],
            factors.table,
            directions,
            solid_angle,
            area2,
            importance2,
            resolution,
            index[a:b],
            value[a:b],
        )

    in_parts(part, len(bits), threads)
    return index, value


def quantise(coefficients: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
    """Scale (N, K+1) float32 and value (N, K+1, keep) int8 of coefficients (N, K+1, keep): the largest becomes 127."""
    scale = np.abs(coefficients).max(axis=2) / np.float32(_STEPS)
    steps = np.divide(coefficients, scale[..., None], out=np.zeros_like(coefficients), where=scale[..., None] > 0.0)
    return scale, np.rint(steps).astype(np.int8)


def direct_light(
    index: NDArray[np.integer[Any]],
    scale: NDArray[np.float32],
    value: NDArray[np.int8],
    light: NDArray[np.floating[Any]],
    out: NDArray[np.float32] | None = None,
    threads: int = 1,
) -> NDArray[np.float32]:
    """I0 (N, K+1, 3) float32, radiance times sr sr^-1, into `out` if given.

    index, scale, value: of `direct_transfer`; light (6 R R, 3): Haar coefficients of the sky's mean radiance per texel,
    haar.forward of (6, R, R) for every colour.
    """
    light = np.ascontiguousarray(light, np.float32)
    found = np.empty((*scale.shape, 3), np.float32) if out is None else out
    in_parts(lambda a, b: _direct_light(index[a:b], scale[a:b], value[a:b], light, found[a:b]), len(index), threads)
    return found


def light_coefficients(radiance: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """What `direct_light` takes for a sky: (6 R R, 3) float32, of radiance (6, R, R, 3)."""
    transformed = haar.forward(np.moveaxis(radiance, 3, 0))
    return np.ascontiguousarray(np.moveaxis(transformed, 0, 3).reshape(-1, 3), np.float32)


def shade_direct(
    incident: NDArray[np.float32],
    views: NDArray[np.float32],
    normals: NDArray[np.float32],
    rows: NDArray[np.integer[Any]],
    view_table: NDArray[np.float32],
    specular: NDArray[np.floating[Any]],
    albedo: NDArray[np.floating[Any]],
    out: NDArray[np.float32],
    threads: int = 1,
) -> None:
    """Sets out[rows] to the exit radiance of one material without its lobes; other rows stay. [Sun 2007, Eq. 3]

    incident (N, K+1, 3): I0; views, normals (N, 3) float32 unit; rows (M,): receivers that have the material;
    view_table (S, S, K+1) float32 of `direct_model.setting`; specular (3,); albedo (3,) or (N, 3); out (N, 3) float32.
    Where n.v is not above 0 it is 0. Truncation can make it negative; it is cut off at 0 after lobes are added.
    """
    colour = np.ascontiguousarray(np.atleast_2d(albedo), np.float32)
    ks = np.asarray(specular, np.float32)
    in_parts(
        lambda a, b: _shade(incident, views, normals, rows[a:b], view_table, ks, colour, out),
        len(rows),
        threads,
    )


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def place_on_disc(x, y, size):  # type: ignore[no-untyped-def]
    """Column, row and the parts to the next ones of a point of the unit disc among size x size cell centres."""
    top = np.float32(size) - np.float32(1.0001)
    half = np.float32(0.5) * np.float32(size)
    a = min(max((x + np.float32(1.0)) * half - np.float32(0.5), np.float32(0.0)), top)
    b = min(max((y + np.float32(1.0)) * half - np.float32(0.5), np.float32(0.0)), top)
    i, j = int(a), int(b)
    return i, j, a - np.float32(i), b - np.float32(j)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _transfer(words, normals, table, directions, solid_angle, area2, importance2, resolution, index, value):  # type: ignore[no-untyped-def]
    size, count = table.shape[0], table.shape[2]
    area = resolution * resolution
    faces = np.empty((6, resolution, resolution, count), np.float32)
    flat = faces.reshape(-1, count)
    scratch = np.empty((resolution, resolution, count), np.float32)
    keep = index.shape[1]
    heap = np.empty(keep, np.float32)
    chosen = np.empty(keep, np.int64)
    for i in range(len(words)):
        s, t, n = axes_of((normals[i, 0], normals[i, 1], normals[i, 2]))
        flat[:] = np.float32(0.0)
        for q in range(6 * area):
            if not (words[i, q >> 3] >> np.uint8(q & 7)) & np.uint8(1):
                continue
            dx, dy, dz = directions[q, 0], directions[q, 1], directions[q, 2]
            z = np.float32(n[0] * dx + n[1] * dy + n[2] * dz)
            if not z > np.float32(0.0):
                continue
            x = np.float32(s[0] * dx + s[1] * dy + s[2] * dz)
            y = np.float32(t[0] * dx + t[1] * dy + t[2] * dz)
            a, b, fa, fb = place_on_disc(x, y, size)
            weight = z * solid_angle[q % area]
            w1 = weight * fa * fb
            w2 = weight * fa - w1
            w3 = weight * fb - w1
            w0 = weight - w1 - w2 - w3
            c00, c01, c10, c11 = table[a, b], table[a, b + 1], table[a + 1, b], table[a + 1, b + 1]
            to = flat[q]
            for k in range(count):
                to[k] = w0 * c00[k] + w3 * c01[k] + w2 * c10[k] + w1 * c11[k]
        for f in range(6):
            _transform(faces[f], scratch, resolution, count)
        # The `keep` largest, in a heap whose top is the least of them.
        for q in range(6 * area):
            row = flat[q]
            total = np.float32(0.0)
            for k in range(count):
                total += importance2[k] * row[k] * row[k]
            total *= area2[q % area]
            if q < keep:
                heap[q], chosen[q] = total, q
                if q == keep - 1:
                    for h in range(keep // 2, -1, -1):
                        _sift(heap, chosen, h)
            elif total > heap[0]:
                heap[0], chosen[0] = total, q
                _sift(heap, chosen, 0)
        chosen.sort()
        for j in range(keep):
            index[i, j] = chosen[j]
            for k in range(count):
                value[i, k, j] = flat[chosen[j], k]


@njit(cache=True, nogil=True, error_model="numpy")
def _sift(heap, chosen, at):  # type: ignore[no-untyped-def]
    keep = len(heap)
    while True:
        least = at
        for child in (2 * at + 1, 2 * at + 2):
            if child < keep and heap[child] < heap[least]:
                least = child
        if least == at:
            return
        heap[at], heap[least] = heap[least], heap[at]
        chosen[at], chosen[least] = chosen[least], chosen[at]
        at = least


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _transform(face, scratch, resolution, count):  # type: ignore[no-untyped-def]
    """Haar coefficients of a face (R, R, K+1), in place; as `haar.forward`."""
    size = resolution
    half_value = np.float32(0.5)
    while size > 1:
        half = size // 2
        for i in range(half):
            for j in range(half):
                a, b = face[2 * i, 2 * j], face[2 * i, 2 * j + 1]
                c, d = face[2 * i + 1, 2 * j], face[2 * i + 1, 2 * j + 1]
                s0, s1 = scratch[i, j], scratch[i, half + j]
                s2, s3 = scratch[half + i, j], scratch[half + i, half + j]
                for k in range(count):
                    up, down = a[k] + b[k], c[k] + d[k]
                    across_up, across_down = a[k] - b[k], c[k] - d[k]
                    s0[k] = half_value * (up + down)
                    s1[k] = half_value * (across_up + across_down)
                    s2[k] = half_value * (up - down)
                    s3[k] = half_value * (across_up - across_down)
        face[:size, :size] = scratch[:size, :size]
        size = half


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _direct_light(index, scale, value, light, out):  # type: ignore[no-untyped-def]
    keep, count = index.shape[1], value.shape[1]
    red, green, blue = np.empty(keep, np.float32), np.empty(keep, np.float32), np.empty(keep, np.float32)
    for i in range(len(index)):
        for j in range(keep):
            t = index[i, j]
            red[j], green[j], blue[j] = light[t, 0], light[t, 1], light[t, 2]
        for k in range(0, count, 2):  # two factors share what is loaded of the light; a last one goes twice
            m = min(k + 1, count - 1)
            one, two = value[i, k], value[i, m]
            r = g = b = x = y = z = np.float32(0.0)
            for j in range(keep):
                v, w = np.float32(one[j]), np.float32(two[j])
                r += v * red[j]
                g += v * green[j]
                b += v * blue[j]
                x += w * red[j]
                y += w * green[j]
                z += w * blue[j]
            out[i, k, 0], out[i, k, 1], out[i, k, 2] = scale[i, k] * r, scale[i, k] * g, scale[i, k] * b
            out[i, m, 0], out[i, m, 1], out[i, m, 2] = scale[i, m] * x, scale[i, m] * y, scale[i, m] * z


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _shade(incident, views, normals, rows, view_table, specular, albedo, out):  # type: ignore[no-untyped-def]
    count = view_table.shape[2]
    one = np.float32(1.0)
    center = np.float32(0.5) * np.float32(view_table.shape[0] - 1)
    top = np.float32(view_table.shape[0]) - np.float32(1.0001)
    textured = len(albedo) > 1
    for m in range(len(rows)):
        i = rows[m]
        s, t, n = axes_of((normals[i, 0], normals[i, 1], normals[i, 2]))
        vx, vy, vz = views[i, 0], views[i, 1], views[i, 2]
        z = np.float32(n[0] * vx + n[1] * vy + n[2] * vz)
        if not z > np.float32(0.0):
            out[i] = np.float32(0.0)
            continue
        scale = center / np.float32(math.sqrt(one + z))
        fa = np.float32(s[0] * vx + s[1] * vy + s[2] * vz) * scale + center
        fb = np.float32(t[0] * vx + t[1] * vy + t[2] * vz) * scale + center
        fa = min(max(fa, np.float32(0.0)), top)
        fb = min(max(fb, np.float32(0.0)), top)
        a, b = int(fa), int(fb)
        fa, fb = fa - np.float32(a), fb - np.float32(b)
        c00, c01, c10, c11 = view_table[a, b], view_table[a, b + 1], view_table[a + 1, b], view_table[a + 1, b + 1]
        red = green = blue = np.float32(0.0)
        for k in range(count):
            w = (one - fa) * ((one - fb) * c00[k] + fb * c01[k]) + fa * ((one - fb) * c10[k] + fb * c11[k])
            red += w * incident[i, k, 0]
            green += w * incident[i, k, 1]
            blue += w * incident[i, k, 2]
        p = i if textured else 0
        out[i, 0] = specular[0] * red + albedo[p, 0] * incident[i, count - 1, 0]
        out[i, 1] = specular[1] * green + albedo[p, 1] * incident[i, count - 1, 1]
        out[i, 2] = specular[2] * blue + albedo[p, 2] * incident[i, count - 1, 2]
