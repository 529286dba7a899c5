"""Clustered environment lights at the size of Johan and Nishita's scenes: time, bytes, relighting, edits, error."""

from __future__ import annotations

import shutil
import statistics
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy import relative
from benchmarks.processes import cores, run_tool, together
from benchmarks.receivers import read_traceable, sample
from benchmarks.report import Report, Row, Table, at_most
from benchmarks.scenes import Setting, all_skies, shared_data, write_scene
from benchmarks.truth import truth

# Mesh of the test data, placement, cells along the ground, material, resolution; ground and mesh together have about
# as many vertices as the paper's scenes.
SCENES = {
    "bunny": ("bunny_zipper_full.ply", "scale = 8\ntranslate = [0.13, -0.264, 0]", 192, False, 1024),
    "dragon": ("dragon_photon_50k.obj", "scale = 0.15", 150, False, 1024),
    "glossy armadillo": ("armadillo.obj", "scale = 1.3\ntranslate = [0, 0.745, 0]", 161, True, 256),
}
GLOSSY = 'model = "cook-torrance"\nspecular = [0.7, 0.7, 0.7]\nf0 = 0.6\nroughness = {roughness}\n'
SCENE = """\
format = 1
[objects.subject]
mesh = "{mesh}"
material = "clay"
{place}
[objects.ground]
mesh = "ground.obj"
material = "grey"
[materials.clay]
diffuse = [0.7, 0.5, 0.4]
{clay}
[materials.grey]
diffuse = [0.5, 0.5, 0.5]
{grey}
[cameras.main]
eye = [1.6, 1.7, 3.4]
target = [-0.1, 0.55, 0]
fov = 36
size = [640, 480]
"""
EPSILONS = (0.16, 0.08, 0.0425, 0.03)
ROUGHNESSES = (0.1, 0.25, 0.4, 0.5)  # of lobes that are compared with exact ones, from EYES
EYES = ((1.6, 1.7, 3.4), (-2.5, 0.9, 1.0))
SHINING = 40_000  # receivers that a further view is stated for
EDITS = 20
Sky = NDArray[np.float32]


