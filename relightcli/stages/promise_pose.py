"""`fit-pose --tolerance`: a model of visibility that keeps it, in pictures of poses that nothing was learnt from.

Models are fitted from small to large until pictures of characters between their training frames, every effect together,
are near enough to path tracing. The check at the end takes other moments, views and skies. Where objects may be moved
as well, every second picture has them elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.pose.pose_model import Report
from relightcli.errors import NumericalError
from relightcli.plan import pilot
from relightcli.plan.pilot import NOTHING, Share
from relightcli.scene.model import Camera
from relightcli.stages.lighting import read_scene
from relightcli.stages.measured_error import (
    GAIN,
    MORE,
    Draft,
    Judge,
    Sky,
    check_skies,
    check_views,
    edit_of,
    vertex_strips,
)
from relightcli.stages.posed import PoseStore
from relightcli.stages.posed_moving import PosedMovingStore
from relightcli.stages.promise_moving import free_moves

CHOSEN = 0.8  # of the tolerance: what pictures that a model is chosen by may be off by
# Poses, as where among the gaps between training frames, and where in such a gap: to choose by, and of the check.
TRIAL = ((0.3, 0.5), (0.8, 0.5))
CHECK = ((0.1, 0.35), (0.55, 0.65))
# Where moves begin to look for their way, in azimuths (`promise_moving.free_moves`).
TURNS: dict[tuple[tuple[float, float], ...], float] = {TRIAL: 1.7, CHECK: 6.4}
Place = tuple[tuple[str, ...], tuple[str, ...]]  # what `--pose` and `--move` take


class Fitted:
    """A store, unfinished or not, with models that are not in it. arrays: by name; about: the root attribute
    `pose_models`."""

    def __init__(self, base: Draft | formats.Store, arrays: dict[str, NDArray[Any]], about: dict[str, Any]) -> None:
        self._base, self._arrays = base, arrays
        self.attrs = {**base.attrs, "pose_models": about}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._base, name)

    def __contains__(self, name: object) -> bool:
        return name in self._base

    def read(self, name: str) -> NDArray[Any]:
        found: Any = self._arrays[name] if name in self._arrays else self._base.read(name)
        return found  # type: ignore[no-any-return]


Posable = Draft | Fitted | formats.Store


@dataclass
class PoseJudge:
    """Path tracing of posed characters, kept from one model to the next."""

    threads: int
    known: dict[Place, Judge] = field(default_factory=dict)

    def error(
        self,
        store: Posable,
        places: list[Place],
        cameras: list[Camera] | None,
        skies: dict[str, Sky],
        most: float,
    ) -> Share:
        """The largest error over places, views and skies. cameras: those of the check if None."""
        lighting = _open(store, self.threads)
        scene, worst = lighting.scene, NOTHING
        views = cameras or check_views(scene, lighting.geometry, None)
        editable = lighting.editable if isinstance(lighting, PosedMovingStore) else set(scene.materials)
        for poses, moves in places:
            if isinstance(lighting, PosedMovingStore):
                lighting.set_moves(moves)
            lighting.set_poses(poses)
            geometry = lighting.geometry
            tracer = Tracer(geometry.positions, geometry.faces)
            judge = self.known.setdefault((poses, moves), Judge(scene, geometry, tracer))
            front, back = lighting.receiver_of_vertex()
            strips = [vertex_strips(geometry, tracer, view, front, back, lighting.buried()) for view in views]
            edit = edit_of(scene.materials, editable)
            found = judge.error(lighting, strips, skies, lighting.bounces, lighting.bounces + MORE, edit, most)
            if found.bound > worst.bound:
                where = f"{found.where}, {' '.join(poses)}" + (", objects moved" if moves else "")
                worst = replace(found, where=where)
        return worst

    def trial(self, store: Posable, places: list[Place], tolerance: float) -> Share:
        """The error by which models are chosen."""
        scene = PoseStore(cast("formats.Store", store), self.threads).scene
        skies = {name: sky.radiance for name, sky in pilot.skies(False)}
        return self.error(store, places, list(scene.cameras.values())[:1] or None, skies, CHOSEN * tolerance)


def _open(store: Posable, threads: int) -> PoseStore:
    if "fields" not in store.attrs:
        return PoseStore(cast("formats.Store", store), threads)
    lighting = PosedMovingStore(cast("formats.Store", store), threads)
    lighting.apart = False
    return lighting


def places_between(store: Draft | formats.Store, where: tuple[tuple[float, float], ...]) -> list[Place]:
    """`poses_between`; where objects may be moved, every second one with them elsewhere."""
    out: list[Place] = []
    scene, source = read_scene(cast("formats.Store", store))
    for number, poses in enumerate(poses_between(store, where)):
        moves: tuple[str, ...] = ()
        if "fields" in store.attrs and number % 2:
            moves = free_moves(scene, source, TURNS[where])
        out.append((poses, moves))
    return out


def poses_between(store: Draft | formats.Store, where: tuple[tuple[float, float], ...]) -> list[tuple[str, ...]]:
    """Poses of all characters between neighbouring training frames of their clips; of clips of one frame, that frame.

    where: for each, the place among all gaps and in the gap, 0 to 1.
    """
    lighting = PoseStore(cast("formats.Store", store), 1)
    out: list[list[str]] = [[] for _ in where]
    read: Any = store.read
    for k, about in store.attrs["poses"].items():
        clip, seconds = read(f"pose/{k}/clip"), read(f"pose/{k}/seconds")
        order = np.lexsort((seconds, clip))
        clip, seconds = clip[order], seconds[order]
        gaps = np.flatnonzero(clip[1:] == clip[:-1])
        names = [c.name for c in lighting.geometry.rigs[about["object"]].clips]
        for poses, (place, share) in zip(out, where, strict=True):
            first, at = 0, float(seconds[0])
            if len(gaps):
                first = int(gaps[min(int(place * len(gaps)), len(gaps) - 1)])
                at = float(seconds[first] + share * (seconds[first + 1] - seconds[first]))
            poses.append(f"{about['object']}={names[clip[first]]}@{at!r}")
    return [tuple(poses) for poses in out]


def smallest(shares: list[float], tolerance: float) -> int:
    """Which of the models tried is taken: the first near enough; else the first as good as any."""
    most = max(CHOSEN * tolerance, (1.0 + GAIN) * min(shares))
    return next(k for k, share in enumerate(shares) if share <= most)


def keep_pose_promise(
    writer: formats.Writer, tolerance: float, judge: PoseJudge, reports: dict[str, Report], allow_miss: bool
) -> None:
    """Measures the error in poses that nothing was chosen by and keeps it with the store; raises NumericalError where
    it is more than the tolerance. reports: of the fits, by object's number."""
    found = judge.error(Draft(writer), places_between(Draft(writer), CHECK), None, check_skies(), tolerance)
    measured: dict[str, Any] = {"share": found.share, "where": found.where, "tolerance": tolerance}
    if np.isfinite(found.bound):
        measured["bound"] = found.bound
    writer.set_attrs({"measured_error": measured})
    if found.share <= tolerance or allow_miss:
        return
    raise NumericalError(
        f"{writer.path}: the error is {found.share:.2%} ({found.where}), more than the tolerance of {tolerance:.2%}. "
        f"What would help: {_knob(writer, reports)}. The work is kept in {writer.partial_path.name}; the same command "
        "with --allow-miss finishes it as it is"
    )


def _knob(writer: formats.Writer, reports: dict[str, Report]) -> str:
    """What visibility errs by more: that its bands are few, or that the model does not know the pose."""
    number, report = max(reports.items(), key=lambda item: (item[1].held_out or item[1].training).bands)
    errors = report.held_out or report.training
    order = int(writer.attrs["poses"][number]["order"])
    if errors.projection is not None and errors.projection >= errors.bands:
        more = f"precompute --pose-order {order + 1}"
    elif writer.settings["pose_frames"] != "all":
        more = "precompute --pose-frames all"
    else:
        more = "clips with more frames"
    if "fields" in writer.attrs:
        more += f" or --field-order {1 + int(writer.attrs['fields']['settings']['order'])}"
    return f"{more}, or a finer mesh"
