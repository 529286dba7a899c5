"""Light that was reflected before: exit radiance of every receiver, gathered from the receivers that it sees.

One interreflection adds, at receiver x with the blocked cells c of `transport.hits` and the receivers y(c) behind them,

    diffuse    rho/pi E(x),   E(x) = sum_c L(y(c), -w_c) n . m_c            m_c = integral of w over the blocked part
    specular   sum_c L(y(c), -w_c) s(w_c, v) W_c                            W_c = its solid angle

with L the exit radiance of the interreflection before, diffuse and specular. Any number of them follow one another.
Nothing of light or materials is baked in, so both change freely; what is lost is the size of a cell.

Specular light that goes on to other receivers takes the short cut of `brdf.separable`: every shiny receiver gathers
what arrives, once per light factor, and sends it on weighted by the view factors.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import MaterialTable, dot, lobes_and_density
from relightcli.core.brdf.separable import TERMS
from relightcli.core.parts import in_parts
from relightcli.core.shade.gather import Gather
from relightcli.core.shade.lobe_factors import LobeFactors, axes_of, gather_lobe, send_lobe, waves
from relightcli.core.sphere import cube


class Exit(NamedTuple):
    """Exit radiance of all receivers after some number of interreflections.

    diffuse (N, 3) float32; lobe (G, 6, K) float32, what the receivers with a lobe have gathered per light factor
    (`lobe_factors.gather_lobe`), and row (N,) int32, their place in it, -1 for receivers without.
    """

    diffuse: NDArray[np.float32]
    lobe: NDArray[np.float32]
    row: NDArray[np.int32]


Received = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]


def bounce(
    gather: Gather,
    light: Exit,
    normals: NDArray[np.float32],
    material: NDArray[np.int32],
    table: MaterialTable,
    factors: LobeFactors,
    view: NDArray[np.float32] | None,
    active: NDArray[np.bool_],
    go_on: bool,
    threads: int = 1,
    first: int = 0,
    into: Received | None = None,
) -> Received:
    """One interreflection of the exit radiance `light`, at the receivers from `first` on that `gather` is about.

    Returns the irradiance (N, 3) float32; the specular exit radiance towards `view` (N, 3) of the `active` receivers
    (N,), with its colour, (N, 3) float32; and, to `go_on`, what the light factors gather, (G, 6, K), else nothing of
    it. Receivers that are not active are left out unless it goes on. The lobe of `light` has places for all that light
    comes from, and, to go on, for all that it reaches; of others the row need only not be negative if they shine.
    into: what the same light gave other receivers, to which this is added in place.
    """
    n = len(normals)
    if into is None:
        lobes = light.lobe.shape if go_on else (0, *light.lobe.shape[1:])
        into = np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32), np.zeros(lobes, np.float32)
    irradiance, specular, lobe = into
    directions = _directions(gather.cells)
    towards = np.zeros((n, 3), np.float32) if view is None else view
    looked_at = active if view is not None else np.zeros(n, bool)

    def part(a: int, b: int) -> None:
        _bounce(
            a,
            b,
            first,
            gather,
            directions,
            light,
            normals,
            material,
            table.model,
            table.parameters,
            factors,
            towards,
            active,
            looked_at,
            go_on,
            irradiance,
            specular,
            lobe,
        )

    in_parts(part, len(gather.start) - 1, threads)
    return into


@lru_cache(maxsize=4)
def _directions(cells: int) -> NDArray[np.float64]:
    """(6 C C, 3). Read-only: stores that memory does not hold come in many small parts."""
    directions = cube.texel_directions(cells).reshape(-1, 3)
    directions.flags.writeable = False
    return directions


@njit(cache=True, nogil=True, error_model="numpy")
def _bounce(  # type: ignore[no-untyped-def]
    start, stop, first, gather, directions, light, normals, material, models, parameters, factors, views, active,
    looked_at, go_on, irradiance, specular, lobe_out,
):  # fmt: skip
    row = light.row
    wave = np.empty((2, TERMS), np.float32)
    for x in range(start, stop):
        i = first + x
        if not (active[i] or go_on):
            continue
        m = material[i]
        shiny = row[i] >= 0
        n = (np.float64(normals[i, 0]), np.float64(normals[i, 1]), np.float64(normals[i, 2]))
        v = (np.float64(views[i, 0]), np.float64(views[i, 1]), np.float64(views[i, 2]))
        axes = axes_of(n)
        looked_at_front = shiny and looked_at[i] and dot(n, v) > 0.0
        er = eg = eb = sr = sg = sb = 0.0
        for z in range(gather.start[x], gather.start[x + 1]):
            y = gather.source[z]
            r, g, b = light.diffuse[y, 0], light.diffuse[y, 1], light.diffuse[y, 2]
            c = gather.cell[z]
            d = (directions[c, 0], directions[c, 1], directions[c, 2])
            if row[y] >= 0:
                p = material[y]
                other = axes_of((np.float64(normals[y, 0]), np.float64(normals[y, 1]), np.float64(normals[y, 2])))
                back = (-d[0], -d[1], -d[2])
                if waves(factors.view_factor[p], other, back, wave):
                    lr, lg, lb = send_lobe(wave, light.lobe[row[y]])
                    r += lr * factors.colour[p, 0]
                    g += lg * factors.colour[p, 1]
                    b += lb * factors.colour[p, 2]
            w = gather.cosine[z]
            er += w * r
            eg += w * g
            eb += w * b
            if not shiny:
                continue
            w = gather.solid_angle[z]
            if looked_at_front:
                _, s, _, _ = lobes_and_density(models[m], parameters[m], n, d, v)
                s *= w
                sr += s * r
                sg += s * g
                sb += s * b
            if go_on and waves(factors.light_factor[m], axes, d, wave):
                gather_lobe(wave, w * r, w * g, w * b, lobe_out[row[i]])
        # Truncated lobes may leave a little below zero, in sums as well.
        irradiance[i, 0], irradiance[i, 1], irradiance[i, 2] = max(er, 0.0), max(eg, 0.0), max(eb, 0.0)
        specular[i, 0] = max(sr, 0.0) * factors.colour[m, 0]
        specular[i, 1] = max(sg, 0.0) * factors.colour[m, 1]
        specular[i, 2] = max(sb, 0.0) * factors.colour[m, 2]
