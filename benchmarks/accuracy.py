"""What accuracy costs: error, time and bytes of every way to keep direct transfer, on one scene.

Every row is a store that `precompute` made. Errors are relative RMS of the exit radiance over sampled receivers,
against R = 256 with every texel traced and suns in finer parts.
"""

from __future__ import annotations

import shutil
import statistics
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.processes import cores, run_tool, together
from benchmarks.receivers import read_traceable, sample
from benchmarks.report import Report, Table
from benchmarks.scenes import Setting, two_skies, write_scene
from benchmarks.truth import Sky, truth

VARIANTS = (
    *(("visibility", f"R = {r}", "visibility/bits", ("--light-resolution", str(r))) for r in (16, 32, 64, 128)),
    *(
        ("haar", f"R = 64, {n} coefficients", "direct/haar", ("--basis", "haar", "--coefficients", str(n)))
        for n in (32, 128, 512)
    ),
    *(("sh", f"order {n}", "direct/sh", ("--basis", "sh", "--sh-order", str(n))) for n in (3, 6, 10)),
    ("dense", "R = 64", "direct/dense", ("--basis", "dense")),
)
QUICK = (0, 4, 7, 10)  # one of each basis
EPSILONS = (0.16, 0.08, 0.0425)  # of clustered lights, from a store of R = 64
REPEATS = 3


def light(store: Path, skies: list[Sky]) -> tuple[list[NDArray[np.float32]], float]:
    """Exit radiance (N, 3) under every sky, and the median seconds of one relighting."""
    from relightcli.stages.relight import open_lighting

    lighting = open_lighting(store, cores())
    materials = lighting.scene.materials

    def relight(sky: Sky, rotate: float) -> NDArray[np.float32]:
        return lighting.exit_radiance(sky, rotate, materials, None)[0].diffuse

    found = [relight(sky, 0.0) for sky in skies]  # reads, compiles
    seconds = []
    for k in range(REPEATS):
        clock = time.perf_counter()
        relight(skies[k % len(skies)], 40.0 * k)
        seconds.append(time.perf_counter() - clock)
    return found, statistics.median(seconds)


def relative(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    difference = a.astype(np.float64) - b
    return float(np.linalg.norm(difference) / np.linalg.norm(b))


def measure(setting: Setting) -> Report:
    import relight_formats as formats
    from relightcli.adapters.images import read_environment
    from relightcli.stages.lighting import read_scene

    # Small enough for the dense transfer, large enough that lighting outweighs preparing the sky.
    scene, subject = write_scene(setting, 300 if setting.quick else 6_000)
    paths = two_skies(setting)
    skies = [read_environment(path) for path in paths.values()]
    store = setting.work / "variant.zarr"
    table: list[tuple[str | int | float, ...]] = []
    expected: NDArray[np.float64] | None = None
    rows = np.zeros(0, np.intp)
    count = 0
    for basis, knob, arrays, options in [VARIANTS[k] for k in QUICK] if setting.quick else VARIANTS:
        finished, _ = run_tool("precompute", scene, "-o", store, "--bounces", "0", *options, *setting.options)
        opened = formats.open_store(store)
        if expected is None:
            points = read_traceable(store)
            count = len(points.position)
            rows = sample(count, 512 if setting.quick else 1024)
            expected = np.empty((len(skies), len(rows), 3))
            for parts in together(truth, points.at(rows), 64 if setting.quick else 256, skies):
                for part, values in parts:
                    expected[:, part] = values
            described, geometry = read_scene(opened)
            albedo = np.array([m.diffuse for m in described.materials.values()])
            expected *= albedo[geometry.material[opened.read("receivers/object")]][rows] / np.pi
        stored = sum(size.stored for name, size in opened.sizes().items() if name.startswith(arrays))
        radiance, seconds = light(store, skies)
        errors = [100 * relative(r[rows], e) for r, e in zip(radiance, expected, strict=True)]
        table.append((basis, knob, *errors, 1e3 * seconds, stored / count, finished.seconds))
        shutil.rmtree(store)
    assert expected is not None
    made, _ = run_tool("precompute", scene, "-o", store, "--bounces", "0", *setting.options)
    for epsilon in EPSILONS[:1] if setting.quick else EPSILONS:
        clusters = setting.work / "clusters.zarr"
        finished, told = run_tool(
            "cluster", store, "-o", clusters, "--light-resolution", "1024", "--epsilon", str(epsilon)
        )
        stored = sum(
            size.stored for name, size in formats.open_store(clusters).sizes().items() if name.startswith("light_cl")
        )
        radiance, seconds = light(clusters, skies)
        errors = [100 * relative(r[rows], e) for r, e in zip(radiance, expected, strict=True)]
        knob = f"epsilon = {epsilon:g}, {told['light_clusters']:,} clusters"
        took = made.seconds + finished.seconds
        table.append(("clusters", knob, *errors, 1e3 * seconds, stored / count, took))
        shutil.rmtree(clusters)
    shutil.rmtree(store)
    report = Report(f"{subject}, {count:,} receivers, {cores()} threads")
    columns = (
        "basis",
        "knob",
        *(f"error, %: {name}" for name in paths),
        "ms a relight",
        "bytes a receiver",
        "precompute, s",
    )
    report.tables.append(
        Table("error against time and bytes; a relight is a new sky on all receivers", columns, tuple(table))
    )
    return report
