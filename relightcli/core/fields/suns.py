"""Light of suns with shadows as sharp as rays make them: small bright places that were taken out of the sky.

    E = sum over points of flux V (n . l),     S = sum of flux V s(l, v)

s the specular lobe without its colour, cosine included; V from rays. A ray can only meet a ball if the ball's centre
lies within its radius of the ray, ahead of it or around its origin: other receivers need none.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import MaterialTable, dot, lobes_and_density
from relightcli.core.lights.points import Points
from relightcli.core.shade.gather import in_parts


def may_meet(
    positions: NDArray[np.float64],
    directions: NDArray[np.float64],
    center: NDArray[np.float64],
    radius: float,
    open_: NDArray[np.bool_],
    threads: int = 1,
) -> NDArray[np.bool_]:
    """Which of the rays that are still open (n, K), from positions (n, 3) in directions (K, 3), may meet a ball."""
    out = np.zeros(open_.shape, np.bool_)
    p = np.ascontiguousarray(positions, np.float64)
    in_parts(lambda a, b: _may_meet(p[a:b], directions, center, radius, open_[a:b], out[a:b]), len(p), threads)
    return out


@njit(cache=True, nogil=True)
def _may_meet(positions, directions, center, radius, open_, out):  # type: ignore[no-untyped-def]
    for i in range(len(positions)):
        x, y, z = center[0] - positions[i, 0], center[1] - positions[i, 1], center[2] - positions[i, 2]
        far2 = x * x + y * y + z * z
        for k in range(len(directions)):
            if open_[i, k]:
                along = x * directions[k, 0] + y * directions[k, 1] + z * directions[k, 2]
                inside = far2 <= radius * radius
                out[i, k] = inside or (along > 0.0 and far2 - along * along <= radius * radius)


def sun_light(
    seen: NDArray[np.bool_],
    points: Points,
    normals: NDArray[np.float32],
    views: NDArray[np.float32] | None,
    material: NDArray[np.int32],
    table: MaterialTable,
    threads: int = 1,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """E and S, (n, 3) float32 each, of receivers that see points as seen (n, K) says, from their front only; normals,
    views (n, 3), material (n,) rows of the table. Without views S is 0."""
    irradiance, specular = np.zeros((len(seen), 3), np.float32), np.zeros((len(seen), 3), np.float32)
    towards = np.zeros((len(seen), 3), np.float32) if views is None else views

    def part(a: int, b: int) -> None:
        _sun_light(
            seen[a:b],
            points.direction,
            points.flux,
            normals[a:b].astype(np.float64),
            towards[a:b].astype(np.float64),
            material[a:b],
            table.model,
            table.parameters,
            irradiance[a:b],
            specular[a:b],
        )

    in_parts(part, len(seen), threads)
    return irradiance, specular


@njit(cache=True, nogil=True, error_model="numpy")
def _sun_light(  # type: ignore[no-untyped-def]
    seen, directions, flux, normals, views, material, models, parameters, irradiance, specular
):
    for i in range(len(seen)):
        n = (normals[i, 0], normals[i, 1], normals[i, 2])
        v = (views[i, 0], views[i, 1], views[i, 2])
        model, row = models[material[i]], parameters[material[i]]
        for k in range(len(directions)):
            if not seen[i, k]:
                continue
            d = (directions[k, 0], directions[k, 1], directions[k, 2])
            cosine = max(dot(n, d), 0.0)
            _, s, _, _ = lobes_and_density(model, row, n, d, v)
            for c in range(3):
                irradiance[i, c] += cosine * flux[k, c]
                specular[i, c] += s * flux[k, c]