def write(setting: Setting, name: str) -> tuple[Path, bool, int] | None:
    """A scene's file, whether it is glossy, and the resolution of its lights; None without its mesh."""
    mesh, place, cells, glossy, resolution = SCENES[name]
    data = shared_data()
    if setting.quick:
        scene, _ = write_scene(setting)
        return scene, False, 128
    if data is None or not (source := data / "meshes" / "stanford" / mesh).exists():
        return None
    folder = setting.work / name.replace(" ", "-")
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(source, folder / mesh)
    x = np.linspace(-3, 3, cells + 1)
    corner = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1) + 1
    a, b, c, d = (k.reshape(-1) for k in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    lines = [f"v {u:.9g} 0 {v:.9g}" for u in x for v in x]
    lines += [f"f {i} {j} {k}\nf {i} {k} {m}" for i, j, k, m in zip(a, b, c, d, strict=True)]
    (folder / "ground.obj").write_text("\n".join(lines) + "\n")
    clay, grey = (GLOSSY.format(roughness=r) if glossy else "" for r in (0.25, 0.4))
    scene = folder / "scene.toml"
    scene.write_text(SCENE.format(mesh=mesh, place=place, clay=clay, grey=grey))
    return scene, glossy, resolution


def relight(store: Path, skies: list[Sky]) -> dict[str, Any]:
    """Seconds a full relight, seconds a local edit and what part of the clusters it touches, radiance per sky."""
    from relightcli.stages.clustered import ClusteredStore

    lighting = ClusteredStore(store, cores())
    materials, view = lighting.scene.materials, None
    if "light_clusters/view" in lighting.store:
        view = np.asarray(lighting.store.read("light_clusters/view"))

    def shine(sky: Sky, rotate: float = 0.0) -> tuple[NDArray[np.float32], float]:
        clock = time.perf_counter()
        (direct,) = lighting.exit_radiance(sky, rotate, materials, view)
        seconds = time.perf_counter() - clock
        return direct.diffuse if direct.specular is None else direct.diffuse + direct.specular, seconds

    radiance = [shine(sky)[0] for sky in skies]  # reads, compiles
    full = [shine(skies[k % len(skies)], 37.0 * (k + 1))[1] for k in range(2 * len(skies))]
    sky = skies[0]
    shine(sky)
    edits, touched = [], []
    # A lamp of 2 % of the map's width that wanders, as the paper's discs do.
    size, height = max(1, sky.shape[1] // 50), sky.shape[0]
    for k in range(EDITS):
        edited = sky.copy()
        row, column = height // 4 + (k * height) // 120, sky.shape[1] // 3 + k
        edited[row : row + size // 2, column : column + size // 2] += 3.0
        edits.append(shine(edited)[1])
        touched.append((lighting.changed or 0) / len(lighting.sky.tree.cell))
    return {
        "full": statistics.median(full),
        "edit": statistics.median(edits[1:]),
        "touched": statistics.median(touched[1:]),
        "radiance": radiance,
    }


def many_views(transfer: Path, store: Path, paths: dict[str, Path], skies: list[Sky]) -> tuple[list[Row], Table]:
    """Views of a store of light factors: seconds, bytes, and errors of the specular layer against integration from the
    bits, relative RMS over a sample of the receivers."""
    import relight_formats as formats
    from relightcli.stages.clustered import ClusteredStore
    from relightcli.stages.lighting import LightingStore

    ours, exact = ClusteredStore(store, cores()), LightingStore(transfer, cores())
    views = []
    for eye in EYES:
        d = np.array(eye) - ours.position
        views.append((d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32))
    chosen = np.zeros(len(ours), bool)
    chosen[sample(len(ours), 1024)] = True
    every = {m: {name: replace(v, roughness=m) for name, v in ours.scene.materials.items()} for m in ROUGHNESSES}

    def shine(lighting: LightingStore, sky: Sky, roughness: float, view: Any, active: Any = None) -> Any:
        (direct,) = lighting.exit_radiance(sky, 0.0, every[roughness], view, active)
        return direct.specular

    for m in ROUGHNESSES:  # reads, compiles
        shine(ours, skies[0], m, views[0])
    first, further, rows = [], [], []
    for name, sky in zip([*paths][1:] + [*paths][:1], skies[1:] + skies[:1], strict=True):
        clock = time.perf_counter()
        shine(ours, sky, ROUGHNESSES[0], views[0])
        first.append(time.perf_counter() - clock)
        errors: list[str | int | float] = []
        for m in ROUGHNESSES:
            clock = time.process_time()
            shine(ours, sky, m, views[1])
            further.append(time.process_time() - clock)
            pairs = [[shine(s, sky, m, view, chosen)[chosen] for s in (ours, exact)] for view in views]
            errors.append(max(100 * relative(a, b) for a, b in pairs))
        rows.append((name, *errors))
    sizes = formats.open_store(store).sizes()
    extra = sum(size.stored for array, size in sizes.items() if array.startswith("light_factors/"))
    shining = sum(layout.shape[0] for array, layout in ours.store.layouts.items() if array.endswith("/receiver"))
    view = statistics.median(further) * SHINING / shining
    return [
        at_most("light factors: first view under a new map, median", statistics.median(first), "s", 0.5),
        at_most(f"light factors: CPU of a further view of {SHINING:,} shining receivers, median", view, "s", 0.02),
        Row("light factors: bytes beyond the bits and the fractions", extra / 1e6, "MB"),
        at_most("light factors: largest error of the specular layer", max(max(row[1:]) for row in rows), "%", 6),
    ], Table(
        "light factors: relative RMS error of the specular layer, %, the larger of two views",
        ("sky", *(f"roughness {m:g}" for m in ROUGHNESSES)),
        tuple(rows),
    )


def storage(store: Path) -> tuple[tuple[str | int | float, ...], ...]:
    """Bytes of the transfer vectors in several forms, and the RMS error of their rounding relative to the transfer."""
    from numcodecs import Zstd

    import relight_formats as formats
    from relightcli.core.lights import quadtree

    opened = formats.open_store(store)
    read: Any = opened.read
    cells, normal = read("light_clusters/cell"), read("receivers/normal")
    resolution = int(opened.settings["cluster_resolution"])
    solid = read("light_clusters/solid_angle")
    chosen = np.arange(0, len(cells), max(1, len(cells) // 512))  # in the order of the trees
    fraction = read("light_clusters/fraction")[chosen] / 255.0
    middle = np.array([quadtree.samples(tuple(c), resolution)[1].mean(0) for c in cells[chosen].tolist()])
    height, r = middle @ normal.T, 0.5 * np.sqrt(solid[chosen])[:, None]
    transfer = fraction * np.where(height > r, height, np.maximum(height + r, 0.0) ** 2 / (4.0 * r))
    pack = Zstd(level=3).encode
    rows = []

    def row(form: str, steps: NDArray[np.uint8], back: NDArray[np.float64]) -> None:
        error = float(np.linalg.norm(back - transfer) / np.linalg.norm(transfer))
        scale = len(cells) / len(chosen) / 1e6
        rows.append((form, steps.size * scale, np.count_nonzero(steps) * scale, len(pack(steps)) * scale, 100 * error))

    one = np.rint(transfer * 255).astype(np.uint8)
    row("one byte, one scale", one, one / 255.0)
    peak = np.maximum(transfer.max(axis=1, keepdims=True), 1e-30)
    scaled = np.rint(transfer / peak * 255).astype(np.uint8)
    row("one byte, a scale per cluster", scaled, scaled / 255.0 * peak)
    delta = np.diff(one, axis=0, prepend=np.zeros((1, one.shape[1]), np.uint8))
    row("the same of one scale, minus the cluster before", delta, one / 255.0)
    kept = np.rint(fraction * 255).astype(np.uint8)
    row("visible fraction, as stored", kept, transfer)
    return tuple(rows)


def measure(setting: Setting) -> Report:
    import relight_formats as formats
    from relightcli.adapters.images import read_environment
    from relightcli.core.brdf.models import pack_materials
    from relightcli.stages.lighting import LightingStore

    paths = all_skies(setting)
    skies = [read_environment(path) for path in paths.values()]
    report = Report(f"{cores()} processes, {len(skies)} skies")
    errors: list[tuple[str | int | float, ...]] = []
    counts: list[tuple[str | int | float, ...]] = []
    for name in ("bunny",) if setting.quick else SCENES:
        made = write(setting, name)
        if made is None:
            report.skipped.append(f"{name}: no test data")
            continue
        scene, glossy, resolution = made
        transfer, store = scene.parent / "transfer.zarr", scene.parent / "clusters.zarr"
        if not transfer.exists():
            run_tool("precompute", scene, "-o", transfer, "--no-subdivide", "--bounces", "0")
        view = ("--camera", "main") if glossy else ()
        run = ("cluster", transfer, "-o", store, "--overwrite", "--light-resolution", str(resolution), *view)
        finished, told = run_tool(*run)
        count = told["light_clusters"]
        about = f"{name}, {told['receivers']:,} receivers, R = {resolution}, {count:,} clusters"
        found = relight(store, skies)
        report.rows += [
            at_most(f"{about}: cluster, start of the program to its end", finished.seconds, "s", 180),
            at_most(f"{name}: store", told["bytes"] / 1e6, "MB", 100),
            at_most(f"{name}: peak memory of a process", told["peak_bytes"] / 1e9, "GB", 2),
            at_most(f"{name}: full relight of vertex radiance, median", found["full"], "s", 0.1),
            at_most(f"{name}: local edit, {100 * found['touched']:.2g} % of the clusters", found["edit"], "s", 0.005),
            Row(f"{name}: RMS at random lights", told["error"], "of a light overhead"),
        ]
        lighting = LightingStore(transfer, cores())
        rows = sample(len(lighting), 1024)
        materials = list(lighting.scene.materials.values())
        of = lighting.geometry.material[lighting.object][rows]
        lobed = None
        if glossy:
            towards = np.asarray(formats.open_store(store).read("light_clusters/view"))[rows]
            lobed = (towards, of.astype(np.int32), pack_materials(materials))
        exact = np.zeros((len(skies), len(rows), 3))
        fine = 64 if setting.quick else 256
        for parts in together(truth, read_traceable(transfer).at(rows), fine, skies, lobed):
            for part, values in parts:
                e, shine = values if glossy else (values, 0.0)
                exact[:, part] = e * np.array([m.diffuse for m in materials])[of[part]] / np.pi
                exact[:, part] += shine * np.array([m.specular for m in materials])[of[part]]
        ours = [radiance[rows] for radiance in found["radiance"]]
        shares = [100 * relative(a, b) for a, b in zip(ours, exact, strict=True)]
        errors.append((name, *shares))
        report.rows.append(at_most(f"{name}: largest error of {len(skies)} maps", max(shares), "%", 2))
        if glossy:
            factors = scene.parent / "factors.zarr"
            run_tool(
                "cluster", transfer, "-o", factors, "--overwrite", "--light-resolution", str(resolution),
                "--light-factors",
            )  # fmt: skip
            more, table = many_views(transfer, factors, paths, skies)
            report.rows += more
            report.tables.append(table)
        if name != "bunny":
            continue
        if not setting.quick:
            _, wide = run_tool("cluster", transfer, "-o", scene.parent / "wide.zarr", "--light-resolution", "4096")
            report.rows.append(
                at_most("bunny: clusters at R = 4096 over R = 1024", wide["light_clusters"] / count, "", 1.03)
            )
            report.rows.append(at_most("bunny: peak memory at R = 4096", wide["peak_bytes"] / 1e9, "GB", 2))
        report.tables.append(
            Table(
                "bunny: forms of the transfer vectors",
                ("form", "MB raw", "MB without zeros", "MB zstd", "rounding, %"),
                storage(store),
            )
        )
        for epsilon in EPSILONS[:2] if setting.quick else EPSILONS:
            other = scene.parent / "epsilon.zarr"
            done, said = run_tool(*run[:2], "-o", other, *run[4:], "--epsilon", str(epsilon))
            lit = relight(other, skies)
            worst = max(100 * relative(a[rows], b) for a, b in zip(lit["radiance"], exact, strict=True))
            counts.append(
                (
                    epsilon,
                    said["light_clusters"],
                    said["error"],
                    worst,
                    said["bytes"] / 1e6,
                    done.seconds,
                    1e3 * lit["full"],
                )
            )
    report.tables.append(Table("relative RMS error of radiance, %", ("scene", *paths), tuple(errors)))
    report.tables.append(
        Table(
            "bunny: what epsilon costs",
            ("epsilon", "clusters", "RMS at random lights", "largest error, %", "MB", "s", "ms a relight"),
            tuple(counts),
        )
    )
    return report
