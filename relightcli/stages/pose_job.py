"""precompute for skinned objects: what every vertex sees of the sky in the frames to learn poses from.

In the transfer store, group `pose/K`, K the object's place in the scene: `clip` (frame,) and `seconds` (frame,) of the
frames, `features` (frame, feature), `joint_matrix` (frame, joint, 4, 4) from bind space to the world, `visibility`
(frame, vertex_side, harmonic), and the rig (`rig_store`). Rows of vertex_side are the vertices as they look along their
normals; where the object's back is lit too, they are followed by the same from behind. The root attribute `poses` has
the number of sides, and what the features are called.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.pose.frames import Frames, all_frames, every, spread
from relightcli.core.pose.rig import Rig, blend, feature_names, joint_matrices
from relightcli.core.pose.visibility import both_sides, hemisphere_directions, trace_visibility
from relightcli.errors import InputError
from relightcli.run import blocks as run
from relightcli.scene.model import Geometry, Scene
from relightcli.stages.receiver_setup import hidden
from relightcli.stages.rig_store import pose_group

F64 = NDArray[np.float64]
CHUNK_BYTES = 4_000_000
MOST_FRAMES_PER_BLOCK = 4
MOST_ORDER = 8
MOST_DIRECTIONS = 1 << 16
CHECKED = 16  # vertices of a block's first frame that are traced again, ...
FINER = 8  # with so many times the directions


@dataclass(frozen=True)
class PoseJob:
    """A range of frames of one object: pose it, build a ray tracer, trace every vertex."""

    partial: str
    group: str
    object: int
    order: int
    directions: int
    others: tuple[int, ...]  # skinned objects that stand elsewhere by then
    surroundings: bool
    both: bool  # backs are lit too

    def open(self) -> PoseWorker:
        return PoseWorker(self)


class PoseWorker:
    def __init__(self, job: PoseJob) -> None:
        self.job = job

        def array(name: str) -> Any:
            return formats.worker_array(job.partial, name)

        rig = ("position", "normal", "tangent", "joint", "weight")
        self.skin = [array(f"{job.group}/rig/{name}")[:] for name in rig]
        self.matrices, self.out = array(f"{job.group}/joint_matrix"), array(f"{job.group}/visibility")
        self.positions, faces = array("mesh/position")[:], array("mesh/face")[:]
        owner = array("mesh/face_object")[:]
        self.rows = np.flatnonzero(array("mesh/vertex_object")[:] == job.object)
        self.faces = hidden(faces, owner, job.others) if job.surroundings else faces[owner == job.object]
        self.directions = hemisphere_directions(job.directions)

    def run(self, block: run.Block) -> run.Info:
        found, rays = [], 0
        info: run.Info = {}
        for matrices in self.matrices[block.start : block.stop]:
            points = blend(*self.skin, matrices)  # type: ignore[call-arg]
            self.positions[self.rows] = points[0]
            position, normal, tangent = both_sides(*points) if self.job.both else points
            tracer = Tracer(self.positions, self.faces)
            visibility, more = trace_visibility(tracer, position, normal, tangent, self.directions, self.job.order)
            found.append(visibility)
            rays += more
            if not info:
                info, more = _error(self.job, tracer, position, normal, tangent, visibility)
                rays += more
        self.out[block.start : block.stop] = np.stack(found)
        return {**info, "rays": float(rays), "frames": float(len(found))}


def _error(
    job: PoseJob, tracer: Tracer, position: F64, normal: F64, tangent: F64, visibility: NDArray[np.float32]
) -> tuple[run.Info, int]:
    """Squared error of some vertices' coefficients against finer ones, the squares of these, and the rays."""
    some = np.unique(np.linspace(0, len(position) - 1, CHECKED).astype(np.int64))
    directions = hemisphere_directions(FINER * job.directions)
    finer, rays = trace_visibility(tracer, position[some], normal[some], tangent[some], directions, job.order)
    off = float(((visibility[some] - finer).astype(np.float64) ** 2).sum())
    size = float((finer.astype(np.float64) ** 2).sum())
    return {"vertices_checked": float(len(some)), "squared_error": off, "squared_norm": size}, rays


