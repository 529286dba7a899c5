"""Time, memory and bytes as scenes grow: points over one size at a time, and the exponent that fits them.

Every point is a process of its own. CPU seconds are of all its processes, the peak is that of the largest one.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.asset import metal_scene
from benchmarks.processes import run_tool
from benchmarks.report import Report, Table, at_most
from benchmarks.scenes import Setting, two_skies, write_scene

MOST_PEAK = 3.0  # GB a process, at a million vertices
SHADOWS = ("--no-subdivide", "--effects", "direct,shadows", "--light-resolution")
BOUNCED = ("--no-subdivide", "--light-resolution", "16", "--bounces", "1", "--bounce-resolution")
LIGHTS = ("--light-resolution", "64", "--lights", "250")
HEAD = ("receivers", "s", "CPU s", "peak GB", "MB")
FRAMES = """\
format = 1
frames = {frames}

[[key]]
frame = 1
env_rotate = 0

[[key]]
frame = {frames}
env_rotate = 350
"""
BALLS = 8
PLASTIC = """\
model = "cook-torrance"
diffuse = [0.3, 0.2, 0.15]
specular = [0.3, 0.3, 0.3]
f0 = 0.5
roughness = 0.4
adjustable = true
"""
FIELDS = (
    *("--no-subdivide", "--light-resolution", "16", "--bounces", "0"),
    *("--field-shells", "6", "--field-resolution", "8"),
)
Point = tuple[float, ...]


def measure(setting: Setting) -> Report:
    report = Report("a knot on a ground, R = 16 over vertices, else 10,000 vertices")
    few, middle = (500, 1_000) if setting.quick else (10_000, 100_000)
    sizes = (few, middle, 2_000) if setting.quick else (few, 30_000, middle, 300_000, 1_000_000)
    over_vertices, lights = [], []
    for n in sizes:
        over_vertices.append(_simulate(setting, n, (*SHADOWS, "16")))
        if n in (few, middle, sizes[-1]):
            lights.append(_cluster(setting))
        if n == few:
            counts = (2, 4) if setting.quick else (8, 32, 128)
            frames = [_pictures(setting, count) for count in counts]
    _add(report, "precompute over vertices", "vertices", sizes, over_vertices)
    _add(report, "cluster --lights 250 over vertices", "vertices", (few, middle, sizes[-1]), lights)
    _add(report, "relight over frames", "frames", counts, frames)
    ends = (few, middle, sizes[-1])
    bounced, groups = zip(*(_bounced(setting, n) for n in ends), strict=True)
    _add(report, "precompute with one interreflection, a metal, over vertices", "vertices", ends, list(bounced))
    _add(report, "cluster of its receivers over vertices", "vertices", ends, list(groups))
    resolutions = (16, 32) if setting.quick else (16, 32, 64, 128)
    points = [_simulate(setting, few, (*SHADOWS, str(r))) for r in resolutions]
    _add(report, "precompute over texels along a face", "texels", resolutions, points)
    cells = (8, 16)
    points = [_simulate(setting, few, (*BOUNCED, str(c))) for c in cells]
    _add(report, "precompute with one interreflection over cells along a face of what is seen", "cells", cells, points)
    numbers = (1, 2) if setting.quick else (1, 2, 4, BALLS)
    clusters, assets = zip(*(_tensors(setting, number) for number in numbers), strict=True)
    _add(report, f"cluster over adjustable materials of {BALLS} balls", "materials", numbers, list(clusters))
    _add(report, f"factorize over adjustable materials of {BALLS} balls", "materials", numbers, list(assets))
    movers = [_fields(setting, number) for number in numbers]
    _add(report, f"precompute over how many of {BALLS} balls can be moved", "movers", numbers, movers)
    for what, found in (
        ("precompute", over_vertices),
        ("cluster of lights", lights),
        ("precompute with one interreflection", bounced),
        ("cluster of receivers", groups),
    ):
        report.rows.append(
            at_most(f"{what}: peak of a process at {sizes[-1]:,} vertices", found[-1][3], "GB", MOST_PEAK)
        )
    return report


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """p of value ~ size^p, by least squares of the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(np.maximum(values, 1e-9)), 1)[0])


def _simulate(setting: Setting, vertices: int, options: tuple[str, ...]) -> Point:
    scene, _ = write_scene(setting, vertices)
    store = setting.work / "growth.zarr"
    shutil.rmtree(store, ignore_errors=True)
    return _run(store, "precompute", scene, "-o", store, *options)


