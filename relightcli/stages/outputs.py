"""What relight is asked for, what its outputs are called, and how a picture is put down."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters import images
from relightcli.adapters.files import need_output
from relightcli.errors import InputError, StoreError
from relightcli.scene.model import Camera, Geometry, Scene
from relightcli.scene.moving import apply_moves
from relightcli.scene.posing import resolve_poses
from relightcli.scene.settings import apply_settings
from relightcli.stages.shots import Shot

PICTURES = (".exr", ".hdr", ".tif", ".tiff", ".png", ".jpg", ".jpeg")
SUFFIXES = (*PICTURES, ".ply", ".zarr")


@dataclass(frozen=True)
class Config:
    """Everything that `relight` needs to know. `output` is a path, with #### in it for a sequence, or '-'."""

    store: Path
    output: str
    env: str | None = None
    env_rotate: float = 0.0
    camera: str | None = None
    settings: tuple[str, ...] = ()
    poses: tuple[str, ...] = ()
    moves: tuple[str, ...] = ()
    frames: Path | None = None
    previous: Path | None = None
    layers: bool = False
    background: bool = False
    exposure: float = 0.0
    basis: str | None = None
    reference: bool = False
    spp: int = 256
    bounces: int | None = None
    suns: str = "soft"
    seed: int = 0
    workers: int = 1
    scheduler: str | None = None
    overwrite: bool = False
    allow_outside: bool = False
    dry_run: bool = False
    tolerance: float | None = None
    quiet: bool = False


def output_suffix(output: str) -> str:
    if output == "-":
        return ".exr"
    suffix = Path(output).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"--output {output}: expected a name ending in {', '.join(SUFFIXES)}, or - for stdout")
    need_output(output, store=suffix == ".zarr")
    return suffix


def check(config: Config, suffix: str) -> None:
    sequence = config.frames is not None
    if sequence and suffix != ".zarr" and "#" not in Path(config.output).name:
        raise InputError(f"--output {config.output}: a sequence needs #### in the name for the frame number")
    if config.previous is not None and config.reference:
        raise InputError("--from: has nothing to give to --reference")
    if config.suns == "traced" and config.reference:
        raise InputError("--suns traced: --reference traces all light anyway")
    if config.layers and suffix != ".exr":
        raise InputError(f"--layers: expected an .exr output, which can hold layers; found {config.output}")
    if config.reference and suffix not in PICTURES:
        raise InputError(f"--reference makes pictures; expected one of {', '.join(PICTURES)}; found {config.output}")
    if not np.isfinite(config.env_rotate) or not np.isfinite(config.exposure):
        raise InputError("--env-rotate and --exposure: expected finite numbers")
    if config.tolerance is not None and not 0.0 < config.tolerance < math.inf:
        raise InputError(f"--tolerance: expected a number above 0; found {config.tolerance}")
    for name, path in (("the store", config.store), ("--env", config.env), ("--from", config.previous)):
        if path is not None and _same_file(config.output, path):
            raise InputError(f"--output {config.output}: is {name} itself; expected another name")


def _same_file(a: str | Path, b: str | Path) -> bool:
    return os.path.exists(a) and os.path.exists(b) and os.path.samefile(a, b)


def check_shots(config: Config, shots: list[Shot], scene: Scene, only: str | None = None) -> None:
    """Look at every frame before the first is made. `only`: the one camera that the store has light for.

    Raises InputError, and StoreError for another camera, naming the keyframe file and the frame.
    """
    for shot in shots:
        try:
            apply_settings(scene.materials, shot.settings)
            apply_moves(scene, shot.moves)
            resolve_environment(shot.env, scene.environments)
            if shot.camera is not None:
                resolve_camera(shot.camera, scene.cameras)
                if only not in (None, shot.camera):
                    raise StoreError(
                        f"--camera {shot.camera}: the store's receivers are the pixels of camera {only!r}; "
                        "precompute with --receivers vertices for other views"
                    )
        except (InputError, StoreError) as error:
            if config.frames is None:
                raise
            raise type(error)(f"{config.frames}: frame {shot.number}: {error}") from None


