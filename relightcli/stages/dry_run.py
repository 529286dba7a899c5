"""Stage precompute --dry-run: the plan with what it would cost.

The stage is begun in a folder that is thrown away: the scene is written as it would be, and some receivers, in runs of
neighbours spread evenly, see what they would see. What that took and left is scaled to all of them.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli import __version__
from relightcli.core.transport.receivers import Receivers
from relightcli.run import blocks as run
from relightcli.run.accounting import Account, Meter, children_seconds
from relightcli.scene.build import scene_to_json
from relightcli.scene.model import Geometry
from relightcli.stages.check_cost import LightCosts, measure_light, predict_check
from relightcli.stages.fields import predict
from relightcli.stages.lay_out import make_job, put_scene
from relightcli.stages.pose_job import choose_frames
from relightcli.stages.precompute_config import Config
from relightcli.stages.prepare import Prepared
from relightcli.stages.promise import camera_of, out_of_reach
from relightcli.stages.receiver_setup import PixelReceivers
from relightcli.stages.visibility_job import VisibilityJob, block_size, create_outputs

RUN = 64  # receivers of a run
FEWEST, MOST, PART = 10, 40, 0.2  # runs that are traced: part of all, within these
PARTS = {"shadows": ("trace", "visibility/"), "lights": ("light", "lights/"), "one-bounce": ("bounce", "bounce/")}


def dry_run(prepared: Prepared, account: Account, settings: dict[str, Any]) -> dict[str, Any]:
    """The plan with its cost, predicted from a pilot: of the whole run, planning included.

    settings: of the store. Poses and fields: from the speed of rays, and uncompressed. Seconds are those of the clock,
    on the machine as it is; cpu_seconds those of all processes, which others that use the machine change less.
    """
    config = prepared.config
    with account.step("receivers"):
        receivers, buried, starts = prepared.receivers()
    points = receivers.points if isinstance(receivers, PixelReceivers) else receivers
    with tempfile.TemporaryDirectory(prefix="relightcli-") as folder:
        store = Path(folder) / "pilot.zarr"
        with formats.begin(
            store, "transfer", settings=settings, inputs={}, program=f"relightcli {__version__}"
        ) as writer:  # type: ignore[union-attr]
            about = scene_to_json(prepared.scene, prepared.geometry)
            writer.set_attrs({"scene": about, "nothing_blocks": not prepared.shadows})
            with account.step("scene"):
                put_scene(writer, prepared, receivers, buried)
            scene_bytes = _bytes(writer.partial_path)
            spent, start, light = _pilot(writer, prepared, receivers, starts)
    if "pose" in prepared.simulated:
        spent["pose"] = _pose_cost(config, prepared.geometry, prepared.both, spent["shadows"])
    if prepared.moving is not None:
        rays, alone, size = predict(prepared.moving)
        spent["fields"] = np.array([rays, alone / max(1, config.workers), size, alone])
    seconds, cpu_seconds = (
        sum(cost[key] for cost in account.steps.values()) + start[key] for key in ("seconds", "cpu_seconds")
    )
    notes = list(prepared.geometry.notes)
    if prepared.decided.faces == "whole":
        notes.append(
            "large faces stay whole; should that miss the tolerance at the end, they are cut, which takes more"
        )
    if prepared.checked:
        check = predict_check(
            camera_of(config), prepared.scene, prepared.source, prepared.bounces, prepared.tried, light
        )
        seconds += check["seconds"]
        cpu_seconds += check["cpu_seconds"]
    if prepared.promise is not None:
        missed = out_of_reach(prepared.promise, prepared.tried)
        notes += [] if missed is None else [f"{missed}: without --allow-miss nothing is simulated"]
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
            "cpu_seconds": float(cpu_seconds + total[3]),
            "bytes": int(scene_bytes + total[2]),
        },
        "notes": notes,
    }


def _pilot(
    writer: formats.Writer, prepared: Prepared, receivers: Receivers | PixelReceivers, starts: tuple[int, ...]
) -> tuple[dict[str, NDArray[np.float64]], dict[str, float], LightCosts | None]:
    """Rays, seconds of the clock, bytes and seconds of all processors by part of the visibility of all receivers; the
    seconds of both kinds until the first is traced; and, where the error will be measured, those of light."""
    count, workers = len(receivers), max(1, prepared.config.workers)
    job = make_job(prepared, str(writer.partial_path), receivers, starts)
    spent = {name: np.zeros(4) for name in ("shadows", "one-bounce", *(["lights"] if job.lights else []))}
    if not count:
        return spent, {"seconds": 0.0, "cpu_seconds": 0.0}, None
    blocks = -(-count // block_size(job.resolution))
    create_outputs(writer, job, count, RUN)
    begun, processes, others, none = Meter(), 1, 0.0, None
    if prepared.checked and prepared.moving is None:
        asked = (writer, prepared.config, prepared.scene, prepared.source, prepared.bounces)
        measure_light(*asked)  # loads kernels, as every run has to
        start = begun.read()
        none = measure_light(*asked)
        begun = Meter()
    else:
        start = dict.fromkeys(("seconds", "cpu_seconds"), 0.0)
    if blocks > 1 and workers > 1:  # in other processes, which have to start
        before, processes = children_seconds(), min(workers, blocks)
        subprocess.run([sys.executable, "-c", f"import {VisibilityJob.__module__}"], check=True)
        others = (children_seconds() - before) * processes
    worker = job.open()
    every = -(-count // RUN)
    chosen = np.unique(np.linspace(0, every - 1, round(min(max(FEWEST, PART * every), MOST))).round().astype(int))
    runs = [slice(RUN * k, min(count, RUN * (k + 1))) for k in chosen.tolist()]
    worker.run(run.Block("first", runs[0].start, runs[0].stop))
    first = begun.read()
    start["seconds"] += first["seconds"]
    start["cpu_seconds"] += processes * first["cpu_seconds"] + others  # each of them loads kernels
    traced = sum(rows.stop - rows.start for rows in runs)
    costs: dict[str, float] = {}
    for number, rows in enumerate(runs):
        meter = Meter()
        found = worker.run(run.Block(f"run/{number}", rows.start, rows.stop))
        whole = meter.read()
        # Light in another basis is no part of its own.
        for key in ("seconds", "cpu_seconds"):
            found[f"rest_{key}"] = whole[key] - sum(found.get(f"{part}_{key}", 0.0) for part, _ in PARTS.values())
        costs = {key: costs.get(key, 0.0) + value for key, value in found.items()}
    # The share of all receivers that the busiest process has.
    share = min(1.0, -(-blocks // min(workers, blocks)) / blocks)
    for name, (part, prefix) in PARTS.items():
        if f"{part}_rays" in costs:
            size = _bytes(writer.partial_path / prefix)
            seconds, cpu = costs[f"{part}_seconds"], costs[f"{part}_cpu_seconds"]
            spent[name][:] = costs[f"{part}_rays"], share * seconds, size, cpu
    if job.basis != "visibility":
        size = _bytes(writer.partial_path / "direct")
        spent["basis"] = np.array([0.0, share * costs["rest_seconds"], size, costs["rest_cpu_seconds"]])
    for cost in spent.values():
        cost *= count / traced
    light = None if none is None else measure_light(*asked, runs).grown(none, count / traced)
    return spent, start, light


def _bytes(folder: Path) -> int:
    """Of the chunks of arrays below a folder."""
    return sum(f.stat().st_size for f in folder.rglob("c*") if f.is_file() and f.name.split(".")[0] == "c")


def _pose_cost(
    config: Config, geometry: Geometry, both: NDArray[np.bool_], traced: NDArray[np.float64]
) -> NDArray[np.float64]:
    """As `_pilot`'s, of the frames of skinned objects, at the speed of the rays of `traced`. both (O,): whose back is
    lit too."""
    rigs = [(rig, both[geometry.object_names.index(name)]) for name, rig in geometry.rigs.items() if rig.clips]
    samples = sum(
        len(choose_frames(rig, config.pose_frames)) * len(rig.position) * (2 if backs else 1) for rig, backs in rigs
    )
    rays = samples * config.pose_directions
    seconds, cpu = rays * traced[[1, 3]] / traced[0] if traced[0] else (0.0, 0.0)
    return np.array([rays, seconds, 2.0 * samples * config.pose_order**2, cpu])  # float16
