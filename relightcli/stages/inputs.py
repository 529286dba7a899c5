"""The files that a scene is made from, by fingerprint: what a store records, and what resumed work must find again."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

import relight_formats as formats
from relightcli.adapters.gltf import buffer_files
from relightcli.errors import InputError
from relightcli.scene.model import Scene


def scene_inputs(scene: Scene) -> dict[str, str]:
    """Name (relative to the scene file's folder where it lies in there) to fingerprint of every file that is read.

    Environments are no part of it: they are chosen when the scene is lit.
    """
    files = named_files(scene)
    files |= {buffer for spec in scene.objects.values() for buffer in buffer_files(spec.mesh)}
    return {_short(path, scene.path.parent): formats.fingerprint_file(path) for path in sorted(files)}


def named_files(scene: Scene) -> set[Path]:
    """The scene file and the files that it names, without the buffers of a glTF."""
    files = {scene.path, *(o.mesh for o in scene.objects.values())}
    for spec in scene.objects.values():
        files |= {*spec.motion_files, *([spec.joint_map] if spec.joint_map else [])}
    files |= {m.diffuse_texture for m in scene.materials.values() if m.diffuse_texture is not None}
    return files


def stamps(files: Iterable[Path]) -> dict[Path, tuple[int, int, int]]:
    """Size, time of change in nanoseconds and inode of the files that are there."""
    found = {}
    for path in files:
        with contextlib.suppress(OSError):
            about = path.stat()
            found[path] = (about.st_size, about.st_mtime_ns, about.st_ino)
    return found


def need_unchanged(before: dict[Path, tuple[int, int, int]]) -> None:
    """Raises InputError for a file that is another one than when `before` was taken: what was read of it and its
    fingerprint may not belong together."""
    now = stamps(before)
    for path, stamp in before.items():
        if now.get(path) != stamp:
            raise InputError(f"{path}: was changed while it was read; expected it to stay as it is. Run again.")


def _short(path: Path, folder: Path) -> str:
    try:
        return path.relative_to(folder).as_posix()
    except ValueError:
        return str(path)
