"""Posed characters: what the models of visibility lose, weigh and cost, on a limb of three bones made here.

The limb bends and twists by three clips whose angles are sums of sines. Errors are those of the fit's report: relative
RMS of four bands of visibility, at the training frames and at frames that were held out, and against all of visibility
as it was traced. Two tables are the paper's Fig. 3 (weights) and 5 (lobes) in numbers: mean and
standard deviation over the frames; `pose-fig3` and `pose-fig5`, `.png` and `.svg` beside the results, are the curves.
Rates are of vertex colours, without the mesh and the picture. Whole characters are in `pose_rigs.py`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.pose_figures import Training, figures
from benchmarks.pose_rigs import measure_rigs
from benchmarks.processes import cores
from benchmarks.report import Report, Row, Table, at_most
from benchmarks.scenes import Setting, shared_data
from relight_formats import open_store, quantise
from relightcli.adapters.rays import Tracer
from relightcli.core.pose.clip import Channel, Clip
from relightcli.core.pose.phong_operator import phong_factors
from relightcli.core.pose.pose_model import (
    PoseModel,
    Settings,
    fit_model,
)
from relightcli.core.pose.rig import Rig, any_tangents, clip_features, joint_matrices, skin
from relightcli.core.pose.shading import lighting, shade, synthesis
from relightcli.core.pose.visibility import hemisphere_directions, trace_visibility
from relightcli.core.sphere import sh

BONES, LENGTH, RADIUS = 3, 1.0, 0.22
VARIANTS = (
    ("2 lobes", Settings()),
    ("1 lobe", Settings(lobes=1)),
    ("3 lobes", Settings(lobes=3)),
    ("2 lobes, polar angles", Settings(axes="angles")),
    ("2 lobes, cosine-weighted", Settings(weight="cosine")),
    ("sh", Settings(kind="sh")),
    ("reduced", Settings(kind="reduced")),
)
SHADED = 10_000  # vertices of the rates and sizes
REPEATS = 15


def limb(around: int, along: int) -> tuple[Rig, NDArray[np.int32]]:
    """A tube along y over three bones with blended weights, and its faces."""
    height = np.linspace(0.0, BONES * LENGTH, along)
    phi = 2.0 * math.pi * np.arange(around) / around
    y, f = np.meshgrid(height, phi, indexing="ij")
    normal = np.stack([np.cos(f), 0.0 * y, np.sin(f)], -1).reshape(-1, 3)
    position = RADIUS * normal + np.stack([0.0 * y, y, 0.0 * y], -1).reshape(-1, 3)
    bone = position[:, 1] / LENGTH - 0.5
    low = np.clip(np.floor(bone), 0, BONES - 2).astype(np.int32)
    blend = np.clip((bone - low - 0.5) / 0.4 + 0.5, 0.0, 1.0)  # over two fifths of a bone about each joint
    k, i = np.arange(along - 1)[:, None] * around, np.arange(around)
    a, b = k + i, k + (i + 1) % around
    faces = np.stack([a, a + around, b, b, a + around, b + around], -1).reshape(-1, 3)
    shift = np.tile(np.eye(4), (BONES, 1, 1))
    shift[1:, 1, 3] = LENGTH
    inverse = np.tile(np.eye(4), (BONES, 1, 1))
    inverse[:, 1, 3] = -LENGTH * np.arange(BONES)
    rig = Rig(
        position=position,
        normal=normal,
        tangent=any_tangents(normal),
        joint=np.stack([low, low + 1], 1),
        weight=np.stack([1.0 - blend, blend], 1),
        inverse_bind=inverse,
        parent=np.arange(-1, BONES - 1, dtype=np.int32),
        rest=shift,
        translation=shift[:, :3, 3],
        rotation=np.tile([0.0, 0.0, 0.0, 1.0], (BONES, 1)),
        scale=np.ones((BONES, 3)),
        joint_node=np.arange(BONES, dtype=np.int32),
        node_names=tuple(f"bone{n}" for n in range(BONES)),
        clips=tuple(_clip(n) for n in range(3)),
    )
    return rig, faces.astype(np.int32)


def _clip(number: int) -> Clip:
    seconds = np.linspace(0.0, 2.0, 41)
    channels = []
    for bone in range(1, BONES):
        phase = 1.3 * number + 0.9 * bone
        bend = 1.3 * np.sin(math.pi * seconds * (1 + number) / 2 + phase)
        twist = 0.5 * np.sin(math.pi * seconds + 2.1 * phase)
        s, c = np.sin(bend / 2), np.cos(bend / 2)
        u, v = np.sin(twist / 2), np.cos(twist / 2)
        # About z, then about y: (0, 0, s, c) times (0, u, 0, v).
        turn = np.stack([-s * u, c * u, s * v, c * v], 1)
        channels.append(Channel(bone, "rotation", "LINEAR", seconds, turn))
    return Clip(f"motion{number}", tuple(channels))


def train(
    rig: Rig, faces: NDArray[np.int32], frames: int, directions: int
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.int32], float]:
    """Features, visibility and clips of `frames` frames of each clip; and rays per second, of one process."""
    local = hemisphere_directions(directions)
    features, seen, clip, rays = [], [], [], 0
    started = time.perf_counter()
    for number, motion in enumerate(rig.clips):
        seconds = np.linspace(motion.start, motion.stop, frames)
        features.append(clip_features(rig, motion, seconds))
        for moment in seconds:
            position, normal, tangent = skin(rig, joint_matrices(rig, motion, float(moment)))
            found, more = trace_visibility(Tracer(position, faces), position, normal, tangent, local, 4)
            seen.append(found)
            clip.append(number)
            rays += more
    rate = rays / (time.perf_counter() - started)
    return np.concatenate(features), np.array(seen), np.array(clip, np.int32), rate


def measure(setting: Setting) -> Report:
    around, along, frames, directions = (12, 16, 7, 64) if setting.quick else (32, 64, 36, 1024)
    rig, faces = limb(around, along)
    features, seen, clip, rate = train(rig, faces, frames, directions)
    count = SHADED // 20 if setting.quick else SHADED
    report = Report(
        f"{len(rig.position)} vertices, {len(features)} frames of {len(rig.clips)} clips, {directions} rays a vertex "
        f"and frame; rates and sizes for {count} vertices, on {cores()} cores"
    )
    report.rows.append(Row("visibility traced, one process", rate / 1e6, "Mray/s"))
    rows: list[tuple[Any, ...]] = []
    some = np.arange(count) % seen.shape[1]
    whole = np.ascontiguousarray(seen[:, some])
    fit_model(features, seen[:, :8], clip, Settings())  # compiled before it is timed
    for name, settings in VARIANTS:
        found = fit_model(features, seen, clip, settings, cores())[1]
        started = time.perf_counter()
        large, _ = fit_model(features, whole, clip, settings, cores())
        seconds = time.perf_counter() - started
        size, hertz = _size_and_rate(large, settings)
        held = found.held_out or found.training
        rows.append(
            (
                name,
                found.training.bands,
                found.training.sd,
                held.bands,
                held.sd,
                "" if held.model is None or held.projection is None else held.model / held.projection,
                seconds,
                size / 1e6,
                hertz,
            )
        )
        if name == "2 lobes":
            report.rows += [
                at_most(f"fit of {count} vertices and {len(features)} frames", seconds, "s", 10.0),
                at_most(f"model of {count} vertices", size / 1e6, "MB", 5.0),
                Row(f"lighting of {count} vertices", hertz, "Hz", target=">= 200 Hz", met=hertz >= 200.0),
                at_most(
                    "held-out visibility: error over that of four bands",
                    (held.model or 0) / (held.projection or 1),
                    "",
                    1.5,
                ),
            ]
    report.tables.append(
        Table(
            "models of visibility",
            (
                "model",
                "training error",
                "sd",
                "held-out error",
                "sd",
                "held-out, over four bands' error",
                "fit, s",
                "MB",
                "Hz",
            ),
            tuple(rows),
        )
    )
    rigs = {"limb": (features, seen, clip)}
    data = shared_data()
    if data is None:
        report.skipped.append("CesiumMan, Fox and CMU motion: no test data")
    else:
        for name, transfer in measure_rigs(setting, data, report):
            rigs[name] = _training(transfer)
    figures(report, setting.work.parent, rigs, cores())
    return report


def _training(transfer: Path) -> Training:
    read: Any = open_store(transfer).read
    return read("pose/0/features"), read("pose/0/visibility").astype(np.float32), read("pose/0/clip")


def _size_and_rate(model: PoseModel, settings: Settings) -> tuple[int, float]:
    """Bytes of the model as it is stored, before compression, and frames of vertex colours per second."""
    codes, scale = quantise(model.slope, "int8", axis=2)
    own = synthesis(
        model.intercept.astype(np.float32),
        scale[:, :, 0],
        codes,
        model.centre.astype(np.float32),
        settings.axes,
        model.order,
    )
    size = own.intercept.nbytes + own.scale.nbytes + own.code.nbytes + 4 * model.centre.size
    rng = np.random.default_rng(0)
    count = len(own.intercept)
    turns = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0].astype(np.float32)
    axis, kernel = np.ascontiguousarray(turns[:, 2]), np.zeros(count, np.int32)
    light = sh.harmonics(np.array([[0.6, 0.8, 0.0]]), 10)[0][:, None] * np.array([1.0, 0.9, 0.7])
    kappa = np.array([4.0]) if settings.weight == "cosine" else phong_factors(1.0, 2 * model.order - 1)

    def frame() -> None:
        scores = rng.normal(size=model.directions.shape[1])
        shade(own, scores, turns, axis, kernel, [lighting(kappa, light, model.order)], cores())

    return size, 1.0 / _best(frame)


def _best(work: Callable[[], None]) -> float:
    """Seconds of the fastest of some runs: others share the machine."""
    seconds = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - started)
    return min(seconds)
