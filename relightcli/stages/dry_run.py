"""Stage precompute --dry-run: the plan with what it would cost.

The stage is begun in a folder that is thrown away: the scene is written as it would be, and some receivers, in runs of
neighbours spread evenly, see what they would see. What that took and left is scaled to all of them.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli import __version__
from relightcli.core.transport.receivers import Receivers
from relightcli.run import blocks as run
from relightcli.run.accounting import Account
from relightcli.scene.model import Geometry
from relightcli.stages.fields import predict
from relightcli.stages.lay_out import make_job, put_scene
from relightcli.stages.pose_job import choose_frames
from relightcli.stages.precompute_config import Config
from relightcli.stages.prepare import Prepared
from relightcli.stages.promise import predict_check
from relightcli.stages.receiver_setup import PixelReceivers
from relightcli.stages.visibility_job import VisibilityJob, block_size, create_outputs

RUN, RUNS = 64, 10  # receivers of a run; runs that are traced
PARTS = {"shadows": ("trace", "visibility/"), "lights": ("light", "lights/"), "one-bounce": ("bounce", "bounce/")}


def dry_run(prepared: Prepared, account: Account) -> dict[str, Any]:
    """The plan with its cost, predicted from a pilot: of the whole run, planning included.

    Poses and fields: from the speed of rays, and uncompressed.
    """
    config = prepared.config
    with account.step("receivers"):
        receivers, buried, starts = prepared.receivers()
    points = receivers.points if isinstance(receivers, PixelReceivers) else receivers
    with tempfile.TemporaryDirectory(prefix="relightcli-") as folder:
        store = Path(folder) / "pilot.zarr"
        with formats.begin(store, "transfer", settings={}, inputs={}, program=f"relightcli {__version__}") as writer:  # type: ignore[union-attr]
            with account.step("scene"):
                put_scene(writer, prepared, receivers, buried)
            scene_bytes = _bytes(writer.partial_path)
            spent, started = _pilot(writer, prepared, receivers, starts)
    if "pose" in prepared.simulated:
        spent["pose"] = _pose_cost(config, prepared.geometry, prepared.both, spent["shadows"])
    if prepared.moving is not None:
        spent["fields"] = np.array(predict(prepared.moving))
        spent["fields"][1] /= max(1, config.workers)
    seconds = sum(cost["seconds"] for cost in account.steps.values()) + started
    if prepared.promise is not None:
        seconds += predict_check(config, prepared.scene, prepared.source, prepared.bounces)
    total = np.sum(list(spent.values()), axis=0)
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
        "predicted": {
            "rays": int(total[0]),
            "seconds": float(seconds + total[1]),
            "bytes": int(scene_bytes + total[2]),
        },
        "notes": list(prepared.geometry.notes),
    }


def _pilot(
    writer: formats.Writer, prepared: Prepared, receivers: Receivers | PixelReceivers, starts: tuple[int, ...]
) -> tuple[dict[str, NDArray[np.float64]], float]:
    """Rays, seconds and bytes by part of the visibility of all receivers; and the seconds until the first is traced."""
    count, workers = len(receivers), max(1, prepared.config.workers)
    job = make_job(prepared, str(writer.partial_path), receivers, starts)
    spent = {name: np.zeros(3) for name in ("shadows", "one-bounce", *(["lights"] if job.lights else []))}
    if not count:
        return spent, 0.0
    blocks = -(-count // block_size(job.resolution))
    begun = time.perf_counter()
    if blocks > 1 and workers > 1:  # in other processes, which have to start
        subprocess.run([sys.executable, "-c", f"import {VisibilityJob.__module__}"], check=True)
    create_outputs(writer, job, count, RUN)
    worker = job.open()
    runs = -(-count // RUN)
    chosen = np.unique(np.linspace(0, runs - 1, RUNS).round().astype(int))
    worker.run(run.Block("first", int(chosen[0]) * RUN, min(count, (int(chosen[0]) + 1) * RUN)))
    started = time.perf_counter() - begun
    traced = 0
    costs: dict[str, float] = {}
    for number in chosen:
        block = run.Block(f"run/{number}", int(number) * RUN, min(count, (int(number) + 1) * RUN))
        traced += block.stop - block.start
        clock = time.perf_counter()
        found = worker.run(block)
        # Light in another basis is no part of its own.
        taken = sum(found.get(f"{part}_seconds", 0.0) for part, _ in PARTS.values())
        found["rest_seconds"] = time.perf_counter() - clock - taken
        costs = {key: costs.get(key, 0.0) + value for key, value in found.items()}
    # The share of all receivers that the busiest process has.
    share = min(1.0, -(-blocks // min(workers, blocks)) / blocks)
    for name, (part, prefix) in PARTS.items():
        if f"{part}_rays" in costs:
            size = _bytes(writer.partial_path / prefix)
            spent[name][:] = costs[f"{part}_rays"], share * costs[f"{part}_seconds"], size
    if job.basis != "visibility":
        spent["basis"] = np.array([0.0, share * costs["rest_seconds"], _bytes(writer.partial_path / "direct")])
    for cost in spent.values():
        cost *= count / traced
    return spent, started


def _bytes(folder: Path) -> int:
    """Of the chunks of arrays below a folder."""
    return sum(f.stat().st_size for f in folder.rglob("c*") if f.is_file() and f.name.split(".")[0] == "c")


def _pose_cost(
    config: Config, geometry: Geometry, both: NDArray[np.bool_], traced: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rays, seconds and bytes of the frames of skinned objects, at the speed of the rays of `traced`. both (O,): whose
    back is lit too."""
    rigs = [(rig, both[geometry.object_names.index(name)]) for name, rig in geometry.rigs.items() if rig.clips]
    samples = sum(
        len(choose_frames(rig, config.pose_frames)) * len(rig.position) * (2 if backs else 1) for rig, backs in rigs
    )
    rays = samples * config.pose_directions
    seconds = rays * traced[1] / traced[0] if traced[0] else 0.0
    return np.array([rays, seconds, 2.0 * samples * config.pose_order**2])  # float16
