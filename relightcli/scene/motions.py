"""Captured motion for skinned objects: the clips that `motion_files` adds, by way of a `joint_map`."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

from relightcli.adapters.bvh import load_bvh
from relightcli.core.pose.retarget import retarget
from relightcli.core.pose.rig import Rig
from relightcli.errors import InputError
from relightcli.scene.fields import did_you_mean
from relightcli.scene.model import ObjectSpec

MAX_BYTES = 1 << 20


def add_motions(rig: Rig, spec: ObjectSpec) -> Rig:
    """The rig with a clip more for each motion file, named as the file without its suffix.

    Raises InputError for maps and motions that do not fit the rig, and for a name that a clip has already.
    """
    if spec.joint_map is None:
        return rig
    joints = load_joint_map(spec.joint_map, rig)
    clips = list(rig.clips)
    for path in spec.motion_files:
        if path.stem in {clip.name for clip in clips}:
            raise InputError(
                f"{path}: objects.{spec.name} has a clip {path.stem!r} already; expected a file of another name."
            )
        motion = load_bvh(path)
        for node, joint in joints.items():
            if joint not in motion.names:
                raise InputError(
                    f"{spec.joint_map}: joints.{node}: no joint {joint!r} in {path.name}; it has "
                    f"{', '.join(motion.names)}.{did_you_mean(joint, motion.names)}"
                )
        clips.append(retarget(rig, motion, joints, path.stem))
    return replace(rig, clips=tuple(clips))


def load_joint_map(path: Path, rig: Rig) -> dict[str, str]:
    """The table `[joints]` of a TOML file: the rig's nodes, and which captured joint moves each. Raises InputError."""
    with open(path, "rb") as file:
        content = file.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise InputError(f"{path}: expected at most {MAX_BYTES:,} bytes for a joint map; found more.")
    try:
        data = tomllib.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not valid TOML: {error}.") from None
    unknown = ", ".join(key for key in data if key != "joints")
    joints = data.get("joints")
    if unknown or not isinstance(joints, dict) or not joints:
        found = unknown or ("nothing" if joints is None else repr(joints)[:60])
        raise InputError(f'{path}: expected one table [joints], node = "joint" each line; found {found}.')
    for node, joint in joints.items():
        if node not in rig.node_names:
            raise InputError(
                f"{path}: joints.{node}: the mesh has no node {node!r}; it has {', '.join(rig.node_names)}."
                f"{did_you_mean(node, rig.node_names)}"
            )
        if not isinstance(joint, str):
            raise InputError(f"{path}: joints.{node}: expected a captured joint's name, found {joint!r}.")
    return {node: joints[node] for node in joints}
