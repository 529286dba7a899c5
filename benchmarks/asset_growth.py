"""Transfer tensors over the number of vertices: offline seconds and bytes, which should grow in proportion."""

from __future__ import annotations

import math
from collections.abc import Sequence

from benchmarks.asset import metal_scene, offline
from benchmarks.report import Report, Row, Table
from benchmarks.scenes import Setting

VERTICES, FEW = (10_000, 20_000, 40_000, 80_000), (500, 1_000, 2_000)


def measure(setting: Setting) -> Report:
    report = Report("knot on a ground, one adjustable Cook-Torrance material, two bounces")
    rows = []
    for vertices in FEW if setting.quick else VERTICES:
        scene, _ = metal_scene(setting, vertices)
        seconds, peak, stages, said = offline(scene, scene.parent, setting.options)
        rows.append((vertices, said["receivers"], *(s for _, s, _ in stages), seconds, stages[-1][2] / 1e6, peak / 1e9))
    columns = ("vertices", "receivers", "precompute s", "cluster s", "factorize s", "all s", "asset MB", "peak GB")
    report.tables.append(Table("growth", columns, tuple(rows)))
    for name, column in (("seconds", 5), ("bytes of the asset", 6)):
        exponent = of_added([row[0] for row in rows], [row[column] for row in rows])
        report.rows.append(
            Row(
                f"{name} for added vertices, over their number",
                exponent,
                "exponent",
                "",
                None,
                "<= 1.1",
                exponent <= 1.1,
            )
        )
    return report


def of_added(vertices: Sequence[int], costs: Sequence[float]) -> float:
    """p of what the last vertices added cost over what the first did, ~ number^p: what all sizes share, as the ground
    and the start of a program, has no part in it."""
    added = (vertices[1] - vertices[0], vertices[-1] - vertices[-2])
    cost = (costs[1] - costs[0], costs[-1] - costs[-2])
    return math.log(cost[1] / cost[0]) / math.log(added[1] / added[0])
