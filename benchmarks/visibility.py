"""Visibility: rays per second against raw Embree on the same rays, and the whole of `precompute`."""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.processes import meet, run_tool, together
from benchmarks.report import Report, Row, at_most
from benchmarks.scenes import Setting, write_scene

RESOLUTION, REFINE = 64, 4  # precompute's defaults
BLOCK = 1024  # receivers of a block at that resolution
REPEATS = 3
Rays = list[tuple[NDArray[np.float32], NDArray[np.float32]]]


class Recorder:
    """A tracer that keeps every ray it is asked for."""

    def __init__(self, tracer: Any) -> None:
        self.tracer, self.rays = tracer, Rays()

    def offset(self, points: NDArray[np.floating], normals: NDArray[np.floating]) -> NDArray[np.float32]:
        offset: NDArray[np.float32] = self.tracer.offset(points, normals)
        return offset

    def occluded(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.bool_]:
        self.rays.append((origins.copy(), directions.copy()))  # their arrays are used again
        blocked: NDArray[np.bool_] = self.tracer.occluded(origins, directions)
        return blocked


def race(rank: int, count: int, store: Path, blocks: int) -> dict[str, Any]:
    """Traces this process's share of `blocks` blocks, then hands the same rays to Embree as it comes."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    import relight_formats as formats
    from relightcli.adapters.rays import Tracer
    from relightcli.core.transport.visibility import trace_visibility

    opened = formats.open_store(store)
    positions, faces = opened.read("mesh/position"), opened.read("mesh/face")
    points, normals = opened.read("receivers/position"), opened.read("receivers/normal")
    tracer = Tracer(positions, faces)
    scene = rtcore_scene.EmbreeScene(robust=True)
    raw_mesh = TriangleMesh(scene, tracer.to_local(positions), faces)
    size = min(BLOCK, len(points) // blocks)
    starts = np.linspace(0, len(points) - size, blocks).astype(int)[rank::count]

    def trace(with_tracer: Any) -> None:
        for start in starts:
            rows = slice(start, start + size)
            trace_visibility(with_tracer, points[rows], normals[rows], RESOLUTION, REFINE, int(start))

    recorder = Recorder(tracer)
    trace(recorder)  # compiles, too
    ours, raw = [], []
    for _ in range(REPEATS):
        meet()
        clock = time.perf_counter()
        trace(tracer)
        ours.append(time.perf_counter() - clock)
        meet()
        clock = time.perf_counter()
        for origins, directions in recorder.rays:
            scene.run(origins, directions, query="OCCLUDED")
        raw.append(time.perf_counter() - clock)
    del raw_mesh  # Embree holds no reference to it
    return {"rays": sum(len(o) for o, _ in recorder.rays), "ours": ours, "raw": raw}


def rate(results: list[dict[str, Any]], key: str) -> float:
    """Rays per second of all processes until the last one is done; the median of the repetitions."""
    rays: int = sum(r["rays"] for r in results)
    return float(statistics.median(rays / max(r[key][k] for r in results) for k in range(REPEATS)))


def measure(setting: Setting) -> Report:
    scene, subject = write_scene(setting)
    report = Report(f"{subject}, R = {RESOLUTION}, default settings")
    tiny = Setting(setting.work, True)
    small, _ = write_scene(tiny, 300)
    run_tool(
        "precompute", small, "-o", setting.work / "warm.zarr", "--bounces", "0", *tiny.options
    )  # compiled code onto disk

    finished, said = run_tool(
        "precompute", scene, "-o", setting.store, "--overwrite", "--bounces", "0", *setting.options
    )
    report.about += f", {said['receivers']:,} receivers"
    report.rows += [
        at_most("precompute, start of the program to its end", finished.seconds, "s", 30),
        at_most("store", said["bytes"] / 1e6, "MB", 25),
        at_most("peak memory of a process", finished.peak_bytes / 1e9, "GB", 1.5),
    ]
    results = together(race, setting.store, 4 if setting.quick else 8)
    ours, raw = rate(results, "ours"), rate(results, "raw")
    report.rows.append(
        Row(
            f"visibility rays, {len(results)} processes",
            ours / 1e6,
            "Mray/s",
            f"raw embreex, same rays and processes: {raw / 1e6:.3g} Mray/s",
            ours / raw,
            ">= 0.85",
            ours >= 0.85 * raw,
        )
    )
    report.rows.append(Row("bits wrong, by the built-in check", said["wrong_bits"] * 1e6, "per million"))
    if not setting.quick:
        cold, _ = run_tool(
            "precompute",
            scene,
            "-o",
            setting.work / "cold.zarr",
            "--bounces",
            "0",
            env={"NUMBA_CACHE_DIR": str(setting.work / "numba")},
        )
        report.rows.append(Row("precompute, first run after installing (compiles)", cold.seconds, "s"))
    return report
