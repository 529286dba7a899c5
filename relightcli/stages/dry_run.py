"""Stage precompute --dry-run: the plan with what it would cost."""

from __future__ import annotations

import time
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.rays import Tracer
from relightcli.core.transport import visibility
from relightcli.core.transport.hits import trace_hits
from relightcli.core.transport.receivers import Receivers
from relightcli.run.accounting import Account
from relightcli.scene.model import Geometry
from relightcli.stages.fields import predict
from relightcli.stages.pose_job import choose_frames
from relightcli.stages.precompute_config import Config
from relightcli.stages.prepare import Prepared
from relightcli.stages.receiver_setup import PixelReceivers, surfaces_of

PILOT_GROUPS = 24  # groups of receivers that are traced


def dry_run(prepared: Prepared, account: Account) -> dict[str, Any]:
    """The plan with its cost, predicted from a pilot of a few hundred receivers, and of samples of fields.

    The bytes are an upper bound: the mesh counts uncompressed, and the pilot's bits compress worse in small groups.
    """
    config, geometry, cells = prepared.config, prepared.geometry, prepared.bounce_cells
    receivers, _, _ = prepared.receivers()
    points = receivers.points if isinstance(receivers, PixelReceivers) else receivers
    spent = {"shadows": np.zeros(3), "one-bounce": np.zeros(3)}  # rays, seconds, bytes
    if prepared.shadows and len(points):
        tracer = Tracer(geometry.positions, geometry.faces)
        surfaces = surfaces_of(geometry, points, np.zeros(len(points), bool)) if cells else None
        starts = np.linspace(0, max(0, len(points) - visibility.GROUP), PILOT_GROUPS + 1).astype(int)
        pilot_receivers = 0
        for k, start in enumerate(starts):
            rows = slice(start, start + visibility.GROUP)
            clock = time.perf_counter()
            block = visibility.trace_visibility(
                tracer, points.position[rows], points.normal[rows], prepared.resolution, config.refine, config.seed
            )
            seen = time.perf_counter()
            hits = None
            if surfaces is not None:
                hits, more = trace_hits(
                    tracer,
                    surfaces,
                    points.position[rows],
                    points.normal[rows],
                    block.bits,
                    prepared.bounce_cells,
                    start,
                    0,
                )
            end = time.perf_counter()
            if k:  # the first run pays for compilation
                pilot_receivers += len(block.bits)
                spent["shadows"] += block.rays, seen - clock, len(zlib.compress(block.bits.tobytes(), 1))
                if hits is not None:
                    spent["one-bounce"] += more, end - seen, len(zlib.compress(hits.tobytes(), 1))
        for cost in spent.values():
            cost *= len(points) / pilot_receivers
            cost[1] /= max(1, config.workers)
    if "pose" in prepared.simulated:
        spent["pose"] = _pose_cost(config, geometry, spent["shadows"])
    if prepared.moving is not None:
        spent["fields"] = np.array(predict(prepared.moving))
        spent["fields"][1] /= max(1, config.workers)
    rays, seconds, packed = np.sum(list(spent.values()), axis=0)
    rows_of_plan = prepared.plan_rows()
    for row in rows_of_plan:
        if row["simulate"] and row["effect"] in spent:
            cost = spent[row["effect"]]
            row["predicted"] = {"rays": int(cost[0]), "seconds": float(cost[1]), "bytes": int(cost[2])}
    return {
        "dry_run": True,
        "store": str(config.output),
        "receivers": len(points),
        "bounces": prepared.bounces,
        "light_resolution": prepared.resolution,
        "plan": rows_of_plan,
        "planning_seconds": account.seconds("planning"),
        "predicted": {"rays": int(rays), "seconds": seconds, "bytes": int(packed) + _raw_bytes(geometry, points)},
        "notes": list(geometry.notes),
    }


def _raw_bytes(geometry: Geometry, points: Receivers) -> int:
    arrays: list[NDArray[Any]] = [
        geometry.positions,
        geometry.normals,
        geometry.uvs,
        geometry.faces,
        points.position,
        points.normal,
    ]
    return sum(a.nbytes for a in [*arrays, *geometry.textures.values()])


def _pose_cost(config: Config, geometry: Geometry, traced: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rays, seconds and bytes of the frames of skinned objects, at the speed of the rays of `traced`."""
    rigs = [rig for rig in geometry.rigs.values() if rig.clips]
    samples = sum(len(choose_frames(rig, config.pose_frames)) * len(rig.position) for rig in rigs)
    rays = samples * config.pose_directions
    seconds = rays * traced[1] / traced[0] if traced[0] else 0.0
    return np.array([rays, seconds, 4.0 * samples * config.pose_order**2])
