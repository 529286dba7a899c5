"""Exit radiance under local lights, from the visibility bits of `transport.light_visibility`."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import MaterialTable, dot, lobes_and_density
from relightcli.core.parts import in_parts
from relightcli.core.sphere.lattice import r2_point
from relightcli.core.transport.light_visibility import point_count
from relightcli.core.transport.local_lights import LocalLights, sample_light


def local_radiance(
    bits: NDArray[np.uint8],
    lights: LocalLights,
    positions: NDArray[np.float64],
    normals: NDArray[np.float32],
    views: NDArray[np.float32] | None,
    material: NDArray[np.int32],
    table: MaterialTable,
    active: NDArray[np.bool_],
    threads: int = 1,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(irradiance, specular integral without its colour), each (N, 3) float32.

    E = mean over the points of V L (n.l) / density, and the same with the specular lobe. bits (N, points / 8);
    positions, normals, views (N, 3); material (N,) rows of `table`; receivers that are not `active` get 0. Without
    views the specular integral is 0.
    """
    irradiance = np.zeros((len(bits), 3), np.float32)
    specular = np.zeros((len(bits), 3), np.float32)
    towards = np.zeros((len(bits), 3), np.float32) if views is None else views

    def part(a: int, b: int) -> None:
        _sum_points(
            bits[a:b],
            lights,
            positions[a:b],
            normals[a:b].astype(np.float64),
            towards[a:b].astype(np.float64),
            material[a:b],
            table.model,
            table.parameters,
            active[a:b],
            point_count(lights),
            irradiance[a:b],
            specular[a:b],
        )

    in_parts(part, len(bits), threads)
    return irradiance, specular


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_points(  # type: ignore[no-untyped-def]
    bits, lights, positions, normals, views, material, models, parameters, active, points, irradiance, specular
):
    for i in range(len(bits)):
        if not active[i]:
            continue
        p = (positions[i, 0], positions[i, 1], positions[i, 2])
        n = (normals[i, 0], normals[i, 1], normals[i, 2])
        v = (views[i, 0], views[i, 1], views[i, 2])
        model, row = models[material[i]], parameters[material[i]]
        for k in range(points):
            if not (bits[i, k >> 3] >> np.uint8(k & 7)) & np.uint8(1):
                continue
            u1, u2 = r2_point(k)
            d, _, radiance, density = sample_light(lights, p, u1, u2)
            weight = dot(n, d) / (density * points)
            _, s, _, _ = lobes_and_density(model, row, n, d, v)
            s /= density * points
            for c in range(3):
                irradiance[i, c] += weight * radiance[c]
                specular[i, c] += s * radiance[c]
