"""The files that a scene is made from, by fingerprint: what a store records, and what resumed work must find again."""

from __future__ import annotations

from pathlib import Path

import relight_formats as formats
from relightcli.adapters.gltf import buffer_files
from relightcli.scene.model import Scene


def scene_inputs(scene: Scene) -> dict[str, str]:
    """Name (relative to the scene file's folder where it lies in there) to fingerprint of every file that is read.

    Environments are no part of it: they are chosen when the scene is lit.
    """
    meshes = {o.mesh for o in scene.objects.values()}
    files = {scene.path} | meshes | {buffer for mesh in meshes for buffer in buffer_files(mesh)}
    for spec in scene.objects.values():
        files |= {*spec.motion_files, *([spec.joint_map] if spec.joint_map else [])}
    files |= {m.diffuse_texture for m in scene.materials.values() if m.diffuse_texture is not None}
    return {_short(path, scene.path.parent): formats.fingerprint_file(path) for path in sorted(files)}


def _short(path: Path, folder: Path) -> str:
    try:
        return path.relative_to(folder).as_posix()
    except ValueError:
        return str(path)
