"""Lobes as numbers that a linear model can predict, and back.

Per vertex: the mean (l = 0), then per lobe its zonal coefficients (l = 1 to n - 1) and two numbers for its axis. The
paper takes polar angles, which jump where phi wraps round and spin about the pole. The default is the logarithm of the
axis about the vertex's mean axis, weighted by the lobe's energy: it jumps only opposite to that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.pose.zh_lobes import Lobes, tangents

LOG, ANGLES = "log", "angles"


class Parameters(NamedTuple):
    """value (F, V, P) float32, P = 1 + c (n - 1) + 2 c: mean, zonal coefficients lobe by lobe, axes lobe by lobe;
    energy (F, V, c) float32 of the lobes' bands l >= 1; centre (V, c, 3) float64, the mean axes of logarithms."""

    value: NDArray[np.float32]
    energy: NDArray[np.float32]
    centre: NDArray[np.float64]


def parameters_of(lobes: Lobes, axes: str) -> Parameters:
    """The numbers of fitted lobes."""
    frames, vertices, count, bands = lobes.zonal.shape
    energy = (lobes.zonal.astype(np.float64) ** 2).sum(-1)
    # A breath of weight for lobes of no energy, which keep the axis they had.
    weighted = (energy + 1e-12)[..., None] * lobes.axis
    centre = weighted.sum(0)
    length = np.linalg.norm(centre, axis=-1, keepdims=True)
    first = lobes.axis[0].astype(np.float64)
    centre = np.where(length > 1e-9 * np.abs(weighted).sum(), centre / np.maximum(length, 1e-300), first)
    centre /= np.linalg.norm(centre, axis=-1, keepdims=True)
    value = np.empty((frames, vertices, 1 + count * (bands + 2)), np.float32)
    value[..., 0] = lobes.mean
    value[..., 1 : 1 + count * bands] = lobes.zonal.reshape(frames, vertices, -1)
    place = value[..., 1 + count * bands :].reshape(frames, vertices, count, 2)
    if axes == ANGLES:
        x, y, z = (lobes.axis[..., k].astype(np.float64) for k in range(3))
        # Not the arcus cosine: of a single precision z near 1 it tells 2e-4 radians and no less.
        place[..., 0] = np.arctan2(np.hypot(x, y), z)
        place[..., 1] = np.arctan2(y, x)
    else:
        across = tangents_of(centre)
        cosine = np.einsum("fvxn,vxn->fvx", lobes.axis, centre)
        flat = np.einsum("fvxn,vxkn->fvxk", lobes.axis, across)
        sine = np.linalg.norm(flat, axis=-1)
        place[...] = flat * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-12))[..., None]
    value[..., 1 + count * bands :] = place.reshape(frames, vertices, -1)
    return Parameters(value, energy.astype(np.float32), centre)


def lobes_of(value: NDArray[np.float32], centre: NDArray[np.float64], axes: str) -> Lobes:
    """The lobes of numbers (F, V, P)."""
    frames, vertices, size = value.shape
    count = centre.shape[1]
    bands = (size - 1) // count - 2
    zonal = np.ascontiguousarray(value[..., 1 : 1 + count * bands]).reshape(frames, vertices, count, bands)
    place = value[..., 1 + count * bands :].reshape(frames, vertices, count, 2).astype(np.float64)
    if axes == ANGLES:
        r = np.sin(place[..., 0])
        axis = np.stack(
            [r * np.cos(place[..., 1]), r * np.sin(place[..., 1]), np.cos(place[..., 0])],
            -1,
        )
    else:
        angle = np.linalg.norm(place, axis=-1, keepdims=True)
        flat = np.einsum("fvxk,vxkn->fvxn", place, tangents_of(centre))
        axis = np.cos(angle) * centre + np.sinc(angle / math.pi) * flat
    return Lobes(value[..., 0].copy(), axis.astype(np.float32), zonal)


def tangents_of(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two tangents (..., 2, 3) of unit axes (..., 3)."""
    flat = np.ascontiguousarray(axis, np.float64).reshape(-1, 3)
    out = np.empty((len(flat), 2, 3))
    _tangents_of(flat, out)
    return out.reshape(*axis.shape[:-1], 2, 3)


@njit(cache=True, error_model="numpy")
def _tangents_of(axis, out):  # type: ignore[no-untyped-def]
    tangents(axis, out)
