"""Models of what characters see, fitted object by object, and their arrays in a pose store."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.core.pose.pose_model import PoseModel, Report, Settings, fit_model
from relightcli.errors import NumericalError, StoreError
from relightcli.run.accounting import Meter

LEFT_OUT = ("visibility", "joint_matrix")  # of an object's training data
# What --tolerance chooses from, the smallest first.
SIZES = (("lobes", 1), ("lobes", 2), ("sh", 0))
DIMS = {
    "intercept": ("vertex_side", "number"),
    "slope": ("vertex_side", "number", "component"),
    "slope_scale": ("vertex_side", "number", "one_component"),
    "centre": ("vertex_side", "lobe", "axis"),
    "pose_mean": ("feature",),
    "pose_direction": ("feature", "component"),
}


@dataclass(frozen=True)
class Config:
    """Everything that `fit-pose` needs to know. tolerance: relative RMS error of radiance that picks model and lobes;
    None for the store's, if it has one, else to take those given."""

    store: Path
    output: Path
    model: str = "lobes"
    lobes: int = 2
    axes: str = "log"
    weight: str = "none"
    ridge: float | None = None
    components: int = Settings.components
    tolerance: float | None = None
    allow_miss: bool = False
    workers: int = 1
    overwrite: bool = False
    dry_run: bool = False
    quiet: bool = False


@dataclass(frozen=True)
class Fit:
    """A model of one object: what the store says of it, the report, what it cost, and its arrays by name."""

    about: dict[str, Any]
    report: Report
    cost: dict[str, Any]
    arrays: dict[str, NDArray[Any]]


def fit_object(
    config: Config,
    store: formats.Store,
    k: str,
    about: dict[str, Any],
    size: tuple[str, int] | None,
    rows: int | None = None,
) -> Fit:
    """The model of an object that was asked for, or of that kind and number of lobes; rows: of its first vertices."""
    meter = Meter()
    read: Any = store.read
    features: NDArray[np.float64] = read(f"pose/{k}/features")
    visibility: NDArray[np.float32] = read(f"pose/{k}/visibility")[:, :rows].astype(np.float32)
    clip: NDArray[np.int32] = read(f"pose/{k}/clip")
    sides = lit_sides(store, k, about)
    kind, lobes = size or (config.model, config.lobes)
    chosen = Settings(kind, max(1, lobes), config.axes, config.weight, config.ridge, config.components)
    try:
        model, report = fit_model(features, visibility, clip, chosen, config.workers)
    except ValueError as error:
        raise NumericalError(f"{config.store}: pose/{k} of {about['object']!r}: {error}") from None
    told = {
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
    }
    cost = {**meter.read(), "frames": len(features), "vertices": visibility.shape[1] // sides}
    return Fit(told, report, cost, arrays(model))


def arrays(model: PoseModel) -> dict[str, NDArray[Any]]:
    """What the store has of a model, by name."""
    codes, scale = formats.quantise(model.slope, "int8", axis=2)
    return {
        "intercept": model.intercept.astype(np.float32),
        "slope": codes,
        "slope_scale": scale,
        "centre": model.centre.astype(np.float32),
        "pose_mean": model.mean,
        "pose_direction": model.directions,
    }


def put_arrays(writer: formats.Writer, group: str, arrays: dict[str, NDArray[Any]]) -> None:
    for name, dims in DIMS.items():
        attrs = {"scale": f"{group}/slope_scale"} if name == "slope" else None
        codec: Any = "zstd" if dims[0] == "vertex_side" else "lz4"
        writer.put(f"{group}/{name}", arrays[name], dims=dims, attrs=attrs, codec=codec)


def lit_sides(store: formats.Store, k: str, about: dict[str, Any]) -> int:
    """At how many sides an object's vertices were traced: 1, or 2 where its back is lit too."""
    sides, rows = about.get("sides"), store.layouts[f"pose/{k}/visibility"].shape[1]
    vertices = store.layouts[f"pose/{k}/rig/position"].shape[0]
    if sides not in (1, 2) or rows != sides * vertices:
        raise StoreError(
            f"{store.path}: pose/{k}/visibility: expected rows for 1 or 2 sides (poses.{k}.sides) of {vertices} "
            f"vertices, found {rows} rows and {sides!r} sides. Precompute it again."
        )
    return int(sides)
