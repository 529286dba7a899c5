"""Rigs of skinned objects inside a store: group `pose/K/rig`, K the object's place in the scene.

Clips lie one after the other: every channel is a row of `channel` (clip, node, path, interpolation, first key, keys),
its keys rows of `key_seconds` and `key_value`; a key has three values of four numbers, of which LINEAR and STEP use the
second and translations and scales the first three numbers. Names are in the root attribute `rigs`, by K.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import relight_formats as formats
from relightcli.core.pose.clip import Channel, Clip
from relightcli.core.pose.rig import Rig
from relightcli.errors import StoreError
from relightcli.scene.model import Geometry

PATHS = ("translation", "rotation", "scale")
INTERPOLATIONS = ("STEP", "LINEAR", "CUBICSPLINE")
ARRAYS = {
    "position": ("vertex", "axis"),
    "normal": ("vertex", "axis"),
    "tangent": ("vertex", "axis"),
    "joint": ("vertex", "influence"),
    "weight": ("vertex", "influence"),
    "inverse_bind": ("joint", "matrix_row", "matrix_column"),
    "parent": ("node",),
    "rest": ("node", "matrix_row", "matrix_column"),
    "translation": ("node", "axis"),
    "rotation": ("node", "quaternion"),
    "scale": ("node", "axis"),
    "joint_node": ("joint",),
}


def pose_group(object_names: tuple[str, ...], name: str) -> str:
    """The group of all that a store knows about an object's poses. Its number, as names hold what groups may not."""
    return f"pose/{object_names.index(name)}"


def put_rigs(writer: formats.Writer, geometry: Geometry) -> None:
    """Lays down every rig of the scene, and the names of their nodes and clips; nothing where there are none."""
    names = {}
    for name, rig in geometry.rigs.items():
        group = pose_group(geometry.object_names, name)
        for array, dims in ARRAYS.items():
            writer.put(f"{group}/rig/{array}", getattr(rig, array), dims=dims)
        _put_clips(writer, f"{group}/rig", rig.clips)
        clips = [clip.name for clip in rig.clips]
        names[group.split("/")[1]] = {"object": name, "nodes": list(rig.node_names), "clips": clips}
    if names:
        writer.set_attrs({"rigs": names})


def _put_clips(writer: formats.Writer, group: str, clips: tuple[Clip, ...]) -> None:
    rows, seconds, values = [], [], []
    first = 0
    for k, clip in enumerate(clips):
        for c in clip.channels:
            count = len(c.times)
            kinds = (PATHS.index(c.path), INTERPOLATIONS.index(c.interpolation))
            rows.append((k, c.node, *kinds, first, count))
            first += count
            value = np.zeros((count, 3, 4))
            if c.interpolation == "CUBICSPLINE":
                value[:, :, : c.values.shape[2]] = c.values
            else:
                value[:, 1, : c.values.shape[1]] = c.values
            seconds.append(c.times)
            values.append(value)
    if not rows:
        return
    writer.put(f"{group}/channel", np.array(rows, np.int32), dims=("channel", "channel_field"))
    writer.put(f"{group}/key_seconds", np.concatenate(seconds), dims=("key",), units="s")
    writer.put(f"{group}/key_value", np.concatenate(values), dims=("key", "tangent_value_tangent", "number"))


def read_rigs(store: formats.Store) -> dict[str, Rig]:
    """The rigs that `put_rigs` laid down, by object. Raises StoreError where they do not fit together."""
    rigs = {}
    for number, names in store.attrs.get("rigs", {}).items():
        group = f"pose/{number}/rig"
        try:
            arrays: dict[str, Any] = {array: store.read(f"{group}/{array}") for array in ARRAYS}
            clips = _read_clips(store, group, names["clips"])
            rigs[str(names["object"])] = Rig(**arrays, node_names=tuple(names["nodes"]), clips=clips)
        except (KeyError, IndexError, TypeError) as error:
            raise StoreError(f"{store.path}: {group} is damaged ({error!r}). Precompute it again.") from None
    return rigs


def _read_clips(store: formats.Store, group: str, names: list[str]) -> tuple[Clip, ...]:
    channels: list[list[Channel]] = [[] for _ in names]
    if f"{group}/channel" in store:
        seconds, values = store.read(f"{group}/key_seconds"), store.read(f"{group}/key_value")
        for clip, node, path, interpolation, first, count in store.read(f"{group}/channel").tolist():
            keys = slice(first, first + count)
            value = values[keys, :, : 4 if PATHS[path] == "rotation" else 3]
            if INTERPOLATIONS[interpolation] != "CUBICSPLINE":
                value = value[:, 1]
            kinds: Any = (PATHS[path], INTERPOLATIONS[interpolation])
            channels[clip].append(Channel(node, kinds[0], kinds[1], seconds[keys], np.ascontiguousarray(value)))
    return tuple(Clip(name, tuple(found)) for name, found in zip(names, channels, strict=True))
