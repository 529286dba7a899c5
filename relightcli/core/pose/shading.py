"""Vertices of a pose, from the model of their visibility to their exit radiance. [Nowrouzezahrai 2008, sec. 4.3]

    numbers = intercept + slope . scores            the pose's lobes, or coefficients, in the vertex's frame
    v       = sum of lobes about axes in the world  no rotation of harmonics: axes turn with the frame
    shade   = sum over k, j of y_k(R) T_kj v_j       light and kernel multiplied in (`phong_operator.lighting_matrix`)

in one pass over the vertices, about R = the normal for diffuse light and R = the mirrored view for phong. There is one
T for a kernel and a light, so that a vertex costs the harmonics of R and one small matrix product. Bands that a kernel
lacks (lambert's odd ones from 3) are left out of it.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.parts import in_parts
from relightcli.core.pose.lobe_parameters import ANGLES, LOG, tangents_of
from relightcli.core.pose.phong_operator import lighting_matrix
from relightcli.core.pose.zh_lobes import unit_harmonics, unit_norms
from relightcli.core.sphere import sh

F32 = NDArray[np.float32]
_LOG, _ANGLES, _COEFFICIENTS = range(3)
_CODES = {LOG: _LOG, ANGLES: _ANGLES, "": _COEFFICIENTS}


class Synthesis(NamedTuple):
    """A model as the kernel reads it. intercept (V, P), scale (V, P) float32 and code (V, P, K) int8: slope = scale
    code; axes (V, c, 3, 3) float32, per lobe the mean axis and its two tangents, c = 0 for coefficients; kind: what
    the last numbers are; order: bands."""

    intercept: F32
    scale: F32
    code: NDArray[np.int8]
    axes: F32
    kind: int
    order: int


def synthesis(intercept: F32, scale: F32, code: NDArray[np.int8], centre: F32, axes: str, order: int) -> Synthesis:
    """From a stored model; centre (V, c, 3), c = 0 for models of coefficients."""
    count = centre.shape[1]
    own = np.zeros((len(centre), count, 3, 3), np.float32)
    if count:
        unit = centre.astype(np.float64)
        unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
        own[:, :, 0] = unit
        own[:, :, 1:] = tangents_of(unit)
    kind = _CODES[axes if count else ""]
    return Synthesis(
        np.ascontiguousarray(intercept),
        np.ascontiguousarray(scale),
        np.ascontiguousarray(code),
        own,
        kind,
        order,
    )


def part_of(model: Synthesis, rows: slice) -> Synthesis:
    """The model of some of its vertices."""
    return model._replace(
        intercept=model.intercept[rows], scale=model.scale[rows], code=model.code[rows], axes=model.axes[rows]
    )


class Lighting(NamedTuple):
    """A kernel under a light: band (B,) int64, the bands it has; table (rows, 3, n^2) float32, 2 l + 1 rows a band."""

    band: NDArray[np.int64]
    table: F32


def lighting(kappa: NDArray[np.float64], light: NDArray[np.float64], order: int) -> Lighting:
    """kappa (B,) of the kernel, light (S, 3) in the world's frame, order n of visibility.

    B = 2 n - 1 is all that n bands of light and visibility have; more bands of light cost nothing here, and count up to
    B + n - 1.
    """
    table = lighting_matrix(kappa, light, order)  # (bands^2, n^2, 3)
    band = np.flatnonzero(kappa != 0.0)
    # The kernel evaluates harmonics of unit length per band.
    rows = [table[b * b : (b + 1) * (b + 1)] * math.sqrt((2 * b + 1) / (4.0 * math.pi)) for b in band]
    whole = np.concatenate(rows) if rows else np.zeros((0, order * order, 3))
    return Lighting(band.astype(np.int64), np.ascontiguousarray(np.moveaxis(whole, 2, 1), np.float32))


def shade(
    model: Synthesis,
    scores: NDArray[np.float64],
    frames: F32,
    axis: F32,
    kernel: NDArray[np.int32],
    lights: list[Lighting],
    threads: int = 1,
) -> F32:
    """Exit radiance (V, 3) float32 of vertices for kernels of unit colour; not negative.

    scores (K,) of the pose; frames (V, 3, 3) float32, rows tangent, normal x tangent, normal, in the world; axis
    (V, 3): the kernel's axis R; kernel (V,): which of `lights`, -1 for none (0 comes out).
    """
    out = np.zeros((len(frames), 3), np.float32)
    samples, inverse = _rotation_samples(model.order)
    bands = np.concatenate([light.band for light in lights])
    norms = unit_norms(max(model.order, int(bands.max(initial=0)) + 1))
    start = np.cumsum([0, *(len(light.band) for light in lights)])
    table = np.concatenate([light.table for light in lights])
    first = np.cumsum([0, *(len(light.table) for light in lights)])
    score = np.ascontiguousarray(scores, np.float32)

    def part(a: int, b: int) -> None:
        _shade(
            model, score, frames, axis, kernel, bands, start, table, first, norms, samples, inverse, a, b, out
        )  # fmt: skip

    in_parts(part, len(frames), threads)
    return out


def visibility(model: Synthesis, scores: NDArray[np.float64], frames: F32) -> F32:
    """Visibility (V, n^2) float32 of a pose in the world's frame."""
    out = np.empty((len(frames), model.order**2), np.float32)
    norms = unit_norms(model.order)
    samples, inverse = _rotation_samples(model.order)
    _visibility(model, np.ascontiguousarray(scores, np.float32), frames, norms, samples, inverse, out)
    return out


