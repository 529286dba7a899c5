"""Direct light of adjustable glossy materials: error against the exact integral, and times. [Sun 2007, Eq. 3-4]

    error = sqrt(sum of |B - exact|^2 / sum of |exact|^2)

over the receivers of a knot on a ground that a camera sees, three colours, specular colour 1; `exact` is
`specular_radiance` with the same visibility.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.report import Report, Row, Table, at_most
from benchmarks.scenes import Setting

ROUGHNESS = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
F0 = (0.04, 0.8)
KEEP = (32, 96, 256)
RECEIVERS = 36_000
EYE = (1.6, 1.7, 3.4)


def knot_on_ground(along: int, sides: int) -> tuple[Any, Any, Any]:
    """Visibility bits, normals and views of what the camera sees."""
    from relightcli.adapters.rays import Tracer
    from relightcli.core.normals import vertex_normals
    from relightcli.core.transport.visibility import trace_visibility
    from relightcli.scene.shapes import torus_knot, tube

    p, f = tube(torus_knot(2, 3, 0.42, 0.18, along), 0.11, sides)
    p = p * (1.2 / np.ptp(p[:, 1]))
    p[:, 1] -= p[:, 1].min()
    square = np.array([[-3.0, 0, -3], [-3, 0, 3], [3, 0, 3], [3, 0, -3]])
    tracer = Tracer(np.concatenate([p, square]), np.concatenate([f, np.array([[0, 1, 2], [0, 2, 3]]) + len(p)]))
    x = np.linspace(-1.5, 1.5, 16)
    ground = np.stack(np.meshgrid(x, [0.0], x, indexing="ij"), -1).reshape(-1, 3)
    above = p[:, 1] > 1e-6
    position = np.concatenate([p[above], ground])
    normals = np.concatenate([vertex_normals(p, f)[above], np.tile([0.0, 1.0, 0.0], (len(ground), 1))])
    view = np.array(EYE) - position
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    front = (normals * view).sum(1) > 0.02
    normals, view = normals[front].astype(np.float32), view[front].astype(np.float32)
    return trace_visibility(tracer, position[front], normals, 64, 4, 0).bits, normals, view


def least_ms(work: Callable[[], Any], times: int = 7) -> float:
    """Least wall-clock time of several, ms."""
    out = []
    for _ in range(times):
        start = time.perf_counter()
        work()
        out.append(time.perf_counter() - start)
    return 1e3 * min(out)


def measure(setting: Setting) -> Report:
    from relightcli.core.brdf import direct_model as dm
    from relightcli.core.lights.sky import sky_latlong

    bits, normals, views = knot_on_ground(*((40, 10) if setting.quick else (80, 24)))
    points = dm.default_points("cook-torrance")
    resolution = 32
    if setting.quick:
        points, resolution = np.array([(f0, m) for m in ROUGHNESS[1::2] for f0 in (0.0, 1.0)]), 12
    report = Report(
        f"{len(bits):,} receivers, cube of 64 x 64 texels a face; Cook-Torrance set of {len(points)} entries"
    )
    skies = {"smooth": sky_latlong(45.0, overcast=True), "sun": sky_latlong(40.0, 60.0)}
    exact = exact_radiance(bits, normals, views, skies)
    rows: list[tuple[str | int | float, ...]] = []
    models = {}
    variants = [("", dm.RANKS["cook-torrance"], dm.DEGREES), ("n_h = 4, n_o = 8: ", (4, 8, 8), dm.DEGREES)]
    for label, ranks, degrees in variants:
        clock = time.perf_counter()
        models[label] = dm.build_direct_model("cook-torrance", points, ranks, degrees, resolution)
        if not label:
            report.rows.append(at_most("building the model", time.perf_counter() - clock, "s", 60.0))
        keeps = KEEP if not label else (96,)
        rows += errors(label, models[label], keeps, bits, normals, views, skies, exact)
    report.tables.append(
        Table("relative RMS error", ("sky", "f0", "kept", *(f"m = {m:g}" for m in ROUGHNESS)), tuple(rows))
    )
    report.rows += times(models[""], bits, normals, views, skies["smooth"], 2_000 if setting.quick else RECEIVERS)
    return report


def exact_radiance(bits: Any, normals: Any, views: Any, skies: dict[str, Any]) -> dict[tuple[str, float, float], Any]:
    from types import SimpleNamespace

    from relightcli.core.brdf.models import pack_materials
    from relightcli.core.lights.environment import latlong_to_cube, splat
    from relightcli.core.shade.glossy import sky_tree, specular_radiance

    black, out = (0.0, 0.0, 0.0), {}
    defaults: dict[str, Any] = {"model": "cook-torrance", "diffuse": black, "transmittance": black, "shininess": 1.0}
    defaults["specular"] = (1.0, 1.0, 1.0)
    rows, material = np.arange(len(bits)), np.zeros(len(bits), np.int32)
    for sky, pixels in skies.items():
        tree = sky_tree(splat(latlong_to_cube(pixels, 64)), pixels, 0.0)
        for f0 in F0:
            for m in ROUGHNESS:
                white = SimpleNamespace(**defaults, f0=f0, roughness=m)
                table = pack_materials([white])
                out[sky, f0, m] = specular_radiance(bits, rows, normals, views, material, table, tree, 2)
    return out


def errors(
    label: str, model: Any, keeps: tuple[int, ...], bits: Any, normals: Any, views: Any, skies: Any, exact: Any
) -> list[tuple[str | int | float, ...]]:
    from relightcli.core.brdf import direct_model as dm
    from relightcli.core.lights.environment import latlong_to_cube, splat
    from relightcli.core.lights.prefiltered import prefiltered_sky
    from relightcli.core.transport import direct_tensor as dt
    from relightcli.core.transport.lobe_visibility import add_lobes, lobe_visibility

    degrees = model.degrees.tolist()
    tables = lobe_visibility(bits, normals, degrees, 2)
    rows, white, out = np.arange(len(bits), dtype=np.int32), np.ones(3), []
    for keep in keeps:
        transfer = dt.direct_transfer(bits, normals, dm.light_factors(model), keep, 2)
        for sky, pixels in skies.items():
            texels = splat(latlong_to_cube(pixels, 64))
            incident = dt.direct_light(*transfer, dt.light_coefficients(texels.radiance()))
            prefiltered = prefiltered_sky(texels, degrees)
            for f0 in F0:
                row = []
                for m in ROUGHNESS:
                    material = dm.setting(model, f0, m)
                    found = np.zeros((len(bits), 3), np.float32)
                    dt.shade_direct(incident, views, normals, rows, material.view_table, white, np.zeros(3), found)
                    add_lobes(bits, tables, prefiltered, degrees, views, normals, rows, material.energy, white, found)
                    truth = exact[sky, f0, m]
                    error = ((np.maximum(found, 0.0) - truth) ** 2).sum() / (truth**2).sum()
                    row.append(math.sqrt(error))
                out.append((f"{label}{sky}", f0, keep, *row))
    return out


def times(model: Any, bits: Any, normals: Any, views: Any, pixels: Any, count: int) -> list[Row]:
    from relightcli.core.brdf import direct_model as dm
    from relightcli.core.lights.environment import latlong_to_cube
    from relightcli.core.lights.prefiltered import prefiltered_sky
    from relightcli.core.transport import direct_tensor as dt
    from relightcli.core.transport.lobe_visibility import add_lobes, lobe_visibility

    threads = min(2, os.cpu_count() or 1)
    factors, degrees = dm.light_factors(model), model.degrees.tolist()
    some = slice(0, min(len(bits), 400))
    on = f"{threads} threads"
    start = time.perf_counter()
    transfer = dt.direct_transfer(bits[some], normals[some], factors, 96, threads)
    middle = time.perf_counter()
    tables = lobe_visibility(bits[some], normals[some], degrees, threads)
    end = time.perf_counter()
    each = 1e3 / len(tables[0])
    out = [
        Row(f"transfer of a receiver, {on}", (middle - start) * each, "ms"),
        Row(f"visible shares of a receiver, {on}", (end - middle) * each, "ms"),
    ]

    def many(x: Any) -> Any:
        return np.ascontiguousarray(np.resize(x, (count, *x.shape[1:])))

    index, scale, value = (many(x) for x in transfer)
    tables = tuple(many(x) for x in tables)
    bits, normals, views = many(bits[some]), many(normals[some]), many(views[some])
    sky = latlong_to_cube(pixels, 64)
    light, white, rows = dt.light_coefficients(sky.radiance()), np.ones(3), np.arange(count, dtype=np.int32)
    incident = dt.direct_light(index, scale, value, light, threads=threads)
    prefiltered = prefiltered_sky(sky, degrees, threads=threads)
    material = dm.setting(model, 0.5, 0.1)
    found = np.zeros((count, 3), np.float32)
    energy = np.ones_like(material.energy)
    out.append(Row("table of a material", least_ms(lambda: dm.setting(model, 0.5, 0.123)), "ms"))
    out.append(Row(f"prefiltered sky, {on}", least_ms(lambda: prefiltered_sky(sky, degrees, threads=threads)), "ms"))
    of = f"{count:,} receivers, {on}"
    work = least_ms(lambda: dt.direct_light(index, scale, value, light, incident, threads))
    out.append(at_most(f"new light, 96 kept, {scale.shape[1]} factors, {of}", work, "ms", 20.0))
    work = least_ms(
        lambda: dt.shade_direct(incident, views, normals, rows, material.view_table, white, white, found, threads)
    )
    out.append(at_most(f"new view or material, {of}", work, "ms", 4.0))
    work = least_ms(
        lambda: add_lobes(bits, tables, prefiltered, degrees, views, normals, rows, energy, white, found, threads)
    )
    out.append(at_most(f"{len(degrees)} lobes at a new view, {of}", work, "ms", 6.0))
    each_kb = (index.nbytes + scale.nbytes + value.nbytes + sum(x.nbytes for x in tables)) / count / 1e3
    out.append(Row("memory of a receiver beside its bits", each_kb, "kB"))
    return out
