"""Stage cluster, of light: a transfer store in; out come its receivers with the sky in clusters of lights.

The lights are the texels of a cube of any resolution. Cells of it are refined until one visible fraction per receiver
stands for all the lights of a cell [Johan and Nishita, sec. 4]. Visibility beyond the texels of the transfer store is
traced on demand (`core.transport.light_vectors`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli import __version__
from relightcli.adapters.files import need_output
from relightcli.core.brdf.models import pack_materials, widen
from relightcli.core.lights import quadtree
from relightcli.core.lights.latlong import LUMINANCE
from relightcli.core.lights.quadtree import Cell
from relightcli.core.shade.cluster_sum import GROUP
from relightcli.core.transport.light_vectors import transpose_bits
from relightcli.core.transport.receivers import receiver_areas
from relightcli.errors import InputError, StoreError
from relightcli.run import blocks as run
from relightcli.run.accounting import Account, Meter
from relightcli.stages.budget import summary
from relightcli.stages.copying import copy_arrays
from relightcli.stages.light_cluster_job import DIFFUSE, LOBE, SCRATCH, ClusterJob, ClusterWorker, as_cell
from relightcli.stages.light_cost import Work, predict_lights
from relightcli.stages.light_factors import put_factors, shining
from relightcli.stages.lighting import SHINY, LightingStore, need_still
from relightcli.stages.outputs import resolve_camera
from relightcli.stages.promise_lights import epsilon_for, keep_lights_promise, need_tolerance

KIND = "light_clusters"
MOST_RESOLUTION = 4096
EPSILON = {"rms": 0.0425, "paper": 5e-5}
CELL = "face_row0_row1_column0_column1"
SPLIT_LEVEL = 3  # cells of this level are refined apart, each in one block
ROUND = 64  # cells that are split in one round of a budget, at least
CLUSTERS = 256  # per block and chunk
RECEIVERS = 16_384  # per chunk


@dataclass(frozen=True)
class Config:
    """Everything that clustering light needs to know.

    epsilon None: what `tolerance` takes, or else the criterion's default. tolerance: relative RMS of exit radiance, all
    stages together; None for that of a store made with one, if it was. lights, seconds: budgets; the cell with the
    largest contribution is then split first. camera: fixes the view, for materials with specular lobes. light_factors:
    what many views need.
    """

    store: Path
    output: Path
    resolution: int = 1024
    epsilon: float | None = None
    tolerance: float | None = None
    allow_miss: bool = False
    criterion: str = "rms"
    lights: int | None = None
    seconds: float | None = None
    camera: str | None = None
    light_factors: bool = False
    seed: int = 0
    workers: int = 1
    scheduler: str | None = None
    overwrite: bool = False
    dry_run: bool = False
    quiet: bool = False


def cluster_lights(config: Config) -> dict[str, Any]:
    """Runs the stage; returns a summary. Raises InputError, StoreError, OSError."""
    started, account = time.perf_counter(), Account()
    epsilon = _check(config)
    need_output(config.output, store=True)
    run.need_scheduler(None if config.dry_run else config.scheduler)
    with account.step("reading"):
        lighting = LightingStore(config.store, config.workers)
    need_still(lighting.store)
    if lighting.store.kind != "transfer":
        raise StoreError(f"{config.store}: expected a store of kind transfer, found {lighting.store.kind}.")
    view = None if config.light_factors else _fixed_view(lighting, config.camera)
    left = need_tolerance(lighting.store, config.tolerance, config.criterion)
    if left is not None and config.epsilon is None:
        epsilon = epsilon_for(left, view is not None)
    settings = {
        **lighting.store.settings,
        "bounces": 0,
        "cluster_resolution": config.resolution,
        "criterion": config.criterion,
        "epsilon": epsilon,
        "lights": config.lights,
        "seconds": config.seconds,
        "camera": None if view is None else view[0],
        "cluster_seed": config.seed,
        **({"light_factors": True} if config.light_factors else {}),
    }
    if left is not None:
        settings["lights_tolerance"] = left.tolerance
    # Lobes that are not baked in are integrated from the bits: every view, and every lobe.
    left_out = (
        ("direct/", "bounce/") if view is None and _may_shine(lighting) else ("visibility/", "direct/", "bounce/")
    )
    copied = [n for n in lighting.store.names() if not n.startswith(left_out)]
    shadows = "shadows" in lighting.store.settings["effects"]
    budget = config.lights is not None or config.seconds is not None
    split = view is not None and config.criterion == "rms" and not budget
    if config.dry_run:

        def put(writer: formats.Writer) -> None:
            _put_receivers(writer, lighting, view)
            if config.light_factors:
                put_factors(writer, lighting)

        work = Work(
            ClusterJob("", config.resolution, epsilon, config.criterion, shadows, view is not None),
            ("diffuse", "lobes") if split else ("all",),
            SPLIT_LEVEL,
            config.lights,
            config.seconds,
            CLUSTERS,
            1 if left is None else 2,
            config.workers,
            put,
            _create_outputs,
        )
        costs, count = predict_lights(lighting, copied, work)
        told: dict[str, Any] = {"dry_run": True, "receivers": len(lighting), "resolution": config.resolution}
        if config.light_factors:
            told["shining_receivers"] = shining(lighting)
        return {**told, "light_clusters": count, "predicted": costs.as_json(account), "notes": []}
    writer = formats.begin(
        config.output,
        KIND,
        settings=settings,
        inputs={"transfer": lighting.store.fingerprint},
        program=f"relightcli {__version__}",
        overwrite=config.overwrite,
    )
    if writer is None:
        return {"store": str(config.output), "status": "up to date", "notes": []}
    with writer:
        resumed = bool(writer.done)
        writer.set_attrs(lighting.store.attrs)
        with account.step("copying"):
            copy_arrays(lighting.store, writer, copied)
        _put_receivers(writer, lighting, view)
        words = -(-len(lighting) // 64)
        base = np.lib.format.open_memmap(
            writer.partial_path / SCRATCH, "w+", np.uint64, (6 * lighting.resolution**2, words)
        )
        with account.step("reading"):
            transpose_bits(lighting.blocks(), base)
            base.flush()
        if config.light_factors:
            with account.step("factors"):
                put_factors(writer, lighting)
        job = ClusterJob(
            str(writer.partial_path), config.resolution, epsilon, config.criterion, shadows, view is not None
        )
        parts = (DIFFUSE, LOBE) if view is not None else (DIFFUSE,)
        with account.step("clusters"):
            if split:
                found = [_refine(replace(job, part=p), writer, config, f"{p}-") for p in ("diffuse", "lobes")]
                leaves = quadtree.overlay(found[0], found[1], config.resolution)
                trees = [_in_order(cells, config.resolution) for cells in found]
            else:
                leaves = _spend(job, writer, config) if budget else _refine(job, writer, config, "")
                leaves = _in_order(leaves, config.resolution)
                trees = [leaves] * len(parts)
        cells = np.array(leaves, np.int32)
        writer.put("light_clusters/cell", cells, dims=("cluster", CELL))
        writer.put(
            "light_clusters/solid_angle",
            quadtree.solid_angles(cells, config.resolution),
            dims=("cluster",),
            units="sr",
        )
        for part, tree in zip(parts, trees, strict=True):
            writer.put(f"light_clusters/{part}", np.array(tree, np.int32), dims=(part, CELL))
        lobed = _lobe_count(writer) if view is not None else 0
        _create_outputs(writer, [len(tree) for tree in trees], len(lighting), lobed)
        blocks = []
        for name, tree in zip(("fraction", "lobe"), trees, strict=False):
            blocks += run.split(name, len(tree), CLUSTERS)
        with account.step("clusters"):
            run.run_blocks(
                job,
                blocks,
                writer,
                workers=config.workers,
                label="clusters",
                quiet=config.quiet,
                scheduler=config.scheduler,
            )
        if "check" not in writer.done:
            writer.record("check", job.open().check(trees[0], config.seed))
        if left is not None:
            with account.step("check"):
                keep_lights_promise(writer, job.open(), trees, left, lighting.store, config.seed, config.allow_miss)
        run.close_worker()
        del base
        writer.commit(summary(account, started, resumed, config.workers, lighting.store))
    return _summary(config, started, resumed)


def _check(config: Config) -> float:
    if not 1 <= config.resolution <= MOST_RESOLUTION:
        raise InputError(f"--light-resolution: expected 1 to {MOST_RESOLUTION}; found {config.resolution}")
    if config.criterion not in EPSILON:
        raise InputError(f"--criterion: expected {' or '.join(EPSILON)}; found {config.criterion!r}")
    epsilon = EPSILON[config.criterion] if config.epsilon is None else config.epsilon
    if not (0.0 <= epsilon < math.inf):
        raise InputError(f"--epsilon: expected 0 or more; found {epsilon}")
    if config.lights is not None and config.lights < 6:
        raise InputError(f"--lights: expected 6 or more, one a face; found {config.lights}")
    if config.light_factors and config.camera is not None:
        raise InputError(
            f"--light-factors: is for every view, and --camera {config.camera} keeps lobes of one; give one of the two"
        )
    if config.seconds is not None and not config.seconds > 0.0:
        raise InputError(f"--seconds: expected more than 0; found {config.seconds}")
    return epsilon


def _fixed_view(lighting: LightingStore, camera: str | None) -> tuple[str, NDArray[np.float32]] | None:
    """Name of the camera and directions to it, (N, 3), where lobes are baked in; None where they are not."""
    shiny = any(m.model in SHINY and any(m.specular) for m in lighting.scene.materials.values())
    if lighting.camera_name is not None:
        if camera not in (None, lighting.camera_name):
            raise InputError(f"--camera {camera}: the receivers are the pixels of camera {lighting.camera_name!r}")
        if not shiny:
            return None
        view = np.zeros((len(lighting), 3), np.float32)
        view[: lighting.pixels] = lighting.store.read("receivers/view")
        return lighting.camera_name, view
    if camera is None:
        return None
    eye = np.array(resolve_camera(camera, lighting.scene.cameras).eye)
    if not shiny:
        return None
    d = eye - lighting.position
    return camera, (d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-300)).astype(np.float32)


def _may_shine(lighting: LightingStore) -> bool:
    """Whether any material has a specular lobe, or may be given one."""
    return any(m.model in SHINY and (m.adjustable or any(m.specular)) for m in lighting.scene.materials.values())


def _put_receivers(
    writer: formats.Writer, lighting: LightingStore, view: tuple[str, NDArray[np.float32]] | None
) -> None:
    """What the measure weighs receivers with, and the lobes that are baked in."""
    if lighting.camera_name is not None:
        area = np.zeros(len(lighting))
        area[: lighting.pixels] = lighting.store.read("receivers/weight")
    else:
        assert lighting.vertex is not None
        area = receiver_areas(lighting.geometry.positions, lighting.geometry.faces, lighting.vertex)
    total = float(area.sum())
    area = area / total if total > 0.0 else np.full(len(area), 1.0 / len(area))
    materials = list(lighting.scene.materials.values())
    of = lighting.geometry.material[lighting.object]
    albedo = np.array([1.0 if m.adjustable else float(np.dot(m.diffuse, LUMINANCE)) for m in materials])
    writer.put("light_clusters/area", area, dims=("receiver",))
    writer.put("light_clusters/reflectance", albedo[of] / np.pi, dims=("receiver",), units="sr-1")
    if view is None:
        return
    table = widen(pack_materials(materials), 0.5 * np.pi / lighting.resolution)
    shiny = np.array([m.model in SHINY and any(m.specular) for m in materials])
    writer.put("light_clusters/view", view[1], dims=("receiver", "axis"))
    writer.put("light_clusters/lobed", np.flatnonzero(shiny[of]).astype(np.int32), dims=("lobed",))
    writer.put("light_clusters/material", of.astype(np.int32), dims=("receiver",))
    writer.put("light_clusters/model", table.model, dims=("material",))
    writer.put("light_clusters/parameters", table.parameters, dims=("material", "parameter"))


def _lobe_count(writer: formats.Writer) -> int:
    return int(formats.worker_array(writer.partial_path, "light_clusters/lobed").shape[0])


def _create_outputs(writer: formats.Writer, parts: list[int], receivers: int, lobed: int) -> None:
    def array(
        name: str, dtype: Any, shape: Sequence[int], dims: tuple[str, ...], text: str, units: str | None = None
    ) -> None:
        writer.array(
            f"light_clusters/{name}",
            shape=tuple(shape),
            dtype=dtype,
            chunks=(CLUSTERS, *(min(n, RECEIVERS) for n in shape[1:])),
            dims=dims,
            units=units,
            attrs={"description": text},
            codec="zstd",
        )

    visible = "visible part of the cluster, in steps of 1/255"
    array("fraction", np.uint8, (parts[0], receivers), (DIFFUSE, "receiver"), visible)
    rms = "largest of the samples' errors by area-weighted RMS, 1 is a light overhead"
    array("error", np.float32, parts[:1], (DIFFUSE,), rms)
    array("paper_error", np.float32, parts[:1], (DIFFUSE,), "the same as in Johan and Nishita, Eq. 11")
    if lobed:
        groups = -(-lobed // GROUP)
        array("lobe_error", np.float32, parts[1:], (LOBE,), rms)
        steps = "transfer by the specular lobe, in steps of the group's scale"
        array("lobe", np.uint8, (parts[1], lobed), (LOBE, "lobed"), steps)
        scale = "a step of `lobe` for 64 receivers"
        array("lobe_scale", np.float32, (parts[1], groups), (LOBE, "lobed_group"), scale, "sr-1")


def _refine(job: ClusterJob, writer: formats.Writer, config: Config, prefix: str) -> list[Cell]:
    """All leaves: the upper levels here, the rest in blocks of one cell each, their names starting with `prefix`."""
    level, leaves = quadtree.roots(config.resolution), []
    top = f"{prefix}roots"
    if top not in writer.done:
        worker = job.open()
        meter = Meter()
        for _ in range(SPLIT_LEVEL):
            inner = [cell for cell in level if not worker.accepts(cell)]
            leaves += [cell for cell in level if cell not in set(inner)]
            level = [part for cell in inner for part in quadtree.children(cell)]
        rays = float(worker.vectors.rays)
        writer.record(top, {**meter.read(), "rays": rays, "leaves": leaves, "cells": level})
    known = {block["id"]: block for block in writer.blocks}
    leaves = [as_cell(c) for c in known[top]["leaves"]]
    cells = [as_cell(c) for c in known[top]["cells"]]
    if not cells:
        return leaves
    run.run_blocks(
        replace(job, cells=tuple(cells)),
        run.split(f"{prefix}refine", len(cells), 1),
        writer,
        workers=config.workers,
        label="light",
        quiet=config.quiet,
        scheduler=config.scheduler,
    )
    for block in writer.blocks:
        if block["id"].startswith(f"{prefix}refine/"):
            leaves += [as_cell(c) for c in block["leaves"]]
    return leaves


def _spend(job: ClusterJob, writer: formats.Writer, config: Config) -> list[Cell]:
    """Leaves within a budget of clusters or seconds: what contributes most to the error is split first."""
    most = math.inf if config.lights is None else config.lights
    worker: ClusterWorker | None = None
    errors: dict[Cell, float] = {}
    fresh, number, spent = quadtree.roots(config.resolution), 0, 0.0
    while True:
        block = f"round/{number:06d}"
        if block not in writer.done:
            worker = worker or job.open()
            meter, rays = Meter(), worker.vectors.rays
            found = [worker.worst(cell) for cell in fresh]
            writer.record(block, {**meter.read(), "rays": float(worker.vectors.rays - rays), "errors": found})
        known = next(b for b in writer.blocks if b["id"] == block)
        spent += known["seconds"]
        errors |= dict(zip(fresh, known["errors"], strict=True))
        number += 1
        # A split adds three clusters.
        able = sorted(
            (cell for cell, error in errors.items() if error >= job.epsilon and quadtree.lights(cell) > 1),
            key=lambda cell: (-errors[cell] * float(quadtree.solid_angles(np.array([cell]), job.resolution)[0]), cell),
        )
        room = min(max(ROUND, len(errors) // 8), (most - len(errors)) // 3)
        if not able or room < 1 or (config.seconds is not None and spent >= config.seconds):
            return list(errors)
        chosen = able[: int(room)]
        for cell in chosen:
            del errors[cell]
        fresh = [part for cell in chosen for part in quadtree.children(cell)]


def _in_order(leaves: list[Cell], resolution: int) -> list[Cell]:
    """Leaves in the order of their trees, so that neighbours stay together."""
    wanted, out = set(leaves), []
    stack = quadtree.roots(resolution)[::-1]
    while stack:
        cell = stack.pop()
        if cell in wanted:
            out.append(cell)
        else:
            stack += quadtree.children(cell)[::-1]
    return out


def _summary(config: Config, started: float, resumed: bool) -> dict[str, Any]:
    store = formats.open_store(config.output, KIND)
    info = {block["id"]: block for block in store.blocks}
    return {
        "store": str(config.output),
        "status": "resumed" if resumed else "written",
        "receivers": int(store.layouts["light_clusters/area"].shape[0]),
        "lights": 6 * config.resolution**2,
        "light_clusters": int(store.layouts["light_clusters/cell"].shape[0]),
        "rays": sum(block.get("rays", 0.0) for block in store.blocks),
        "error": info["check"]["error"],
        **({"measured_error": info["promise"]["share"]} if "promise" in info else {}),
        "bytes": sum(size.stored for size in store.sizes().values()),
        "peak_bytes": max((block.get("peak_bytes", 0.0) for block in store.blocks), default=0.0),
        "seconds": time.perf_counter() - started,
        "notes": [],
    }
