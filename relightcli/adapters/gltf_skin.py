"""Skins and animations of a glTF 2.0 file, for `relightcli.adapters.rigs`.

Source: Khronos glTF 2.0 specification, sections in brackets.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.gltf import (
    MAX_CORNERS,
    GltfFile,
    Part,
    local_matrix,
    open_gltf,
    read_accessor,
    read_primitive,
    walk,
)
from relightcli.core.pose.clip import Channel, Clip, Interpolation, PathName, quaternion_of

F64 = NDArray[np.float64]
_WIDTH = {"translation": 3, "rotation": 4, "scale": 3}
_REST = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}
# How far a sum of weights may be from 1 before the user is told.
_SUM = 1e-4


@dataclass(frozen=True)
class SkinnedPart:
    """One primitive in its mesh's own space, with `joint` and `weight` (V, W); joints count over all skins."""

    part: Part
    joint: NDArray[np.int32]
    weight: F64


@dataclass
class SkinnedFile:
    """All that a glTF file says of a moving character; nodes in depth-first order, parents before children."""

    parts: list[SkinnedPart] = field(default_factory=list)
    node_names: list[str] = field(default_factory=list)
    parent: list[int] = field(default_factory=list)
    rest: list[F64] = field(default_factory=list)
    properties: dict[str, list[F64]] = field(default_factory=lambda: {path: [] for path in _WIDTH})
    joint_node: list[int] = field(default_factory=list)
    inverse_bind: list[F64] = field(default_factory=list)
    clips: list[Clip] = field(default_factory=list)
    notes: tuple[str, ...] = ()


def read_skinned(path: Path, data: bytes) -> SkinnedFile:
    """Skin, nodes and animations of the default scene. A mesh without a skin hangs on its own node alone.

    Arguments as `gltf.open_gltf`. Raises InputError for what does not follow the specification, and for a file without
    any skin.
    """
    file = open_gltf(path, data)
    if not file.header.get("skins"):
        raise file.fail('has no skin; expected one for motion = "skinned".')
    found = SkinnedFile()
    place = _nodes(file, found)
    first_joint: dict[int, int] = {}  # of a skin; of a node without one, under -1 - node
    corners = 0
    for index, at in place.items():
        node = file.item("nodes", index)
        if "mesh" not in node:
            continue
        skin = node.get("skin")
        key = -1 - index if skin is None else skin
        if key not in first_joint:
            first_joint[key] = len(found.joint_node)
            if skin is None:
                found.joint_node.append(at)
                found.inverse_bind.append(np.eye(4))
            else:
                _skin(file, skin, place, found)
        joints = (first_joint[key], 1 if skin is None else len(file.item("skins", skin)["joints"]))
        for primitive in file.item("meshes", node["mesh"]).get("primitives", []):
            part = read_primitive(file, primitive)
            if part is None or not len(part.faces):
                continue
            corners += part.faces.size
            if corners > MAX_CORNERS:
                raise file.fail(f"holds more than {MAX_CORNERS // 3:,} triangles after instancing.")
            found.parts.append(_weights(file, primitive, part, skin is not None, *joints))
    _clips(file, place, found)
    found.notes = tuple(file.notes)
    return found


def _nodes(file: GltfFile, found: SkinnedFile) -> dict[int, int]:
    """Adds the nodes; returns where each of the file's nodes is among them."""
    place: dict[int, int] = {}
    for index, parent in walk(file):
        node = file.item("nodes", index)
        place[index] = len(place)
        found.node_names.append(_unused(str(node.get("name") or f"node{index}"), found.node_names))
        found.parent.append(place[parent] if parent >= 0 else -1)
        found.rest.append(local_matrix(file, node, index))
        properties = _decomposed(found.rest[-1]) if "matrix" in node else {}
        for path, values in found.properties.items():
            value = np.array(properties.get(path, node.get(path, _REST[path])), np.float64)
            values.append(value / np.linalg.norm(value) if path == "rotation" and value.any() else value)
    return place


