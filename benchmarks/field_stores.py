"""Stores with fields of moving objects: how long an object takes, how small it gets, and at which error."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from benchmarks.fields import MATERIALS, body_of, lump
from benchmarks.processes import run_tool
from benchmarks.report import Report, Row, Table, at_most
from benchmarks.scenes import Setting
from relightcli.adapters.plots import Curve, scatter
from relightcli.adapters.rays import Tracer
from relightcli.core.fields.build import build_field
from relightcli.core.fields.compression import compress
from relightcli.scene.shapes import patch, torus_knot, tube
from relightcli.stages.field_store import pack_transfer, put_packed

SCENE = """\
format = 1

[materials.wall]
diffuse = [0.7, 0.7, 0.7]

[materials.red]
diffuse = [0.6, 0.1, 0.1]

[materials.green]
diffuse = [0.1, 0.5, 0.1]

[materials.glossy]
model = "cook-torrance"
diffuse = [0.2, 0.2, 0.2]
specular = [0.6, 0.6, 0.6]
f0 = 0.6
roughness = 0.3

[materials.adjustable]
model = "cook-torrance"
diffuse = [0.2, 0.2, 0.2]
specular = [0.6, 0.6, 0.6]
f0 = 0.6
roughness = 0.3
adjustable = true

[cameras.main]
eye = [0, 1, 4.5]
target = [0, 1, 0]
fov = 36
size = [256, 256]
"""
OBJECT = """
[objects.{name}]
mesh = "{name}.ply"
material = "{material}"
motion = "{motion}"
translate = [{x}, {y}, {z}]
"""
# A box of edge 2, open to the viewer: corners of each wall, its material; seen from inside.
WALLS = {
    "floor": ([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]], "wall"),
    "ceiling": ([[-1, 2, -1], [1, 2, -1], [1, 2, 1], [-1, 2, 1]], "wall"),
    "back": ([[-1, 0, -1], [1, 0, -1], [1, 2, -1], [-1, 2, -1]], "wall"),
    "left": ([[-1, 0, 1], [-1, 0, -1], [-1, 2, -1], [-1, 2, 1]], "red"),
    "right": ([[1, 0, -1], [1, 0, 1], [1, 2, 1], [1, 2, -1]], "green"),
}
WALL_CELLS = 20  # with the objects 22,000 vertices, as in the paper's box
TERMS = (2, 4, 8, 16, 32)


def ball_of(vertices: int) -> trimesh.Trimesh:
    """The waves of `fields.lump` on a ball of about that many vertices."""
    side = max(4, round((vertices / 3.8) ** 0.5))
    mesh = trimesh.creation.uv_sphere(1.0, [side, 2 * side])
    mesh.merge_vertices()
    x, y, z = mesh.vertices.T
    return trimesh.Trimesh(mesh.vertices * (1 + 0.15 * np.sin(4 * x + z) * np.cos(5 * y))[:, None], mesh.faces)


def pieces(quick: bool) -> dict[str, trimesh.Trimesh]:
    """Seven objects of about 3,000 vertices each."""
    k = 1 if quick else 4
    knot = trimesh.Trimesh(*tube(torus_knot(2, 3, 0.42, 0.18, 30 * k), 0.11, 6 * k), process=False)
    found = {
        "lump": lump(k),
        "knot": knot,
        "ball": trimesh.creation.icosphere(k),
        "ring": trimesh.creation.torus(0.7, 0.3, 16 * k, 10 * k),
        "pill": trimesh.creation.capsule(1.0, 0.5, [10 * k, 16 * k]),
        "tower": _finer(trimesh.creation.box((1, 1, 2)), 0.4 / k),
        "block": _finer(trimesh.creation.box((1, 1, 1)), 0.3 / k),
    }
    for mesh in found.values():
        mesh.apply_scale(0.4 / np.ptp(mesh.vertices, axis=0).max())
    return found


def _finer(mesh: trimesh.Trimesh, edge: float) -> trimesh.Trimesh:
    return trimesh.Trimesh(*trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, edge))


def write_box(folder: Path, quick: bool) -> Path:
    """A box with seven rigid objects in it, two of them coloured; returns its scene file."""
    folder.mkdir(parents=True, exist_ok=True)
    text = SCENE
    for name, (corners, material) in WALLS.items():
        _grid(corners, 2 if quick else WALL_CELLS).export(folder / f"{name}.ply")
        text += OBJECT.format(name=name, material=material, motion="static", x=0, y=0, z=0)
    for k, (name, mesh) in enumerate(pieces(quick).items()):
        mesh.export(folder / f"{name}.ply")
        material = {"ring": "red", "pill": "green"}.get(name, "wall")
        x, z = (-0.6, 0.0, 0.6)[k % 3], (-0.6, 0.0, 0.6)[k // 3]
        text += OBJECT.format(name=name, material=material, motion="rigid", x=x, y=0.4, z=z)
    (folder / "scene.toml").write_text(text)
    return folder / "scene.toml"


def _grid(corners: list[list[int]], cells: int) -> trimesh.Trimesh:
    """A parallelogram of cells x cells squares."""
    a, b, _, d = (np.array(corner, float) for corner in corners)
    at = np.linspace(0.0, 1.0, cells + 1)
    points = a + at[:, None, None] * (b - a) + at[None, :, None] * (d - a)
    return trimesh.Trimesh(*patch(points), process=False)


def write_one(folder: Path, material: str, vertices: int) -> Path:
    """One object over a floor."""
    folder.mkdir(parents=True, exist_ok=True)
    trimesh.Trimesh(WALLS["floor"][0], [[0, 1, 2], [0, 2, 3]], process=False).export(folder / "floor.ply")
    ball_of(vertices).export(folder / "ball.ply")
    text = SCENE + OBJECT.format(name="floor", material="wall", motion="static", x=0, y=0, z=0)
    text += OBJECT.format(name="ball", material=material, motion="rigid", x=0, y=1.5, z=0)
    (folder / "scene.toml").write_text(text)
    return folder / "scene.toml"


def measure(setting: Setting) -> Report:
    from relightcli.stages.inspect import inspect

    report = Report("stores with fields: 16 shells of 6 x 16 x 16 samples (glossy: 6 x 32 x 32), 8 proxies, order 4")
    small = (
        ("--field-shells", "3", "--field-resolution", "4", "--field-proxies", "2", "--no-subdivide")
        if setting.quick
        else ()
    )
    vertices = 200 if setting.quick else 5_000
    for name, material, goal in (
        ("diffuse", "wall", 0.01),
        ("glossy", "glossy", 0.02),
        ("glossy, adjustable", "adjustable", 0.02),
    ):
        store = setting.work / f"{material}.zarr"
        scene = write_one(setting.work / material, material, vertices)
        took, _ = run_tool("precompute", scene, "-o", store, "--effects", "direct,shadows,fields", *small)
        found = inspect(store, verify=False)
        field = found["fields"][0]
        work = f"{name}: precompute of an object of {vertices:,} vertices over a floor, start to end"
        report.rows.append(at_most(work, took.seconds, "s", 120))
        report.rows.append(at_most(f"{name}: its processor time", took.cpu_seconds, "s", 240))
        ratio = field["transfer_raw_bytes"] / field["transfer_bytes"]
        # A small field has as many components as a large one: nothing to promise.
        target: dict[str, Any] = {} if setting.quick else {"target": ">= 50 to 1", "met": ratio >= 50}
        report.rows.append(Row(f"{name}: transfer at {100 * goal:g} % error in the store", ratio, "to 1", **target))
        report.rows.append(at_most(f"{name}: its error", 100 * field["error"], "%", 100 * goal * 1.01))
        report.tables.append(_parts(f"{name}: where the store's bytes are", found))
        shutil.rmtree(store)
    scene = write_box(setting.work / "box", setting.quick)
    box = setting.work / "box.zarr"
    took, _ = run_tool("precompute", scene, "-o", box, *small)
    found = inspect(box, verify=False)
    report.rows.append(at_most("a box with seven objects, all of its store", found["bytes"] / 1e6, "MB", 44))
    report.rows.append(Row("the box: precompute", took.cpu_seconds, "s of processor time"))
    report.tables.append(_parts("the box: where the store's bytes are", found))
    rows = [
        (", ".join(f["objects"]), f["bytes"] / 1e6, f["transfer_raw_bytes"] / f["transfer_bytes"], 100 * f["error"])
        for f in found["fields"]
    ]
    columns = ("object", "MB", "transfer: to 1", "error, %")
    report.tables.append(Table("the box: its objects", columns, tuple(rows)))
    curve = error_against_terms(setting)
    for name in MATERIALS:
        errors = [float(row[2]) for row in curve.rows if row[0] == name]
        work = f"{name}: error with {TERMS[-1]} terms of a cluster, of that with {TERMS[0]}"
        report.rows.append(at_most(work, errors[-1] / errors[0], "", 1.0))
    report.tables.append(curve)
    return report


def _parts(title: str, found: dict[str, Any]) -> Table:
    """Bytes by group, objects together."""
    parts: dict[str, list[float]] = {}
    for name, array in found["arrays"].items():
        words = [w for w in name.split("/") if not w.isdigit()]
        key = "/".join(words[:2]) if words[0] in ("fields", "sources") else words[0]
        part = parts.setdefault(key, [0.0, 0.0])
        part[0] += array["bytes"] / 1e6
        part[1] += array["raw_bytes"] / 1e6
    ordered = sorted(parts.items(), key=lambda item: -item[1][0])
    return Table(title, ("arrays", "MB", "MB uncompressed"), tuple((k, a, b) for k, (a, b) in ordered))


def error_against_terms(setting: Setting) -> Table:
    """[Pan 2007, Fig. 4] with the bytes that a store takes; drawn beside the results."""
    shells, resolution, rays, proxies = (6, 4, 64, 2) if setting.quick else (16, 8, 512, 8)
    rows: list[tuple[str, int, float, float, float, float]] = []
    for name, material in MATERIALS.items():
        body = body_of(lump(2 if setting.quick else 4), material)
        field, _ = build_field(Tracer(body.positions, body.faces), body, shells, resolution, proxies, rays=rays)
        transfer = field.transfer.reshape(-1, *field.transfer.shape[2:])
        for terms in TERMS:
            clock = time.perf_counter()
            made = compress(transfer, terms=terms)
            seconds = time.perf_counter() - clock
            size = _stored(setting.work / "terms.zarr", made)
            rows.append((name, terms, 100 * made.error, size / 1e6, transfer.nbytes / size, seconds))
    _draw(setting.work.parent / "field-terms", rows)
    columns = ("object", "terms of each of 32 clusters", "error, %", "MB", "to 1", "s")
    about = f"error against terms, {shells} shells of 6 x {resolution} x {resolution} samples"
    return Table(about, columns, tuple(rows))


def _stored(path: Path, made: Any) -> int:
    """Bytes of a compressed transfer in a store."""
    import relight_formats as formats

    shutil.rmtree(path, ignore_errors=True)
    writer = formats.begin(path, "field", settings={}, inputs={}, program="benchmarks")
    assert writer is not None
    with writer:
        put_packed(writer, "", pack_transfer("transfer/", made, 0.0))
        writer.commit({})
    return sum(size.stored for size in formats.open_store(path).sizes().values())


def _draw(path: Path, rows: list[tuple[str, int, float, float, float, float]]) -> None:
    """Error over the terms of a cluster, of the diffuse and the glossy object."""
    by_terms = {name: [row[2] for row in rows if row[0] == name] for name in MATERIALS}
    first, second = by_terms.items()
    drawn = scatter(
        "compression of transfer fields, 32 clusters",
        "terms of a cluster",
        "relative error, %",
        TERMS,
        first[1],
        range(len(TERMS)),
        Curve(second[0], TERMS, second[1]),
    )
    for suffix, data in drawn.items():
        path.with_suffix(f".{suffix}").write_bytes(data)