def check_poses(config: Config, shots: list[Shot], scene: Scene, geometry: Geometry) -> list[str]:
    """Look at the poses of every frame; what there is to say about them. Raises InputError as `check_shots`."""
    notes: dict[str, None] = {}
    for shot in shots:
        try:
            notes |= dict.fromkeys(resolve_poses(scene, geometry, shot.poses)[1])
        except InputError as error:
            if config.frames is None:
                raise
            raise InputError(f"{config.frames}: frame {shot.number}: {error}") from None
    return list(notes)


def check_moves(config: Config, shots: list[Shot], put: Callable[[tuple[str, ...]], object]) -> None:
    """Put things where every frame has them, and back again. Raises InputError as `check_shots`."""
    for shot in shots:
        try:
            put(shot.moves)
        except InputError as error:
            if config.frames is None:
                raise
            raise InputError(f"{config.frames}: frame {shot.number}: {error}") from None
    put(())


def layer_names(count: int) -> list[str]:
    """Names of light that was reflected once, diffusely; twice, ... `count` times; and once, by specular lobes."""
    names = ("direct", "one_bounce", "two_bounce", "three_bounce", "four_bounce")
    return [*(names[i] if i < len(names) else f"bounce_{i}" for i in range(count)), "specular"]


def numbered(pattern: str, number: int) -> str:
    """The name of one frame: the last run of # becomes the number, zero-padded to its length."""
    name = Path(pattern).name
    end = name.rfind("#") + 1
    if end == 0:
        return pattern
    begin = end
    while begin > 0 and name[begin - 1] == "#":
        begin -= 1
    return str(Path(pattern).with_name(f"{name[:begin]}{number:0{end - begin}d}{name[end:]}"))


def resolve_environment(env: str | None, environments: dict[str, Path]) -> Path:
    """The map to read: a file, a name out of the scene, or the scene's only one. Raises InputError."""
    known = ", ".join(environments) or "none"
    if env is None:
        if len(environments) == 1:
            return next(iter(environments.values()))
        raise InputError(f"--env is needed: a file, or an environment of the scene ({known})")
    if env in environments:
        return environments[env]
    path = Path(env)
    if not path.exists():
        raise InputError(f"--env {env}: no such file, and no environment of that name in the scene ({known})")
    return path


def resolve_camera(name: str | None, cameras: dict[str, Camera]) -> Camera:
    """The camera of that name, or the scene's first. Raises InputError."""
    if name is None:
        if not cameras:
            raise InputError("the scene has no camera; add [cameras.main] to the scene file and precompute again")
        return next(iter(cameras.values()))
    if name not in cameras:
        raise InputError(f"--camera {name}: not in the scene; it has {', '.join(cameras) or 'none'}")
    return cameras[name]


def plan_frames(config: Config, shots: list[Shot], scene: Scene) -> list[dict[str, Any]]:
    """What every frame would be written as, for --dry-run."""
    return [
        {
            "output": numbered(config.output, shot.number) if config.frames else config.output,
            "environment": str(resolve_environment(shot.env, scene.environments)),
            "env_rotate": shot.env_rotate,
            "set": list(shot.settings),
        }
        for shot in shots
    ]


def put_picture(
    config: Config,
    shot: Shot,
    suffix: str,
    pixels: NDArray[np.float32],
    layers: dict[str, NDArray[np.float32]],
    metadata: dict[str, Any],
) -> str:
    """Writes one picture under its name (or to stdout); returns the name."""
    if config.output == "-":
        data = images.encode_image(suffix, pixels, layers=layers, metadata=metadata)
        sys.stdout.buffer.write(data)
        sys.stdout.buffer.flush()
        return "-"
    name = numbered(config.output, shot.number) if config.frames else config.output
    images.write_image(name, pixels, layers=layers, metadata=metadata, exposure=shot.exposure)
    return name
