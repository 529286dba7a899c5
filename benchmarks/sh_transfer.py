"""Diffuse transfer with shadows in nine spherical harmonics, against the usual small Python script.

The script's method, as in PIFu's `prt_util.computePRT` and its many copies, written here anew: one set of uniformly
random directions of the whole sphere for all vertices, every direction traced from every vertex whichever side of the
surface it is on, one process. It is given Embree's occlusion query and our ray offsets, which are faster and safer than
its own. Both are judged against R = 256, every texel traced.
"""

from __future__ import annotations

import math
import statistics
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.processes import meet, together
from benchmarks.receivers import Traceable, read_traceable, sample, share
from benchmarks.report import Report, Row, Table, faster
from benchmarks.scenes import Setting, main_store, write_scene

ORDER = 3
OURS = ((16, 4), (32, 4), (64, 4))  # resolution and refinement
USUAL = 1600  # directions in the script's usual settings
CHUNK = 16  # directions the script traces at once
Parts = list[tuple[slice, NDArray[np.float32]]]


def our_transfer(rank: int, count: int, points: Traceable, resolution: int, refine: int) -> tuple[float, int, Parts]:
    """Seconds, rays and coefficients of this process's share."""
    from relightcli.core.sphere.sh import cosine_transfer
    from relightcli.core.transport.visibility import trace_visibility

    tracer = points.tracer()
    rows = share(len(points.position), rank, count, 64 if resolution == 256 else 1024)

    def run(part: slice) -> tuple[int, NDArray[np.float32]]:
        block = trace_visibility(
            tracer, points.position[part], points.normal[part], resolution, refine, int(part.start), batch=64
        )
        return block.rays, cosine_transfer(block.bits, points.normal[part], ORDER)

    run(slice(0, min(64, len(points.position))))  # compiles, fills tables
    meet()
    clock = time.perf_counter()
    done = [run(part) for part in rows]
    seconds = time.perf_counter() - clock
    return seconds, sum(r for r, _ in done), [(part, t) for part, (_, t) in zip(rows, done, strict=True)]


def collect(results: list[tuple[float, int, Parts]], count: int) -> tuple[float, int, NDArray[np.float32]]:
    """Seconds until the last process was done, all rays, all coefficients (N, 9)."""
    out = np.empty((count, ORDER**2), np.float32)
    for _, _, parts in results:
        for rows, values in parts:
            out[rows] = values
    return max(r[0] for r in results), sum(r[1] for r in results), out


def script_transfer(points: Traceable, directions: int, seed: int) -> tuple[float, NDArray[np.float64]]:
    """Seconds and coefficients (N, 9) of the script's method."""
    from relightcli.core.sphere.sh import harmonics

    random = np.random.default_rng(seed)
    z, phi = random.uniform(-1.0, 1.0, directions), random.uniform(0.0, 2.0 * math.pi, directions)
    r = np.sqrt(1.0 - z * z)
    d = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    tracer = points.tracer()
    clock = time.perf_counter()
    basis = harmonics(d, ORDER)
    origins = tracer.offset(points.position, points.normal)
    n = len(origins)
    out = np.zeros((n, ORDER**2))
    for start in range(0, directions, CHUNK):
        part = slice(start, min(start + CHUNK, directions))
        some = d[part].astype(np.float32)
        hit = tracer.occluded(np.repeat(origins, len(some), axis=0), np.tile(some, (n, 1))).reshape(n, -1)
        dots = points.normal @ some.T
        out += (np.maximum(dots, 0.0) * ~hit) @ basis[part]
    out *= 4.0 / directions  # 4 pi / number, times the surface's 1 / pi
    return time.perf_counter() - clock, out


def relative(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def measure(setting: Setting) -> Report:
    _, subject = write_scene(setting)
    store: Path = main_store(setting)
    points = read_traceable(store)
    count = len(points.position)
    report = Report(f"{subject}, {count:,} receivers, {ORDER**2} coefficients")
    rows = sample(count, 128 if setting.quick else 1024)
    some = points.at(rows)
    truth_resolution = 64 if setting.quick else 256
    _, _, truth = collect(together(our_transfer, some, truth_resolution, 1), len(rows))

    # The script's cost is proportional to the directions; its error falls with their square root.
    directions = 32 if setting.quick else 128
    seconds, _ = script_transfer(points, directions, 0)
    per_direction = seconds / directions
    errors = [relative(script_transfer(some, n, seed)[1], truth) for n in (256, 1024) for seed in range(4)]
    sizes = [n for n in (256, 1024) for _ in range(4)]
    at_one = math.exp(statistics.fmean(math.log(e * math.sqrt(n)) for e, n in zip(errors, sizes, strict=True)))
    table: list[tuple[str | int | float, ...]] = [
        (f"script, {n} directions", per_direction * n, count * n / 1e6, 100 * statistics.fmean(errors[k : k + 4]))
        for k, n in ((0, 256), (4, 1024))
    ]
    for resolution, refine in OURS[:1] if setting.quick else OURS:
        ours, rays, coefficients = collect(together(our_transfer, points, resolution, refine), count)
        error = relative(coefficients[rows], truth)
        needed = (at_one / error) ** 2
        theirs = per_direction * needed
        table.append((f"ours, R = {resolution}", ours, rays / 1e6, 100 * error))
        report.rows.append(
            faster(
                f"R = {resolution}, error {error:.2%}",
                ours,
                "s",
                f"the script, {needed:,.0f} directions: {theirs:.3g} s",
                theirs / ours,
                10,
            )
        )
        if resolution == OURS[0][0]:
            usual = per_direction * USUAL
            against = f"the script, {USUAL} directions, error {at_one / math.sqrt(USUAL):.2%}: {usual:.3g} s"
            work = f"R = {resolution} against the script as it is used"
            report.rows.append(Row(work, ours, "s", against, usual / ours))
    columns = ("method", "seconds", "million rays", "error, %")
    report.tables.append(
        Table("time and relative RMS error (script: seconds per direction measured)", columns, tuple(table))
    )
    return report