@lru_cache(maxsize=4)
def _rotation_samples(order: int) -> tuple[F32, F32]:
    """Directions (2 n, 3) at which a turned function is read, and per band the map back (n, 2 n - 1, 2 n) to its
    coefficients over their length."""
    k = np.arange(2 * order) + 0.5
    z, phi = 1.0 - k / order, math.pi * (1.0 + math.sqrt(5.0)) * k
    z *= 0.97
    r = np.sqrt(1.0 - z * z)
    directions = np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)
    y = sh.harmonics(directions, order)
    inverse = np.zeros((order, 2 * order - 1, 2 * order))
    for band in range(order):
        inverse[band, : 2 * band + 1] = np.linalg.pinv(y[:, band * band : (band + 1) ** 2])
        inverse[band] *= math.sqrt((2 * band + 1) / (4.0 * math.pi))
    return directions.astype(np.float32), inverse.astype(np.float32)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz", "arcp"})
def _synthesize(model, score, frame, i, norms, samples, inverse, number, u, v):  # type: ignore[no-untyped-def]
    """v (n^2,) of vertex i in the world. number (P,) and u are room."""
    order, size = model.order, model.order * model.order
    for p in range(len(number)):
        total = np.float32(0.0)
        for k in range(len(score)):
            total += np.float32(model.code[i, p, k]) * score[k]
        number[p] = model.intercept[i, p] + model.scale[i, p] * total
    own = norms[:order, :order]
    if model.kind == _COEFFICIENTS:
        v[:] = np.float32(0.0)
        for q in range(len(samples)):
            a, b, c = samples[q]
            x = frame[0, 0] * a + frame[0, 1] * b + frame[0, 2] * c
            y = frame[1, 0] * a + frame[1, 1] * b + frame[1, 2] * c
            z = frame[2, 0] * a + frame[2, 1] * b + frame[2, 2] * c
            unit_harmonics(x, y, z, own, u)
            for band in range(order):
                value = np.float32(0.0)
                for m in range(band * band, (band + 1) * (band + 1)):
                    value += number[m] * u[m]
                for m in range(2 * band + 1):
                    v[band * band + m] += inverse[band, m, q] * value
        return
    count, bands = model.axes.shape[1], order - 1
    v[0] = number[0]
    for k in range(1, size):
        v[k] = np.float32(0.0)
    for lobe in range(count):
        a, b = number[1 + count * bands + 2 * lobe], number[2 + count * bands + 2 * lobe]
        if model.kind == _ANGLES:
            r = math.sin(a)
            x, y, z = r * math.cos(b), r * math.sin(b), math.cos(a)
        else:
            angle = math.sqrt(a * a + b * b)
            c = math.cos(angle)
            s = math.sin(angle) / angle if angle > np.float32(1e-6) else np.float32(1.0)
            a, b = a * s, b * s
            axes = model.axes[i, lobe]
            x = c * axes[0, 0] + a * axes[1, 0] + b * axes[2, 0]
            y = c * axes[0, 1] + a * axes[1, 1] + b * axes[2, 1]
            z = c * axes[0, 2] + a * axes[1, 2] + b * axes[2, 2]
        wx = frame[0, 0] * x + frame[1, 0] * y + frame[2, 0] * z
        wy = frame[0, 1] * x + frame[1, 1] * y + frame[2, 1] * z
        wz = frame[0, 2] * x + frame[1, 2] * y + frame[2, 2] * z
        unit_harmonics(wx, wy, wz, own, u)
        for band in range(1, order):
            zonal = number[1 + lobe * bands + band - 1]
            for k in range(band * band, (band + 1) * (band + 1)):
                v[k] += zonal * u[k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz", "arcp"})
def _shade(model, score, frames, axis, kernel, bands, start, table, first, norms, samples, inverse, begin, end, out):  # type: ignore[no-untyped-def]
    size = model.order * model.order
    number, v = np.empty(model.intercept.shape[1], np.float32), np.empty(size, np.float32)
    u = np.empty(norms.shape[0] * norms.shape[0], np.float32)
    lit = np.empty(3 * size, np.float32)
    rows = table.reshape(len(table), -1)
    for i in range(begin, end):
        g = kernel[i]
        if g < 0:
            continue
        _synthesize(model, score, frames[i], i, norms, samples, inverse, number, u, v)
        unit_harmonics(axis[i, 0], axis[i, 1], axis[i, 2], norms, u)
        lit[:] = np.float32(0.0)
        at = first[g]
        for n in range(start[g], start[g + 1]):
            band = bands[n]
            for k in range(band * band, (band + 1) * (band + 1)):
                w = u[k]
                row = rows[at]
                for j in range(3 * size):
                    lit[j] += w * row[j]
                at += 1
        for c in range(3):
            total = np.float32(0.0)
            for j in range(size):
                total += lit[c * size + j] * v[j]
            out[i, c] = max(total, np.float32(0.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _visibility(model, score, frames, norms, samples, inverse, out):  # type: ignore[no-untyped-def]
    number = np.empty(model.intercept.shape[1], np.float32)
    u = np.empty(norms.shape[0] * norms.shape[0], np.float32)
    for i in range(len(frames)):
        _synthesize(model, score, frames[i], i, norms, samples, inverse, number, u, out[i])
