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
from dataclasses import asdict
from typing import Any

import relight_formats as formats
from relightcli import __version__
from relightcli.adapters.files import need_output
from relightcli.core.parts import one_blas_thread
from relightcli.core.pose.pose_model import MODELS, Errors, Report
from relightcli.core.pose.zh_lobes import MOST_LOBES
from relightcli.errors import InputError, StoreError
from relightcli.run.accounting import Account
from relightcli.stages.budget import summary
from relightcli.stages.copying import copy_arrays
from relightcli.stages.measured_error import Draft
from relightcli.stages.pose_cost import predict_fit
from relightcli.stages.pose_fits import LEFT_OUT, SIZES, Fit, fit_object, lit_sides, put_arrays
from relightcli.stages.pose_fits import Config as Config
from relightcli.stages.promise_pose import (
    CHOSEN,
    TRIAL,
    Fitted,
    PoseJudge,
    keep_pose_promise,
    places_between,
    smallest,
)

KIND = "pose"


@one_blas_thread()
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
        told = {"dry_run": True, "objects": [_size(store, k, about) for k, about in poses.items()], "notes": []}
        return {**told, "predicted": predict_fit(config, store, _tolerance(config, store)).as_json(account)}
    tolerance = _tolerance(config, store)
    kept = ("model", "lobes", "axes", "weight", "ridge", "components")
    asked = {**{key: getattr(config, key) for key in kept}, "tolerance": tolerance}
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
        judge = PoseJudge(config.workers)
        with account.step("pose"):
            chosen = _chosen(config, tolerance, store, writer, judge)
            for k, about in poses.items():
                if f"fit/{k}" not in writer.done:
                    _put(writer, k, chosen[k] if k in chosen else fit_object(config, store, k, about, None))
        known = {block["id"].split("/")[1]: block for block in writer.blocks if block["id"].startswith("fit/")}
        writer.set_attrs({"pose_models": {k: known[k]["model"] for k in poses}})
        if tolerance is not None:
            with account.step("check"):
                reports = {k: _report(known[k]["report"]) for k in poses}
                keep_pose_promise(writer, tolerance, judge, reports, config.allow_miss)
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


def _tolerance(config: Config, store: formats.Store) -> float | None:
    """The error to keep: what was asked for, else that of a store made with one."""
    own = store.settings.get("tolerance") if store.settings["basis"] == "visibility" else None
    return config.tolerance if config.tolerance is not None else own


def _chosen(
    config: Config, tolerance: float | None, store: formats.Store, writer: formats.Writer, judge: PoseJudge
) -> dict[str, Fit]:
    """The smallest models whose pictures keep the tolerance, else those as good as any, by object's number; none where
    there is no tolerance, or all were chosen before an interruption."""
    poses: dict[str, Any] = store.attrs["poses"]
    if tolerance is None or all(f"fit/{k}" in writer.done for k in poses):
        return {}
    places = places_between(Draft(writer), TRIAL)
    tried: list[dict[str, Fit]] = []
    shares: list[float] = []
    for size in SIZES:
        fits = {k: fit_object(config, store, k, about, size) for k, about in poses.items()}
        arrays = {f"pose/{k}/model/{name}": array for k, fit in fits.items() for name, array in fit.arrays.items()}
        draft = Fitted(Draft(writer), arrays, {k: fit.about for k, fit in fits.items()})
        tried.append(fits)
        shares.append(judge.trial(draft, places, tolerance).share)
        if shares[-1] <= CHOSEN * tolerance:
            break
    return tried[smallest(shares, tolerance)]


def _report(told: dict[str, Any]) -> Report:
    """The report that `asdict` has made a table of."""
    held_out = told["held_out"] and Errors(**told["held_out"])
    return Report(**{**told, "training": Errors(**told["training"]), "held_out": held_out})


def _put(writer: formats.Writer, k: str, fit: Fit) -> None:
    put_arrays(writer, f"pose/{k}/model", fit.arrays)
    writer.record(f"fit/{k}", {**fit.cost, "model": fit.about, "report": asdict(fit.report)})


def _size(store: formats.Store, k: str, about: dict[str, Any]) -> dict[str, Any]:
    frames, rows, coefficients = store.layouts[f"pose/{k}/visibility"].shape
    sides = lit_sides(store, k, about)
    return {
        "object": about["object"],
        "frames": frames,
        "vertices": rows // sides,
        "sides": sides,
        "coefficients": coefficients,
    }


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
        if report["held_out"] is None:
            notes.append(f"{model['object']}: one run of frames only, so no error of unseen poses was measured")
    return {
        "store": str(config.output),
        "status": "resumed" if resumed else "written",
        "objects": objects,
        **({"measured_error": store.attrs["measured_error"]["share"]} if "measured_error" in store.attrs else {}),
        "bytes": sum(size.stored for size in sizes.values()),
        "seconds": time.perf_counter() - started,
        "notes": notes,
    }
