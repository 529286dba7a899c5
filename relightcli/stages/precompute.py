"""Stage precompute: scene file in, transfer store out. What every receiver sees of the sky, block by block."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

import relight_formats as formats
from relightcli import __version__
from relightcli.adapters.files import need_output
from relightcli.run import blocks as run
from relightcli.run.accounting import Account, children_seconds
from relightcli.scene.build import scene_to_json
from relightcli.scene.model import Geometry
from relightcli.stages.budget import summary
from relightcli.stages.dry_run import dry_run
from relightcli.stages.fields import describe, put_fields
from relightcli.stages.inputs import need_unchanged, scene_inputs
from relightcli.stages.lay_out import make_job, put_scene
from relightcli.stages.pose_job import simulate_poses
from relightcli.stages.precompute_config import Config
from relightcli.stages.prepare import Prepared, prepare
from relightcli.stages.promise import UNDECIDED, Decided, keep_promise, keep_promise_moving, need_reach
from relightcli.stages.promise_moving import choose_fields
from relightcli.stages.visibility_job import block_size, create_outputs

KIND = "transfer"
WRONG_BITS = 1e-3  # share of wrong bits above which the user is told


def precompute(config: Config) -> dict[str, Any]:
    """Runs the stage; returns a summary for the user. Raises the errors of `relightcli.errors` and OSError."""
    started, account = time.perf_counter(), Account()
    before = time.process_time() + children_seconds()
    need_output(config.output, store=True)
    run.need_scheduler(None if config.dry_run else config.scheduler)
    decided = UNDECIDED if config.tolerance is None or config.overwrite else _decided(config.output)
    while isinstance(result := _precompute(config, started, account, decided), Decided):
        decided = result
    if result.get("status") not in ("written", "resumed"):
        return result
    return {**result, "cpu_seconds": time.process_time() + children_seconds() - before}


def _decided(output: Path) -> Decided:
    """What an earlier run, finished or not, has decided."""
    for settings in (lambda: formats.open_store(output).settings, lambda: formats.progress(output)["settings"]):
        with contextlib.suppress(formats.RelightError, OSError, ValueError, TypeError):
            found = settings()
            return Decided(found.get("faces"), max(1.0, float(found.get("care", 1.0))))
    return UNDECIDED


def _precompute(config: Config, started: float, account: Account, decided: Decided) -> dict[str, Any] | Decided:
    """`precompute`; where the tolerance was missed, what to try again with."""
    prepared = prepare(config, account, decided)
    if config.dry_run:
        return dry_run(prepared, account, _settings(prepared))
    inputs = scene_inputs(scene := prepared.scene)
    need_unchanged(prepared.read)
    source, geometry, moving = prepared.source, prepared.geometry, prepared.moving
    writer = formats.begin(
        config.output,
        KIND,
        settings=_settings(prepared),
        inputs=inputs,
        program=f"relightcli {__version__}",
        overwrite=config.overwrite,
    )
    if writer is None:
        return {"store": str(config.output), "status": "up to date", "notes": list(geometry.notes)}
    with writer:
        if prepared.promise is not None:
            need_reach(prepared.config, prepared.promise, scene, prepared.tried, prepared.finer_helps)
        resumed = bool(writer.done)
        with account.step("receivers"):
            receivers, buried, starts = prepared.receivers()
        if moving is not None:
            writer.set_attrs({"fields": describe(moving, scene, starts)})
        writer.set_attrs(
            {
                "scene": scene_to_json(scene, geometry),
                "plan": prepared.plan_rows(),
                "tried": prepared.tried_rows(),
                "nothing_blocks": config.effects == "auto" and not prepared.shadows,
            }
        )
        with account.step("scene"):
            put_scene(writer, prepared, receivers, buried)
        job = make_job(prepared, str(writer.partial_path), receivers, starts)
        with account.step("visibility"):
            size = block_size(prepared.resolution)
            create_outputs(writer, job, len(receivers), size)
            run.run_blocks(
                job,
                run.split("visibility", len(receivers), size),
                writer,
                workers=config.workers,
                label="visibility",
                quiet=config.quiet,
                scheduler=config.scheduler,
            )
            run.close_worker()
        if moving is not None:
            with account.step("fields"):
                if prepared.promise is None:
                    put_fields(writer, moving, scene, config.fields, config.workers, config.quiet, config.scheduler)
                else:
                    choose_fields(config, prepared.promise, scene, source, starts, writer, prepared.posed)
        if "pose" in prepared.simulated:
            with account.step("pose"):
                simulate_poses(
                    writer,
                    scene,
                    geometry,
                    prepared.both,
                    config.pose_frames,
                    config.pose_order,
                    config.pose_directions,
                    config.pose_surroundings,
                    config.workers,
                    config.quiet,
                    config.scheduler,
                )
        if prepared.checked and prepared.promise is not None and moving is not None:
            with account.step("check"):
                keep_promise_moving(config, prepared.promise, scene, source, writer)
        elif prepared.checked and prepared.promise is not None:
            with account.step("check"):
                again = keep_promise(prepared, receivers, buried, writer)
            if again is not None:
                writer.abandon()
                return again
        writer.commit(summary(account, started, resumed, config.workers))
    return _summary(config, started, resumed, geometry)


def _settings(prepared: Prepared) -> dict[str, Any]:
    """What the store depends on, beside its inputs."""
    config = prepared.config
    settings: dict[str, Any] = {
        "effects": prepared.simulated,
        "light_resolution": prepared.resolution,
        "refine": config.refine if prepared.shadows else 1,
        "receivers": config.receivers,
        "subdivide": config.subdivide,
        "basis": config.basis,
        "seed": config.seed,
        "bounces": prepared.bounces,
    }
    if config.grid != 1:
        settings["pixel_grid"] = config.grid
    if prepared.bounce_cells:
        settings["bounce_resolution"] = prepared.bounce_cells
    if prepared.moving is not None:
        settings["fields"] = config.fields.as_json()
    if prepared.promise is not None:
        settings["tolerance"] = prepared.promise
    if prepared.decided.faces is not None:
        settings["faces"] = prepared.decided.faces
    if prepared.decided.care != 1.0:
        settings["care"] = prepared.decided.care
    if config.basis == "haar":
        settings |= {"coefficients": config.coefficients, "tolerance": config.tolerance}
    if "pose" in prepared.simulated:
        settings |= {
            "pose_frames": config.pose_frames,
            "pose_order": config.pose_order,
            "pose_directions": config.pose_directions,
            "pose_surroundings": config.pose_surroundings,
        }
    if config.basis == "sh":
        settings["sh_order"] = config.sh_order
    return settings


def _summary(config: Config, started: float, resumed: bool, geometry: Geometry) -> dict[str, Any]:
    store = formats.open_store(config.output, KIND)
    total = {
        key: sum(b.get(key, 0.0) for b in store.blocks) for key in ("rays", "checked", "wrong", "inferred", "bits")
    }
    # Share of all bits above the horizon that the check predicts to be wrong; what it found was mended.
    wrong = total["wrong"] / total["checked"] * total["inferred"] / total["bits"] if total["checked"] else 0.0
    notes = list(geometry.notes)
    if wrong > WRONG_BITS:
        notes.append(f"{wrong:.1e} of the visibility bits are wrong: fine structures; --refine 2 or 1 traces more")
    return {
        "store": str(config.output),
        "status": "resumed" if resumed else "written",
        "receivers": int(store.array("receivers/side").shape[0]),
        "rays": int(total["rays"]),
        "wrong_bits": wrong,
        "checked_bits": int(total["checked"]),
        "bytes": sum(size.stored for size in store.sizes().values()),
        "peak_bytes": int(max((b.get("peak_bytes", 0.0) for b in store.blocks), default=0)),
        "seconds": time.perf_counter() - started,
        "notes": notes,
    }
