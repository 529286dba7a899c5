"""Poses of skinned objects at relight time: `--pose man=walk@1.5`."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from relightcli.core.pose.clip import Clip
from relightcli.core.pose.rig import posed
from relightcli.errors import InputError
from relightcli.scene.fields import did_you_mean
from relightcli.scene.model import Geometry, Scene

FARTHEST = 1e30  # coordinates beyond are refused, as when a mesh is read


@dataclass(frozen=True)
class Pose:
    """What one object is to do: the moment `seconds` of its clip of that name."""

    object: str
    clip: str
    seconds: float


def parse_pose(text: str) -> Pose:
    """`OBJECT=CLIP@SECONDS`; a clip's name may hold = and @. Raises InputError."""
    name, equals, moment = text.partition("=")
    clip, at, seconds = moment.rpartition("@")
    try:
        time = float(seconds)
    except ValueError:
        time = math.nan
    if not equals or not at or not name.strip() or not clip.strip() or not math.isfinite(time):
        raise InputError(f"--pose {text}: expected OBJECT=CLIP@SECONDS, as in --pose man=walk@1.5")
    return Pose(name.strip(), clip.strip(), time)


def resolve_poses(
    scene: Scene, geometry: Geometry, poses: Iterable[str]
) -> tuple[dict[str, tuple[Clip, float]], list[str]]:
    """Clip and seconds by object, of several poses of one object the last, and notes about what was clamped.

    poses: texts as `parse_pose` takes them. Seconds before a clip's first key or after its last are taken as that
    key's, with a note. Raises InputError for what is no skinned object of the scene, or no clip of it.
    """
    found: dict[str, tuple[Clip, float]] = {}
    notes: dict[str, str] = {}
    for text in poses:
        pose = parse_pose(text)
        name = pose.object
        if name not in geometry.rigs:
            skinned = ", ".join(geometry.rigs) or "none"
            if name in scene.objects:
                raise InputError(
                    f"--pose {text}: object {name!r} is {scene.objects[name].motion}; expected one with motion = "
                    f'"skinned" in the scene file (those are: {skinned}).'
                )
            raise InputError(
                f"--pose {text}: no object {name!r}; skinned are: {skinned}.{did_you_mean(name, geometry.rigs)}"
            )
        clips = {clip.name: clip for clip in geometry.rigs[name].clips}
        if pose.clip not in clips:
            known = ", ".join(clips) or "none"
            raise InputError(
                f"--pose {text}: {name!r} has no clip {pose.clip!r}; it has: {known}.{did_you_mean(pose.clip, clips)}"
            )
        clip = clips[pose.clip]
        seconds = min(max(pose.seconds, clip.start), clip.stop)
        notes.pop(name, None)
        if seconds != pose.seconds:
            notes[name] = (
                f"--pose {text}: {clip.name!r} lasts from {clip.start:g} to {clip.stop:g} s; {seconds:g} s is taken"
            )
        found[name] = (clip, seconds)
    return found, list(notes.values())


def apply_poses(scene: Scene, geometry: Geometry, poses: Iterable[str]) -> tuple[Geometry, list[str]]:
    """The scene's geometry with some objects posed, and notes, as `resolve_poses`; the others stand as they stood."""
    resolved, notes = resolve_poses(scene, geometry, poses)
    if not resolved:
        return geometry, notes
    positions, normals = geometry.positions.copy(), geometry.normals.copy()
    for name, (clip, seconds) in resolved.items():
        rows = np.flatnonzero(geometry.vertex_object == geometry.object_names.index(name))
        moved, turned, _ = posed(geometry.rigs[name], scene.objects[name].transform, clip, seconds)
        if not (np.abs(moved) <= FARTHEST).all():
            raise InputError(
                f"--pose {name}={clip.name}@{seconds:g}: expected coordinates within {FARTHEST:g}, found some beyond"
            )
        positions[rows], normals[rows] = moved, turned
    return replace(geometry, positions=positions, normals=normals), notes
