"""Orthonormal two-dimensional Haar wavelets on the faces of a cube, and their truncation.

A face of R x R texels (R a power of two) becomes R^2 coefficients in the usual nested layout: the mean times R at
(0, 0), the details of level j (0 coarsest) in the quadrants of the leading 2^(j+1) x 2^(j+1) block. The transform is
orthonormal, so that dot products of texels are dot products of coefficients.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


def forward(faces: NDArray[np.floating]) -> NDArray[np.float64]:
    """Haar coefficients of faces (..., R, R), float64."""
    out = np.array(faces, np.float64, order="C")
    size = out.shape[-1]
    _forward(out.reshape(-1, size, size), np.empty((size, size)))
    return out


@njit(cache=True, nogil=True)
def _forward(faces, scratch):  # type: ignore[no-untyped-def]
    for face in faces:
        size = len(scratch)
        while size > 1:
            half = size // 2
            for i in range(half):
                for j in range(half):
                    a, b = face[2 * i, 2 * j], face[2 * i, 2 * j + 1]
                    c, d = face[2 * i + 1, 2 * j], face[2 * i + 1, 2 * j + 1]
                    scratch[i, j], scratch[i, half + j] = 0.5 * (a + b + c + d), 0.5 * (a - b + c - d)
                    scratch[half + i, j], scratch[half + i, half + j] = 0.5 * (a + b - c - d), 0.5 * (a - b - c + d)
            face[:size, :size] = scratch[:size, :size]
            size = half


def inverse(coefficients: NDArray[np.floating]) -> NDArray[np.float64]:
    """Texels of the faces (..., R, R) from their coefficients."""
    out = np.array(coefficients, np.float64)
    size = 2
    while size <= out.shape[-1]:
        half = size // 2
        s, x = out[..., :half, :half].copy(), out[..., :half, half:size].copy()
        y, z = out[..., half:size, :half].copy(), out[..., half:size, half:size].copy()
        out[..., 0:size:2, 0:size:2] = 0.5 * (s + x + y + z)
        out[..., 0:size:2, 1:size:2] = 0.5 * (s - x + y - z)
        out[..., 1:size:2, 0:size:2] = 0.5 * (s + x - y - z)
        out[..., 1:size:2, 1:size:2] = 0.5 * (s - x - y + z)
        size *= 2
    return out


def support_areas(resolution: int) -> NDArray[np.float32]:
    """Side by side area, in texels, of the support of every coefficient of a face, (R, R) float32."""
    index = np.arange(resolution)
    level = np.frexp(np.maximum(index, 1))[1] - 1  # floor(log2 i), 0 for i = 0
    coarse = np.maximum(level[:, None], level[None, :])
    return ((resolution / 2.0**coarse) ** 2).astype(np.float32)


def truncated_cosine_transfer(
    bits: NDArray[np.uint8],
    normals: NDArray[np.float32],
    directions: NDArray[np.float32],
    solid_angle: NDArray[np.float32],
    count: int,
    tolerance: float = 0.0,
    by_area: bool = True,
) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float64]]:
    """The `count` strongest Haar coefficients of V(w) (n . w)+ dOmega / pi per receiver.

    bits (N, 6, R, R/8); normals (N, 3); directions (6 R R, 3) and solid_angle (R R,) of the texels. Coefficients are
    ranked by magnitude times the area of their support (`by_area`), which favours broad light, or by magnitude alone,
    which is the best choice in the sense of least squares. [Ng 2003, section 4.2]
    With a tolerance above 0, the weakest of them are left out as long as the relative RMS of what is dropped,
    ||T - T^|| / ||T||, stays under it; they come back as index 0 with value 0.
    Returns indices (N, count) into the 6 R R coefficients, strongest first; values (N, count); and the share of the
    squared norm that was dropped, (N,), in 0..1.
    """
    resolution = bits.shape[2]
    words = np.ascontiguousarray(bits).reshape(len(bits), -1).view(np.uint64)
    weight = support_areas(resolution).reshape(-1) if by_area else np.ones(resolution * resolution, np.float32)
    index = np.empty((len(bits), count), np.int32)
    value = np.empty((len(bits), count), np.float32)
    dropped = np.empty(len(bits), np.float64)
    _truncate(
        words,
        np.ascontiguousarray(normals, np.float32),
        directions,
        solid_angle,
        weight,
        resolution,
        index,
        value,
        dropped,
        tolerance * tolerance,
    )
    return index, value, dropped


@njit(cache=True, nogil=True)
def _transform(face, scratch, resolution):  # type: ignore[no-untyped-def]
    size = resolution
    half_value = np.float32(0.5)
    while size > 1:
        half = size // 2
        for i in range(half):
            for j in range(half):
                a, b = face[2 * i, 2 * j], face[2 * i, 2 * j + 1]
                c, d = face[2 * i + 1, 2 * j], face[2 * i + 1, 2 * j + 1]
                scratch[i, j] = half_value * (a + b + c + d)
                scratch[i, half + j] = half_value * (a - b + c - d)
                scratch[half + i, j] = half_value * (a + b - c - d)
                scratch[half + i, half + j] = half_value * (a - b - c + d)
        face[:size, :size] = scratch[:size, :size]
        size = half


@njit(cache=True, nogil=True)
def _truncate(words, normals, directions, solid_angle, weight, resolution, index, value, dropped, share):  # type: ignore[no-untyped-def]
    area = resolution * resolution
    faces = np.empty((6, resolution, resolution), np.float32)
    scratch = np.empty((resolution, resolution), np.float32)
    flat = faces.reshape(-1)
    rank = np.empty(6 * area, np.float32)
    count = index.shape[1]
    chosen = np.empty(count, np.int64)
    inv_pi = np.float32(0.3183098861837907)
    for i in range(len(words)):
        for t in range(6 * area):
            v = np.float32(0.0)
            if (words[i, t >> 6] >> np.uint64(t & 63)) & np.uint64(1):
                v = (
                    normals[i, 0] * directions[t, 0]
                    + normals[i, 1] * directions[t, 1]
                    + normals[i, 2] * directions[t, 2]
                )
                v *= solid_angle[t % area] * inv_pi
            flat[t] = v
        for f in range(6):
            _transform(faces[f], scratch, resolution)
        total = 0.0
        for t in range(6 * area):
            rank[t] = abs(flat[t]) * weight[t % area]
            total += np.float64(flat[t]) * np.float64(flat[t])
        threshold = np.partition(rank, 6 * area - count)[6 * area - count]
        # Everything above the threshold, then ties in index order until `count` are chosen.
        ties = count
        for t in range(6 * area):
            if rank[t] > threshold:
                ties -= 1
        k = 0
        for t in range(6 * area):
            if rank[t] > threshold or (rank[t] == threshold and ties > 0):
                if rank[t] == threshold:
                    ties -= 1
                chosen[k] = t
                k += 1
        order = np.argsort(-rank[chosen], kind="mergesort")
        kept, left = 0.0, 0.0
        for k in range(count):
            t = chosen[order[k]]
            if kept >= (1.0 - share) * total and share > 0.0:
                index[i, k], value[i, k] = 0, 0.0
                continue
            index[i, k], value[i, k] = t, flat[t]
            kept += np.float64(flat[t]) * np.float64(flat[t])
            flat[t] = np.float32(0.0)
        # Summed by itself: as 1 - kept / total a share below 1e-16 would come out as nothing.
        for t in range(6 * area):
            left += np.float64(flat[t]) * np.float64(flat[t])
        dropped[i] = left / total if total > 0.0 else 0.0


@njit(cache=True, nogil=True)
def gather(index, value, light):  # type: ignore[no-untyped-def]
    """Dot products of truncated transfer (N, K) with a sky's coefficients: index into light (6 R R, 3), to (N, 3)."""
    out = np.zeros((len(index), 3), np.float32)
    for i in range(len(index)):
        r = g = b = 0.0
        for k in range(index.shape[1]):
            t, v = index[i, k], value[i, k]
            r += v * light[t, 0]
            g += v * light[t, 1]
            b += v * light[t, 2]
        out[i, 0], out[i, 1], out[i, 2] = r, g, b
    return out
