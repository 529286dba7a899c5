"""Stage fit-pose: a transfer store in, a store that skinned objects are posed from out. [Nowrouzezahrai 2008]

Per skinned object the visibility of its training frames becomes a linear model of the pose (`core.pose.pose_model`),
quantised: intercepts and mean axes float32, slopes int8 with a scale each. The training data stay behind; everything
else of the transfer store comes along, so that the pose store lights what stands still as the transfer store does.

Arrays, group `pose/K/model`: `intercept` (vertex_side, number), `slope` (vertex_side, number, component),
`slope_scale`, `centre` (vertex_side, lobe, axis), `pose_mean` (feature,), `pose_direction` (feature, component): with
features a, numbers = intercept + slope ((a - pose_mean) pose_direction). Rows of vertex_side are those of the training
data (`pose_job`). `pose/K/features` of the training frames stay, to tell how far from them a pose is. What the numbers
mean is in the root attribute `pose_models`, by K.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli import __version__
from relightcli.adapters.files import need_output
from relightcli.core.pose.pose_model import MODELS, PoseModel, Report, Settings, fit_model
from relightcli.core.pose.zh_lobes import MOST_LOBES
from relightcli.errors import InputError, NumericalError, StoreError
from relightcli.run.accounting import Account, Meter
from relightcli.stages.budget import summary
from relightcli.stages.cluster import copy_arrays

KIND = "pose"
LEFT_OUT = ("visibility", "joint_matrix")  # of an object's training data
# What --tolerance chooses from, the smallest first.
SIZES = (("lobes", 1), ("lobes", 2), ("sh", 0))


@dataclass(frozen=True)
class Config:
    """Everything that `fit-pose` needs to know. tolerance: relative error of held-out frames that picks model and
    lobes, None to take those given."""

    store: Path
    output: Path
    model: str = "lobes"
    lobes: int = 2
    axes: str = "log"
    weight: str = "none"
    ridge: float | None = None
    components: int = Settings.components
    tolerance: float | None = None
    workers: int = 1
    overwrite: bool = False
    dry_run: bool = False
    quiet: bool = False


def fit_pose(config: Config) -> dict[str, Any]:
    """Runs the stage; returns a summary. Raises InputError, StoreError, NumericalError, OSError."""
    started, account = time.perf_counter(), Account()
    _check(config)
    need_output(config.output, store=True)
    store = formats.open_store(config.store)
    if store.kind != "transfer":
        raise StoreError(f"{config.store}: expected a store of kind transfer, found {store.kind}.")
    poses: dict[str, Any] = store.attrs.get("poses", {})
    if not poses:
        raise StoreError(
            f'{config.store}: holds no poses to learn from; expected an object with motion = "skinned" and clips, '
            "and the effect pose, which goes with --receivers vertices."
        )
    if config.dry_run:
        return {"dry_run": True, "objects": [_size(store, k, about) for k, about in poses.items()], "notes": []}
    asked = {
        key: getattr(config, key) for key in ("model", "lobes", "axes", "weight", "ridge", "components", "tolerance")
    }
    writer = formats.begin(
        config.output,
        KIND,
        settings={**store.settings, "fit_pose": asked},
        inputs={"transfer": store.fingerprint},
        program=f"relightcli {__version__}",
        overwrite=config.overwrite,
    )
    if writer is None:
        return {"store": str(config.output), "status": "up to date", "notes": []}
    with writer:
        resumed = bool(writer.done)
        writer.set_attrs(store.attrs)
        left_out = {f"pose/{k}/{name}" for k in poses for name in LEFT_OUT}
        with account.step("copying"):
            copy_arrays(store, writer, [name for name in store.names() if name not in left_out])
        with account.step("pose"):
            for k, about in poses.items():
                if f"fit/{k}" not in writer.done:
                    _fit(config, store, writer, k, about)
        kept = {block["id"].split("/")[1]: block for block in writer.blocks if block["id"].startswith("fit/")}
        writer.set_attrs({"pose_models": {k: kept[k]["model"] for k in poses}})
        writer.commit(summary(account, started, resumed, config.workers, store))
    return _summary(config, started, resumed)


def _check(config: Config) -> None:
    if config.model not in MODELS:
        raise InputError(f"--model: expected one of {', '.join(MODELS)}; found {config.model!r}")
    if not 1 <= config.lobes <= MOST_LOBES:
        raise InputError(f"--lobes: expected 1 to {MOST_LOBES}; found {config.lobes}")
    if config.axes not in ("log", "angles"):
        raise InputError(f"--axes: expected log or angles; found {config.axes!r}")
    if config.weight not in ("none", "cosine"):
        raise InputError(f"--weight: expected none or cosine; found {config.weight!r}")
    for name, value, least in (("--ridge", config.ridge, 0.0), ("--tolerance", config.tolerance, 1e-6)):
        if value is not None and not (math.isfinite(value) and value >= least):
            raise InputError(f"{name}: expected a finite number of at least {least:g}; found {value}")
    if config.components < 1:
        raise InputError(f"--components: expected at least 1; found {config.components}")


def _fit(config: Config, store: formats.Store, writer: formats.Writer, k: str, about: dict[str, Any]) -> None:
    meter = Meter()
    read: Any = store.read
    features: NDArray[np.float64] = read(f"pose/{k}/features")
    visibility: NDArray[np.float32] = read(f"pose/{k}/visibility").astype(np.float32)
    clip: NDArray[np.int32] = read(f"pose/{k}/clip")
    sides = _sides(store, k, about)
    settings = Settings(config.model, config.lobes, config.axes, config.weight, config.ridge, config.components)
    try:
        chosen, model, report, met = _choose(config.tolerance, settings, features, visibility, clip, config.workers)
    except ValueError as error:
        raise NumericalError(f"{config.store}: pose/{k} of {about['object']!r}: {error}") from None
    _put(writer, f"pose/{k}/model", model)
    writer.record(
        f"fit/{k}",
        {
            **meter.read(),
            "frames": len(features),
            "vertices": visibility.shape[1] // sides,
            "model": {
                "object": about["object"],
                "model": chosen.kind,
                "lobes": chosen.lobes if chosen.kind == "lobes" else 0,
                "axes": chosen.axes,
                "weight": chosen.weight,
                "order": model.order,
                "sides": sides,
                "ridge": report.ridge,
                "rank": report.rank,
                "components": report.components,
                "gap": report.gap,
            },
            "report": asdict(report),
            "within_tolerance": met,
        },
    )


def _choose(
    tolerance: float | None,
    settings: Settings,
    features: NDArray[np.float64],
    visibility: NDArray[np.float32],
    clip: NDArray[np.int32],
    threads: int,
) -> tuple[Settings, PoseModel, Report, bool | None]:
    """The model that was asked for; or the smallest within the tolerance, else the best, and whether it is within."""
    if tolerance is None:
        return settings, *fit_model(features, visibility, clip, settings, threads), None
    best: tuple[float, Settings, PoseModel, Report] | None = None
    for kind, lobes in SIZES:
        tried = replace(settings, kind=kind, lobes=max(1, lobes))
        model, report = fit_model(features, visibility, clip, tried, threads)
        error = (report.held_out or report.training).bands
        if error <= tolerance:
            return tried, model, report, True
        if best is None or error < best[0]:
            best = (error, tried, model, report)
    assert best is not None
    return *best[1:], False


def _put(writer: formats.Writer, group: str, model: PoseModel) -> None:
    codes, scale = formats.quantise(model.slope, "int8", axis=2)
    writer.put(f"{group}/intercept", model.intercept.astype(np.float32), dims=("vertex_side", "number"), codec="zstd")
    writer.put(
        f"{group}/slope",
        codes,
        dims=("vertex_side", "number", "component"),
        attrs={"scale": f"{group}/slope_scale"},
        codec="zstd",
    )
    writer.put(f"{group}/slope_scale", scale, dims=("vertex_side", "number", "one_component"), codec="zstd")
    writer.put(f"{group}/centre", model.centre.astype(np.float32), dims=("vertex_side", "lobe", "axis"), codec="zstd")
    writer.put(f"{group}/pose_mean", model.mean, dims=("feature",))
    writer.put(f"{group}/pose_direction", model.directions, dims=("feature", "component"))


def _size(store: formats.Store, k: str, about: dict[str, Any]) -> dict[str, Any]:
    frames, rows, coefficients = store.layouts[f"pose/{k}/visibility"].shape
    sides = _sides(store, k, about)
    return {
        "object": about["object"],
        "frames": frames,
        "vertices": rows // sides,
        "sides": sides,
        "coefficients": coefficients,
    }


def _sides(store: formats.Store, k: str, about: dict[str, Any]) -> int:
    """At how many sides an object's vertices were traced: 1, or 2 where its back is lit too."""
    sides, rows = about.get("sides"), store.layouts[f"pose/{k}/visibility"].shape[1]
    vertices = store.layouts[f"pose/{k}/rig/position"].shape[0]
    if sides not in (1, 2) or rows != sides * vertices:
        raise StoreError(
            f"{store.path}: pose/{k}/visibility: expected rows for 1 or 2 sides (poses.{k}.sides) of {vertices} "
            f"vertices, found {rows} rows and {sides!r} sides. Precompute it again."
        )
    return int(sides)


def _summary(config: Config, started: float, resumed: bool) -> dict[str, Any]:
    store = formats.open_store(config.output, KIND)
    sizes = store.sizes()
    objects, notes = [], []
    for block in store.blocks:
        if not block["id"].startswith("fit/"):
            continue
        group = f"pose/{block['id'].split('/')[1]}/model/"
        model, report = block["model"], block["report"]
        objects.append(
            {
                **model,
                "seconds": block["seconds"],
                "frames": block["frames"],
                "vertices": block["vertices"],
                "bytes": sum(size.stored for name, size in sizes.items() if name.startswith(group)),
                "training": report["training"],
                "held_out": report["held_out"],
            }
        )
        if block["within_tolerance"] is False:
            error = (report["held_out"] or report["training"])["bands"]
            notes.append(
                f"{model['object']}: --tolerance {config.tolerance:g} is not reached; the best errs by {error:.3f}"
            )
        if report["held_out"] is None:
            notes.append(f"{model['object']}: one run of frames only, so no error of unseen poses was measured")
    return {
        "store": str(config.output),
        "status": "resumed" if resumed else "written",
        "objects": objects,
        "bytes": sum(size.stored for size in sizes.values()),
        "seconds": time.perf_counter() - started,
        "notes": notes,
    }
