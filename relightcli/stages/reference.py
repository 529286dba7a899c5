"""relight --reference: brute-force path tracing of the same scene, in resumable blocks of rows."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import relight_formats as formats
from relight_formats.publish import drop
from relightcli import __version__
from relightcli.adapters import images
from relightcli.adapters.rays import Tracer
from relightcli.core.lights.latlong import make_latlong
from relightcli.core.transport.path_tracer import Tile, resolve, split_samples, trace_rows
from relightcli.core.transport.shading import shading_scene
from relightcli.run import blocks as run
from relightcli.scene.build import build_geometry
from relightcli.scene.model import Geometry, Scene
from relightcli.scene.moving import apply_moves, move_geometry
from relightcli.scene.parse import load_scene
from relightcli.scene.posing import apply_poses
from relightcli.scene.settings import apply_settings
from relightcli.stages.inputs import scene_inputs
from relightcli.stages.lighting import read_scene
from relightcli.stages.outputs import (
    Config,
    check_poses,
    check_shots,
    layer_names,
    numbered,
    put_picture,
    resolve_camera,
    resolve_environment,
)
from relightcli.stages.shots import Shot

PATHS_PER_BLOCK = 8_000_000


@dataclass(frozen=True)
class ReferenceJob:
    """Rows of one picture. `source` is a transfer store or a scene file."""

    partial: str
    source: str
    environment: str
    rotate: float
    camera: str
    settings: tuple[str, ...]
    moves: tuple[str, ...]
    spp: int
    bounces: int
    background: bool
    seed: int
    allow_outside: bool
    poses: tuple[str, ...] = ()

    def open(self) -> ReferenceWorker:
        return ReferenceWorker(self)


class ReferenceWorker:
    def __init__(self, job: ReferenceJob) -> None:
        self.job = job
        scene, geometry, _, _ = open_source(Path(job.source), job.allow_outside)
        moved = apply_moves(scene, job.moves)
        scene, geometry = moved, move_geometry(geometry, scene, moved)
        geometry, _ = apply_poses(scene, geometry, job.poses)
        materials = apply_settings(scene.materials, job.settings)
        self.camera = scene.cameras[job.camera]
        self.scene = shading_scene(geometry, list(materials.values()), scene.lights.values())
        self.tracer = Tracer(geometry.positions, geometry.faces)
        self.environment = make_latlong(images.read_environment(job.environment), job.rotate)
        self.out = {name: formats.worker_array(job.partial, name) for name in ("layers", "squares", "alpha")}

    def run(self, block: run.Block) -> run.Info:
        job = self.job
        passes, per_pass = split_samples(job.spp)
        tile = trace_rows(
            self.scene,
            self.tracer,
            self.environment,
            self.camera,
            (block.start, block.stop),
            (0, passes),
            per_pass,
            job.bounces,
            job.seed,
            job.background,
        )
        rows = slice(block.start, block.stop)
        self.out["layers"][:, rows] = tile.layers
        self.out["squares"][rows] = tile.squares
        self.out["alpha"][rows] = tile.alpha
        return {"rays": float(tile.rays)}


def open_source(path: Path, allow_outside: bool = False) -> tuple[Scene, Geometry, str, int]:
    """Scene, geometry, fingerprint and interreflections of a transfer store, or of a scene file (.toml; 0)."""
    if path.suffix.lower() == ".toml":
        scene = load_scene(path, allow_outside=allow_outside)
        return scene, build_geometry(scene), formats.fingerprint_json(scene_inputs(scene)), 0
    store = formats.open_store(path, "transfer")
    return *read_scene(store), store.fingerprint, int(store.settings["bounces"])


def render_reference(config: Config, shots: list[Shot], suffix: str, started: float) -> dict[str, Any]:
    """Path-traces every shot. Samples accumulate in `OUTPUT.samples.partial` until the picture is written."""
    run.need_scheduler(config.scheduler)
    scene, geometry, fingerprint, own_bounces = open_source(config.store, config.allow_outside)
    check_shots(config, shots, scene)
    for shot in shots:
        move_geometry(geometry, scene, apply_moves(scene, shot.moves))
    notes = check_poses(config, shots, scene, geometry)
    bounces = own_bounces if config.bounces is None else config.bounces
    written, rays = [], 0
    for shot in shots:
        environment = resolve_environment(shot.env, scene.environments)
        camera = resolve_camera(shot.camera, scene.cameras)
        # Read here for what it has to say, and so that a bad map leaves no unfinished work behind.
        notes += [note for note in images.read_environment_with_notes(environment)[1] if note not in notes]
        name = config.output if config.output != "-" else "relight-stdout.exr"
        if config.frames is not None:
            name = numbered(name, shot.number)
        samples = Path(f"{name}.samples")
        passes, per_pass = split_samples(config.spp)
        settings = {
            "env_rotate": shot.env_rotate,
            "camera": camera.name,
            "set": list(shot.settings),
            "spp": passes * per_pass,
            "bounces": bounces,
            "background": config.background,
            "seed": config.seed,
            **({"move": list(shot.moves)} if shot.moves else {}),
        }
        if shot.poses:
            settings["pose"] = list(shot.poses)
        writer = formats.begin(
            samples,
            "samples",
            settings=settings,
            inputs={"scene": fingerprint, "environment": formats.fingerprint_file(environment)},
            program=f"relightcli {__version__}",
            overwrite=config.overwrite,
        )
        width, height = camera.size
        layers = bounces + 2 + config.background
        if writer is not None:
            with writer:
                rows = max(1, min(height, PATHS_PER_BLOCK // (width * passes * per_pass)))
                _create(writer, layers, height, width, rows)
                job = ReferenceJob(
                    str(writer.partial_path),
                    os.path.abspath(config.store),  # a worker may run in another folder
                    os.path.abspath(environment),
                    shot.env_rotate,
                    camera.name,
                    shot.settings,
                    shot.moves,
                    config.spp,
                    bounces,
                    config.background,
                    config.seed,
                    config.allow_outside,
                    shot.poses,
                )
                run.run_blocks(
                    job,
                    run.split("rows", height, rows),
                    writer,
                    workers=config.workers,
                    label="reference",
                    quiet=config.quiet,
                    scheduler=config.scheduler,
                )
                run.close_worker()
                writer.commit({})
        store = formats.open_store(samples, "samples")
        rays += int(sum(b.get("rays", 0.0) for b in store.blocks))
        tile = Tile(store.read("layers"), store.read("squares"), store.read("alpha"), passes, 0)
        picture = resolve(tile)
        extra: dict[str, Any] = {}
        if suffix == ".exr":
            names = [*layer_names(bounces + 1), *(["background"] if config.background else [])]
            extra = dict(zip(names, picture.layers, strict=True)) if config.layers else {}
            extra["variance"] = picture.variance
        pixels = np.concatenate([picture.beauty, picture.alpha[..., None]], axis=2)
        if config.background:
            pixels[..., 3] = 1.0
        metadata = {
            "relight:program": f"relightcli {__version__}",
            "relight:store": str(config.store),
            "relight:store_fingerprint": fingerprint,
            "relight:environment": str(environment),
            "relight:env_rotate": float(shot.env_rotate),
            "relight:camera": camera.name,
            "relight:set": " ".join(shot.settings),
            "relight:move": " ".join(shot.moves),
            "relight:reference_spp": passes * per_pass,
            "relight:bounces": bounces,
        }
        if shot.poses:
            metadata["relight:pose"] = " ".join(shot.poses)
        written.append(put_picture(config, shot, suffix, pixels, extra, metadata))
        drop(samples)
    return {
        "store": str(config.store),
        "output": written if config.frames else written[0],
        "frames": len(written),
        "reference": True,
        "spp": passes * per_pass,
        "rays": rays,
        "seconds": time.perf_counter() - started,
        "notes": notes,
    }


def _create(writer: formats.Writer, layers: int, height: int, width: int, rows: int) -> None:
    writer.array(
        "layers",
        shape=(layers, height, width, 3),
        dtype=np.float64,
        chunks=(layers, rows, width, 3),
        dims=("layer", "row", "column", "colour"),
        codec="none",
    )
    writer.array(
        "squares",
        shape=(height, width, 3),
        dtype=np.float64,
        chunks=(rows, width, 3),
        dims=("row", "column", "colour"),
        codec="none",
    )
    writer.array(
        "alpha", shape=(height, width), dtype=np.float64, chunks=(rows, width), dims=("row", "column"), codec="none"
    )