def check_pose_options(frames: str, order: int, directions: int) -> None:
    """Raises InputError for what `choose_frames` and `PoseJob` cannot do."""
    if frames != "all":
        rule, _, number = frames.partition(":")
        if rule not in ("every", "spread") or not number.isdecimal() or not 1 <= int(number) <= 1_000_000:
            raise InputError(f"--pose-frames: expected all, every:N or spread:N with N from 1; found {frames!r}")
    if not 1 <= order <= MOST_ORDER:
        raise InputError(f"--pose-order: expected 1 to {MOST_ORDER}; found {order}")
    if not 16 <= directions <= MOST_DIRECTIONS:
        raise InputError(f"--pose-directions: expected 16 to {MOST_DIRECTIONS}; found {directions}")


def choose_frames(rig: Rig, rule: str) -> Frames:
    """The frames that `--pose-frames` asks for, once checked."""
    frames = all_frames(rig)
    if rule == "all":
        return frames
    kind, _, number = rule.partition(":")
    return every(frames, int(number)) if kind == "every" else spread(frames, int(number))


def simulate_poses(
    writer: formats.Writer,
    scene: Scene,
    geometry: Geometry,
    both: NDArray[np.bool_],
    rule: str,
    order: int,
    directions: int,
    surroundings: bool,
    workers: int,
    quiet: bool,
    scheduler: str | None = None,
) -> None:
    """Lays down and traces the frames of every skinned object that has clips. both (O,): whose back is lit too."""
    about = {}
    for name, rig in geometry.rigs.items():
        if not rig.clips:
            continue
        group = pose_group(geometry.object_names, name)
        frames = choose_frames(rig, rule)
        _put_frames(writer, group, scene, name, rig, frames)
        own = geometry.object_names.index(name)
        sides = 2 if both[own] else 1
        features = list(feature_names(rig))
        about[group.split("/")[1]] = {"object": name, "features": features, "order": order, "sides": sides}
        rows = sides * len(rig.position)
        row = 2 * rows * order * order
        size = max(1, min(MOST_FRAMES_PER_BLOCK, CHUNK_BYTES // row))
        writer.array(
            f"{group}/visibility",
            shape=(len(frames), rows, order * order),
            dtype=np.float16,  # rounds by 2e-4 of a number; the rays leave 5e-3 of the norm
            chunks=(size, rows, order * order),
            dims=("frame", "vertex_side", "harmonic"),
            attrs={
                "description": "visibility in the vertex's frame: x tangent, y normal x tangent, z normal; of backs, "
                "after all fronts, with the normal turned round"
            },
        )
        others = tuple(geometry.object_names.index(other) for other in geometry.rigs if other != name)
        job = PoseJob(str(writer.partial_path), group, own, order, directions, others, surroundings, sides == 2)
        blocks = run.split(group, len(frames), size)
        label = f"poses of {name}"
        run.run_blocks(job, blocks, writer, workers=workers, label=label, quiet=quiet, scheduler=scheduler)
        run.close_worker()
    writer.set_attrs({"poses": about})


def _put_frames(writer: formats.Writer, group: str, scene: Scene, name: str, rig: Rig, frames: Frames) -> None:
    transform = scene.objects[name].transform
    matrices = [
        transform @ joint_matrices(rig, rig.clips[clip], float(seconds))
        for clip, seconds in zip(frames.clip, frames.seconds, strict=True)
    ]
    writer.put(f"{group}/clip", frames.clip, dims=("frame",))
    writer.put(f"{group}/seconds", frames.seconds, dims=("frame",), units="s")
    writer.put(f"{group}/features", frames.features, dims=("frame", "feature"))
    writer.put(f"{group}/joint_matrix", np.array(matrices), dims=("frame", "joint", "matrix_row", "matrix_column"))
