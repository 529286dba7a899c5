"""Time, memory and bytes of precompute as scenes grow: points over one size, and the exponent that fits them.

Every point is a process of its own. CPU seconds are of all its processes, the peak is that of the largest one.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage

import numpy as np

from benchmarks.processes import run_tool
from benchmarks.report import Report, Row, Table
from benchmarks.scenes import Setting, write_scene

MOST_PEAK = 3.0  # GB a process, at a million vertices
SHADOWS = ("--no-subdivide", "--effects", "direct,shadows", "--light-resolution")
HEAD = ("receivers", "s", "CPU s", "peak GB", "MB")


def measure(setting: Setting) -> Report:
    report = Report("growth of precompute: a knot on a ground, R = 16 over vertices, else 10,000 vertices")
    few = 1_000 if setting.quick else 10_000
    sizes = (500, 1_000, 2_000) if setting.quick else (10_000, 30_000, 100_000, 300_000, 1_000_000)
    over_vertices = [_point(setting, n, (*SHADOWS, "16")) for n in sizes]
    _add(report, "vertices", sizes, over_vertices)
    resolutions = (16, 32) if setting.quick else (16, 32, 64, 128)
    _add(report, "texels along a face", resolutions, [_point(setting, few, (*SHADOWS, str(r))) for r in resolutions])
    bounced = ("--no-subdivide", "--light-resolution", "16", "--bounce-resolution")
    cells = (8, 16)
    _add(
        report,
        "cells along a face of what is seen, one interreflection",
        cells,
        [_point(setting, few, (*bounced, str(c), "--bounces", "1")) for c in cells],
    )
    peak = over_vertices[-1][3]
    report.rows.append(
        Row(
            f"peak of a process at {sizes[-1]:,} vertices",
            peak,
            "GB",
            ratio=MOST_PEAK / peak,
            target=f"<= {MOST_PEAK:g} GB",
            met=peak <= MOST_PEAK,
        )
    )
    return report


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """p of value ~ size^p, by least squares of the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(np.maximum(values, 1e-9)), 1)[0])


def _point(setting: Setting, vertices: int, options: tuple[str, ...]) -> tuple[float, ...]:
    scene, _ = write_scene(setting, vertices)
    store = setting.work / "growth.zarr"
    shutil.rmtree(store, ignore_errors=True)
    before = _cpu()
    finished, said = run_tool("precompute", scene, "-o", store, *options)
    return said["receivers"], finished.seconds, _cpu() - before, finished.peak_bytes / 1e9, _size(store) / 1e6


def _cpu() -> float:
    usage = getrusage(RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _size(store: Path) -> int:
    return sum(file.stat().st_size for file in store.rglob("*") if file.is_file())


def _add(report: Report, what: str, sizes: Sequence[int], points: list[tuple[float, ...]]) -> None:
    """The points, and below them the exponent of each column between the first point and the last."""
    rows: list[tuple[str | int | float, ...]] = [(n, int(p[0]), *p[1:]) for n, p in zip(sizes, points, strict=True)]
    fitted = [exponent(sizes, column) for column in zip(*points, strict=True)]
    last = [
        math.log(points[-1][k] / points[-2][k]) / math.log(sizes[-1] / sizes[-2]) if points[-2][k] else math.nan
        for k in range(len(points[0]))
    ]
    rows.append(("exponent, all points", *(f"{p:.2f}" for p in fitted)))
    rows.append(("exponent, last two", *(f"{p:.2f}" for p in last)))
    report.tables.append(Table(f"over {what}", (what, *HEAD), tuple(rows)))
