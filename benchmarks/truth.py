"""Light at receivers by brute force: every texel of a fine cube traced, and suns pixel by pixel."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.processes import meet
from benchmarks.receivers import Traceable, share
from relightcli.core.brdf.models import MaterialTable, lobes_and_density

PARTS = 8  # along a pixel's side that belongs to a sun
Sky = NDArray[np.float32]
Lobed = tuple[NDArray[np.float32], NDArray[np.int32], MaterialTable]  # view (n, 3), material (n,), its lobe


def truth(
    rank: int, count: int, points: Traceable, resolution: int, skies: list[Sky], lobes: Lobed | None = None
) -> list[tuple[slice, Any]]:
    """Irradiance (skies, n, 3) of this process's share of the receivers; with `lobes` its pair with their specular
    light (skies, n, 3), without the specular colour.

    The few brightest pixels, which a texel would blur, are cut into PARTS x PARTS lights each.
    """
    from relightcli.core.lights.environment import latlong_to_cube, splat
    from relightcli.core.lights.latlong import texel_solid_angles
    from relightcli.core.lights.points import pixel_parts, split_points
    from relightcli.core.shade.irradiance import irradiance, moment_prefix
    from relightcli.core.sphere import cube
    from relightcli.core.transport.visibility import trace_visibility

    tracer = points.tracer()
    split = [split_points(sky) for sky in skies]
    cubes = [splat(latlong_to_cube(rest, resolution)) for rest, _, _ in split]
    prefix = [moment_prefix(c) for c in cubes]
    suns = []
    for sky, (_, _, taken) in zip(skies, split, strict=True):
        row, column = np.divmod(taken, sky.shape[1])
        flux = sky.reshape(-1, 3)[taken].astype(np.float64) * texel_solid_angles(*sky.shape[:2])[row, None]
        suns.append((pixel_parts(row, column, sky.shape[:2], 0.0, PARTS).reshape(-1, 3), flux / PARTS**2))
    centre = cube.texel_directions(resolution).reshape(-1, 3)
    table = None if lobes is None else np.stack([c.flux.reshape(-1, 3) for c in cubes], axis=1)
    meet()
    out = []
    for part in share(len(points.position), rank, count, 64):
        normal = points.normal[part]
        bits = trace_visibility(tracer, points.position[part], normal, resolution, 1, 0).bits
        e = np.stack([irradiance(bits, normal, p) for p in prefix]).astype(np.float64)
        s = np.zeros_like(e)
        origins = tracer.offset(points.position[part], normal)
        if lobes is not None:
            view, material, of = lobes[0][part], lobes[1][part], lobes[2]
            _shine(bits.reshape(len(normal), -1), centre, table, normal, view, material, of.model, of.parameters, s)
        for k, (directions, flux) in enumerate(suns):
            for j, d in enumerate(directions):
                seen = ~tracer.occluded(origins, np.tile(d.astype(np.float32), (len(normal), 1)))
                light = flux[j // PARTS**2]
                e[k] += (seen * np.maximum(normal @ d, 0.0))[:, None] * light
                if lobes is not None:
                    _shine_point(d, light, seen, normal, view, material, of.model, of.parameters, s[k])
        out.append((part, e if lobes is None else (e, s)))
    return out


@njit(nogil=True, error_model="numpy")
def _lobe(n, l, v, model, parameters):  # type: ignore[no-untyped-def]  # noqa: E741
    a = (np.float64(n[0]), np.float64(n[1]), np.float64(n[2]))
    b = (np.float64(v[0]), np.float64(v[1]), np.float64(v[2]))
    return lobes_and_density(model, parameters, a, (l[0], l[1], l[2]), b)[1]


@njit(nogil=True, error_model="numpy")
def _shine(bits, centre, flux, normal, view, material, model, parameters, out):  # type: ignore[no-untyped-def]
    for i in range(len(bits)):
        m = material[i]
        for t in range(len(centre)):
            if (bits[i, t >> 3] >> np.uint8(t & 7)) & np.uint8(1):
                lobe = _lobe(normal[i], centre[t], view[i], model[m], parameters[m])
                for k in range(len(out)):
                    for c in range(3):
                        out[k, i, c] += lobe * flux[t, k, c]


@njit(nogil=True, error_model="numpy")
def _shine_point(d, flux, seen, normal, view, material, model, parameters, out):  # type: ignore[no-untyped-def]
    for i in range(len(seen)):
        if seen[i]:
            lobe = _lobe(normal[i], d, view[i], model[material[i]], parameters[material[i]])
            for c in range(3):
                out[i, c] += lobe * flux[c]
