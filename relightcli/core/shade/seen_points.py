"""Light of points on the sky, each seen by some receivers: a small sun's irradiance and highlights.

    E_i = sum over k of v_ik F_k (n_i . w_k)+        L_i = sum over k of v_ik F_k S(w_k, view)

with S the specular lobe times the cosine, without its colour (`brdf.models`).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import MaterialTable, lobes_and_density
from relightcli.core.lights.points import Points
from relightcli.core.parts import in_parts

Seen = NDArray[np.bool_] | NDArray[np.float32]


def point_irradiance(seen: Seen, points: Points, normal: NDArray[np.float32], threads: int) -> NDArray[np.float64]:
    """E (N, 3), W m^-2, of K points: seen (K, N) bool, or the visible part as float32; normal (N, 3) unit."""
    out = np.zeros((len(normal), 3))
    in_parts(lambda a, b: _irradiance(a, b, seen, points.direction, points.flux, normal, out), len(normal), threads)
    return out


def point_lobes(
    seen: Seen,
    points: Points,
    normal: NDArray[np.float32],
    view: NDArray[np.float32],
    rows: NDArray[np.int64],
    material: NDArray[np.int32],
    table: MaterialTable,
    threads: int,
) -> NDArray[np.float64]:
    """L (n, 3), W sr^-1 m^-2 without the specular colour, of the receivers `rows` (n,).

    view (N, 3) unit, to the viewer; material (N,): row of the table; the others as in `point_irradiance`.
    """
    out = np.zeros((len(rows), 3))
    in_parts(
        lambda a, b: _lobes(
            a,
            b,
            seen,
            points.direction,
            points.flux,
            normal,
            view,
            rows,
            material,
            table.model,
            table.parameters,
            out,
        ),
        len(rows),
        threads,
    )
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _irradiance(first, last, seen, directions, flux, normal, out):  # type: ignore[no-untyped-def]
    for k in range(len(directions)):
        x, y, z = directions[k]
        for i in range(first, last):
            if seen[k, i]:
                cosine = normal[i, 0] * x + normal[i, 1] * y + normal[i, 2] * z
                if cosine > 0.0:
                    for c in range(3):
                        out[i, c] += cosine * np.float64(seen[k, i]) * flux[k, c]


@njit(cache=True, nogil=True, error_model="numpy")
def _lobes(first, last, seen, directions, flux, normal, view, rows, material, model, parameters, out):  # type: ignore[no-untyped-def]
    for j in range(first, last):
        i = rows[j]
        n = (np.float64(normal[i, 0]), np.float64(normal[i, 1]), np.float64(normal[i, 2]))
        v = (np.float64(view[i, 0]), np.float64(view[i, 1]), np.float64(view[i, 2]))
        for k in range(len(directions)):
            if seen[k, i]:
                l = (directions[k, 0], directions[k, 1], directions[k, 2])  # noqa: E741
                _, lobe, _, _ = lobes_and_density(model[material[i]], parameters[material[i]], n, l, v)
                for c in range(3):
                    out[j, c] += lobe * np.float64(seen[k, i]) * flux[k, c]