def _decomposed(matrix: F64) -> dict[str, Any]:
    """Translation, rotation and scale of a node's matrix (4, 4), exact but for shears. Captured motion moves them."""
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    scale[2] *= np.sign(np.linalg.det(matrix[:3, :3])) or 1.0
    if not scale.all():
        return {"translation": matrix[:3, 3], "scale": scale}
    rotation = quaternion_of(matrix[:3, :3] / scale)
    return {"translation": matrix[:3, 3], "rotation": rotation, "scale": scale}


def _unused(name: str, names: list[str]) -> str:
    """The name, with a number behind it where others have it already."""
    number, known = 1, set(names)
    unused = name
    while unused in known:
        number += 1
        unused = f"{name}_{number}"
    return unused


def _skin(file: GltfFile, index: int, place: dict[int, int], found: SkinnedFile) -> None:
    """Adds the joints of a skin [3.7.3]."""
    skin = file.item("skins", index)
    label = f"skins[{index}]"
    joints = skin.get("joints")
    if not isinstance(joints, list) or not joints:
        raise file.fail(f"{label}.joints: expected a list of nodes, found {joints!r}.")
    for joint in joints:
        if joint not in place:
            raise file.fail(f"{label}.joints: expected nodes of the scene, found {joint!r}.")
        found.joint_node.append(place[joint])
    if "inverseBindMatrices" not in skin:
        found.inverse_bind.extend([np.eye(4)] * len(joints))
        return
    values = _floats(file, f"{label}.inverseBindMatrices", skin["inverseBindMatrices"], 16)
    if len(values) < len(joints):
        raise file.fail(f"{label}.inverseBindMatrices: expected {len(joints)} matrices, found {len(values)}.")
    for matrix in values[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1):  # column-major
        if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
            raise file.fail(f"{label}.inverseBindMatrices: expected last rows of 0 0 0 1, found {matrix[3].tolist()}.")
        found.inverse_bind.append(np.concatenate([matrix[:3], [[0.0, 0.0, 0.0, 1.0]]]))


def _floats(file: GltfFile, label: str, index: Any, width: int) -> F64:
    values = np.asarray(read_accessor(file, index, False), np.float64)
    if values.shape[1] != width or not np.isfinite(values).all():
        raise file.fail(f"{label}: expected finite values of {width} components, found {values.shape[1]}.")
    return values


def _weights(
    file: GltfFile, primitive: dict[str, Any], part: Part, skinned: bool, first: int, joints: int
) -> SkinnedPart:
    """Joints and weights of a primitive's vertices, of sum 1. Vertices without any hang on the first joint."""
    attributes = primitive["attributes"]
    count = len(part.positions)
    sets = 0
    while f"JOINTS_{sets}" in attributes and f"WEIGHTS_{sets}" in attributes:
        sets += 1
    if not skinned or not sets:
        if skinned:
            file.notes["a primitive of its skin has no JOINTS_0 and WEIGHTS_0 and hangs on the first joint"] = None
        return SkinnedPart(part, np.full((count, 1), first, np.int32), np.ones((count, 1)))
    all_joints, all_weights = [], []
    for k in range(sets):
        joint = read_accessor(file, attributes[f"JOINTS_{k}"], False)
        weight = _floats(file, f"WEIGHTS_{k}", attributes[f"WEIGHTS_{k}"], 4)
        if joint.shape != (count, 4) or joint.dtype.kind != "u" or len(weight) != count:
            raise file.fail(
                f"JOINTS_{k}, WEIGHTS_{k}: expected 4 unsigned numbers and 4 weights for each of {count} vertices, "
                f"found {joint.shape[1]} x {joint.dtype} for {len(joint)} and weights for {len(weight)}."
            )
        all_joints.append(joint.astype(np.int64))
        all_weights.append(weight)
    joint, weight = np.concatenate(all_joints, axis=1), np.concatenate(all_weights, axis=1)
    if (weight < 0.0).any():
        file.notes["negative weights of its skin count as 0"] = None
        weight = np.maximum(weight, 0.0)
    joint = np.where(weight > 0.0, joint, 0)
    if joint.max(initial=0) >= joints:
        raise file.fail(f"JOINTS: expected joints 0 to {joints - 1} of the skin, found {joint.max()}.")
    total = weight.sum(axis=1)
    none, off = total <= 0.0, np.abs(total - 1.0) > _SUM
    if none.any():
        file.notes[f"{int(none.sum())} vertices have no weights and hang on the first joint"] = None
        weight[none, 0] = 1.0
    if (off & ~none).any():
        file.notes[
            f"the weights of {int((off & ~none).sum())} of {count} vertices do not add up to 1 "
            f"({total[off & ~none].min():.4g} to {total[off & ~none].max():.4g}) and were scaled"
        ] = None
    weight = weight / weight.sum(axis=1, keepdims=True)
    return SkinnedPart(part, (first + joint).astype(np.int32), weight)