def _bounced(setting: Setting, vertices: int) -> tuple[Point, Point]:
    """`precompute` of one interreflection of an adjustable metal, and `cluster` of what that leaves."""
    transfer, clusters = (setting.work / f"{name}.zarr" for name in ("growth-metal", "growth-groups"))
    for store in (transfer, clusters):
        shutil.rmtree(store, ignore_errors=True)
    scene, _ = metal_scene(setting, vertices)
    made = _run(transfer, "precompute", scene, "-o", transfer, *BOUNCED, "8")
    return made, _run(clusters, "cluster", transfer, "-o", clusters)


def _cluster(setting: Setting) -> Point:
    """Of the store that `_simulate` has left."""
    store = setting.work / "growth-lights.zarr"
    shutil.rmtree(store, ignore_errors=True)
    return _run(store, "cluster", setting.work / "growth.zarr", "-o", store, *LIGHTS)


def _pictures(setting: Setting, frames: int) -> Point:
    """Of the store that `_simulate` has left, under a sky that turns; no receivers to count."""
    shots, folder = setting.work / "growth.toml", setting.work / "growth-frames"
    shots.write_text(FRAMES.format(frames=frames))
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    sky = next(iter(two_skies(setting).values()))
    where = ("--env", sky, "--camera", "main", "--frames", shots, "-o", folder / "frame.####.exr")
    return _run(folder, "relight", setting.work / "growth.zarr", *where)


def _balls(setting: Setting, materials: int, movers: int) -> Path:
    """Eight balls in a ring on a ground, with so many adjustable materials among them; the first few can be moved."""
    import trimesh

    from relightcli.scene.shapes import rounded

    source, _ = write_scene(setting, 500)
    folder = setting.work / f"balls-{materials}-{movers}"
    shutil.copytree(source.parent, folder, dirs_exist_ok=True)
    text = (folder / "scene.toml").read_text()
    text = text[: text.index("[objects.subject]")] + text[text.index("[objects.ground]") :]
    for k in range(BALLS):
        angle = 2.0 * np.pi * k / BALLS
        place = [float(np.cos(angle)), 0.3, float(np.sin(angle))]
        # No two alike: objects of one mesh share their field.
        ball = rounded((0.5, 0.4 + 0.02 * k, 0.5), power=2, subdivisions=2 if setting.quick else 3)
        trimesh.Trimesh(*ball, process=False).export(folder / f"ball{k}.ply")
        motion = 'motion = "rigid"\n' if k < movers else ""
        text += (
            f'\n[objects.ball{k}]\nmesh = "ball{k}.ply"\nmaterial = "m{k % materials}"\n{motion}translate = {place}\n'
        )
    for k in range(materials):
        text += f"\n[materials.m{k}]\n{PLASTIC}"
    scene = folder / "scene.toml"
    scene.write_text(text)
    return scene


def _tensors(setting: Setting, materials: int) -> tuple[Point, Point]:
    """`cluster` and `factorize` of one interreflection."""
    scene = _balls(setting, materials, 0)
    names = ("growth", "growth-clusters", "growth-asset")
    transfer, clusters, asset = (setting.work / f"{name}.zarr" for name in names)
    for store in (transfer, clusters, asset):
        shutil.rmtree(store, ignore_errors=True)
    _run(transfer, "precompute", scene, "-o", transfer, *BOUNCED, "8")
    return _run(clusters, "cluster", transfer, "-o", clusters), _run(asset, "factorize", clusters, "-o", asset)


def _fields(setting: Setting, movers: int) -> Point:
    store = setting.work / "growth.zarr"
    shutil.rmtree(store, ignore_errors=True)
    return _run(store, "precompute", _balls(setting, 1, movers), "-o", store, *FIELDS)


def _run(made: Path, *arguments: str | Path) -> Point:
    finished, said = run_tool(*arguments)
    return (
        said.get("receivers", 0),
        finished.seconds,
        finished.cpu_seconds,
        finished.peak_bytes / 1e9,
        _size(made) / 1e6,
    )


def _size(store: Path) -> int:
    return sum(file.stat().st_size for file in store.rglob("*") if file.is_file())


def _add(report: Report, about: str, what: str, sizes: Sequence[int], points: list[Point]) -> None:
    """The points, and below them the exponent of each column over all points, and between the last two."""
    rows: list[tuple[str | int | float, ...]] = [
        (n, int(p[0]) or "", *p[1:]) for n, p in zip(sizes, points, strict=True)
    ]
    for title, first in (("exponent, all points", 0), ("exponent, last two", -2)):
        columns = zip(*points[first:], strict=True)
        rows.append((title, *(f"{exponent(sizes[first:], c):.2f}" if all(c) else "" for c in columns)))
    report.tables.append(Table(about, (what, *HEAD), tuple(rows)))
