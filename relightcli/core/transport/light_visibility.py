"""Which points of the local lights every receiver sees: one bit per point of a fixed set.

Point k of a receiver is `sample_light` at point k of the R2 sequence: the same for every run, so that bits alone need
to be kept. A bit is 1 where the point is above the horizon, emits towards the receiver, and nothing lies between.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import dot
from relightcli.core.sphere.lattice import r2_point
from relightcli.core.transport.local_lights import LocalLights, sample_light
from relightcli.core.transport.tracer import Tracer

POINTS_PER_LIGHT = 128
SHORTENED = 1.0 - 1e-4  # rays end before their light: what touches it from behind must not block it


def point_count(lights: LocalLights) -> int:
    """Points per receiver, over all lights together."""
    return POINTS_PER_LIGHT * lights.number


def light_bits(
    tracer: Tracer | None,
    lights: LocalLights,
    positions: NDArray[np.float64],
    normals: NDArray[np.float32],
) -> tuple[NDArray[np.uint8], int]:
    """Bits (N, points / 8) uint8, little bit order, and the number of rays. Without a tracer nothing blocks."""
    n, points = len(positions), point_count(lights)
    open_points = np.zeros((n, points), np.bool_)
    if tracer is None:
        _points(lights, positions, normals.astype(np.float64), points, open_points)
        return np.packbits(open_points, axis=1, bitorder="little"), 0
    rays = 0
    step = max(1, 1_000_000 // points)
    for start in range(0, n, step):
        rows = slice(start, min(start + step, n))
        local = positions[rows]
        directions, distances = _points(lights, local, normals[rows].astype(np.float64), points, open_points[rows])
        owner, _ = np.nonzero(open_points[rows])
        blocked = tracer.occluded(
            tracer.offset(local, normals[rows])[owner],
            directions,
            (distances * (tracer.scale * SHORTENED)).astype(np.float32),
        )
        open_points[rows][open_points[rows]] = ~blocked
        rays += len(owner)
    return np.packbits(open_points, axis=1, bitorder="little"), rays


@njit(cache=True, nogil=True, error_model="numpy")
def _points(lights, positions, normals, points, usable):  # type: ignore[no-untyped-def]
    """Marks usable points; returns directions (M, 3) float32 and distances (M,) of those, receiver by receiver."""
    directions = np.empty((len(positions) * points, 3), np.float32)
    distances = np.empty(len(positions) * points)
    count = 0
    for i in range(len(positions)):
        p = (positions[i, 0], positions[i, 1], positions[i, 2])
        n = (normals[i, 0], normals[i, 1], normals[i, 2])
        for k in range(points):
            u1, u2 = r2_point(k)
            d, distance, _, density = sample_light(lights, p, u1, u2)
            usable[i, k] = density > 0.0 and dot(n, d) > 0.0
            if usable[i, k]:
                for x in range(3):
                    directions[count, x] = d[x]
                distances[count] = distance
                count += 1
    return directions[:count].copy(), distances[:count].copy()