def _clips(file: GltfFile, place: dict[int, int], found: SkinnedFile) -> None:
    """Adds the animations that move nodes of the scene [3.11]."""
    for number, animation in enumerate(file.header.get("animations", [])):
        channels: dict[tuple[int, str], Channel] = {}
        for k, channel in enumerate(animation.get("channels", [])):
            label = f"animations[{number}].channels[{k}]"
            target = channel.get("target", {})
            path, node = target.get("path"), target.get("node")
            if path == "weights":
                file.notes["its morph targets are not applied"] = None
                continue
            if node not in place:
                continue
            if path not in _WIDTH:
                raise file.fail(f"{label}.target.path: expected translation, rotation or scale, found {path!r}.")
            if "matrix" in file.item("nodes", node):
                raise file.fail(f"{label}: nodes[{node}] has a matrix; a node that moves must have none.")
            samplers = animation.get("samplers", [])
            at = channel.get("sampler")
            if not isinstance(at, int) or not 0 <= at < len(samplers):
                raise file.fail(f"{label}.sampler: expected 0 to {len(samplers) - 1}, found {at!r}.")
            channels[place[node], path] = _channel(file, label, samplers[at], place[node], path)
        if channels:
            name = _unused(str(animation.get("name") or f"clip{number}"), [c.name for c in found.clips])
            found.clips.append(Clip(name, tuple(channels[key] for key in sorted(channels))))


def _channel(file: GltfFile, label: str, sampler: dict[str, Any], node: int, path: str) -> Channel:
    interpolation = sampler.get("interpolation", "LINEAR")
    if interpolation not in ("STEP", "LINEAR", "CUBICSPLINE"):
        raise file.fail(f"{label}: expected interpolation STEP, LINEAR or CUBICSPLINE, found {interpolation!r}.")
    times = _floats(file, f"{label}: input", sampler.get("input"), 1)[:, 0]
    values = _floats(file, f"{label}: output", sampler.get("output"), _WIDTH[path])
    each = 3 if interpolation == "CUBICSPLINE" else 1
    if not len(times) or len(values) != each * len(times):
        raise file.fail(f"{label}: expected {each} values for each of {len(times)} keys, found {len(values)}.")
    if (np.diff(times) < 0.0).any():
        raise file.fail(f"{label}: expected rising times, found {np.diff(times).min():g} s from one key to the next.")
    values = values.reshape(len(times), each, _WIDTH[path])
    kept = np.append(np.diff(times) > 0.0, True)  # the last of several at one time
    times, values = times[kept], values[kept]
    if path == "rotation":
        key = values[:, each // 2]
        length = np.linalg.norm(key, axis=1, keepdims=True)
        if not (length > 0.0).all():
            raise file.fail(f"{label}: expected unit quaternions, found 0 0 0 0.")
        values[:, each // 2] = key / length
    if each == 1:
        values = values[:, 0]
    return Channel(node, cast(PathName, path), cast(Interpolation, interpolation), times, values)
