"""Transfer tensors over the number of vertices: offline seconds and bytes, which should grow in proportion."""

from __future__ import annotations

import math

from benchmarks.asset import metal_scene, offline
from benchmarks.report import Report, Row, Table
from benchmarks.scenes import Setting

VERTICES = (10_000, 20_000, 40_000, 80_000)


def measure(setting: Setting) -> Report:
    report = Report("knot on a ground, one adjustable Cook-Torrance material, two bounces")
    rows = []
    for vertices in (500, 1_000) if setting.quick else VERTICES:
        scene, _ = metal_scene(setting, vertices)
        seconds, peak, stages, said = offline(scene, scene.parent, setting.options)
        rows.append((vertices, said["receivers"], *(s for _, s, _ in stages), seconds, stages[-1][2] / 1e6, peak / 1e9))
    columns = ("vertices", "receivers", "precompute s", "cluster s", "factorize s", "all s", "asset MB", "peak GB")
    report.tables.append(Table("growth", columns, tuple(rows)))
    first, last = rows[0], rows[-1]
    for name, column in (("seconds", 5), ("bytes of the asset", 6)):
        exponent = math.log(last[column] / first[column]) / math.log(last[1] / first[1])
        report.rows.append(Row(f"{name} over receivers", exponent, "exponent", "", None, "<= 1.1", exponent <= 1.1))
    return report
