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
from relightcli.core.transport.path_tracer import Picture, Tile, resolve, split_samples, trace_rows
from relightcli.core.transport.shading import shading_scene
from relightcli.errors import NumericalError
from relightcli.run import blocks as run
from relightcli.scene.build import build_geometry
from relightcli.scene.model import Geometry, Scene
from relightcli.scene.moving import apply_moves, move_geometry
from relightcli.scene.parse import load_scene
from relightcli.scene.posing import apply_poses
from relightcli.scene.settings import apply_settings
from relightcli.stages.inputs import scene_inputs
from relightcli.stages.lighting import described, need_scene, read_scene, whole_setting
from relightcli.stages.outputs import (
    Config,
    check_poses,
    check_shots,
    layer_names,
    numbered,
    plan_frames,
    put_picture,
    resolve_camera,
    resolve_environment,
)
from relightcli.stages.precompute_config import MOST_BOUNCES
from relightcli.stages.shots import Shot

PATHS_PER_BLOCK = 8_000_000
TRIED_ROWS, TRIED_SAMPLES = 8, 4  # traced to predict the cost
MOST_SAMPLES = 1 << 20


@dataclass(frozen=True)
class ReferenceJob:
    """Rows of one picture. `source` is a store or a scene file."""

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

    def run(self, block: run.Block) -> run.Info:
        passes, per_pass = split_samples(self.job.spp)
        tile = self.trace((block.start, block.stop), (0, passes), per_pass)
        rows = slice(block.start, block.stop)
        out = {name: formats.worker_array(self.job.partial, name) for name in ("layers", "squares", "alpha")}
        out["layers"][:, rows] = tile.layers
        out["squares"][rows] = tile.squares
        out["alpha"][rows] = tile.alpha
        return {"rays": float(tile.rays)}

    def trace(self, rows: tuple[int, int], passes: tuple[int, int], per_pass: int) -> Tile:
        """Some rows of the picture."""
        job = self.job
        return trace_rows(
            self.scene,
            self.tracer,
            self.environment,
            self.camera,
            rows,
            passes,
            per_pass,
            job.bounces,
            job.seed,
            job.background,
        )


def open_source(path: Path, allow_outside: bool = False) -> tuple[Scene, Geometry, str, int]:
    """Scene, geometry, fingerprint and interreflections of any stage's store, or of a scene file (.toml; 0)."""
    if path.suffix.lower() == ".toml":
        scene = load_scene(path, allow_outside=allow_outside)
        return scene, build_geometry(scene), formats.fingerprint_json(scene_inputs(scene)), 0
    store = formats.open_store(path)
    need_scene(store)
    with described(store.path):
        return *read_scene(store), store.fingerprint, whole_setting(store, "bounces", 0, MOST_BOUNCES)


def render_reference(config: Config, shots: list[Shot], suffix: str, started: float) -> dict[str, Any]:
    """Path-traces every shot. Samples accumulate in `OUTPUT.samples.partial` until the picture is written."""
    run.need_scheduler(config.scheduler)
    scene, geometry, fingerprint, own_bounces = open_source(config.store, config.allow_outside)
    check_shots(config, shots, scene)
    for shot in shots:
        move_geometry(geometry, scene, apply_moves(scene, shot.moves))
    notes = check_poses(config, shots, scene, geometry)
    bounces = own_bounces if config.bounces is None else config.bounces
    if config.dry_run:
        return _predict(config, shots, scene, bounces, notes)
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
                run.run_blocks(
                    _job(config, shot, scene, bounces, str(writer.partial_path)),
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
        if config.tolerance is not None:
            _need_quiet(name, picture, passes * per_pass, config.tolerance)
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


def _job(config: Config, shot: Shot, scene: Scene, bounces: int, partial: str) -> ReferenceJob:
    return ReferenceJob(
        partial,
        os.path.abspath(config.store),  # a worker may run in another folder
        os.path.abspath(resolve_environment(shot.env, scene.environments)),
        shot.env_rotate,
        resolve_camera(shot.camera, scene.cameras).name,
        shot.settings,
        shot.moves,
        config.spp,
        bounces,
        config.background,
        config.seed,
        config.allow_outside,
        shot.poses,
    )


def _predict(config: Config, shots: list[Shot], scene: Scene, bounces: int, notes: list[str]) -> dict[str, Any]:
    """What a run would write and what it should take, from a few rows of the first frame; nothing is left behind."""
    worker = ReferenceWorker(_job(config, shots[0], scene, bounces, ""))
    height = worker.camera.size[1]
    passes, per_pass = split_samples(config.spp)
    worker.trace((0, 1), (0, 1), 1)  # compiles
    rows = sorted({height * k // TRIED_ROWS for k in range(TRIED_ROWS)})
    few = min(per_pass, TRIED_SAMPLES)
    began, rays = time.perf_counter(), 0
    for row in rows:
        rays += worker.trace((row, row + 1), (0, 1), few).rays
    seconds = time.perf_counter() - began
    sizes = [resolve_camera(shot.camera, scene.cameras).size for shot in shots]
    # Of one sample of a pixel of the first frame; the others are taken to be like it.
    samples = passes * per_pass * sum(width * height for width, height in sizes)
    share = samples / (len(rows) * worker.camera.size[0] * few)
    return {
        "dry_run": True,
        "store": str(config.store),
        "reference": True,
        "frames": plan_frames(config, shots, scene),
        "predicted": {"seconds": seconds * share / config.workers, "rays": rays * share},
        "notes": notes,
    }


def _need_quiet(name: str, picture: Picture, spp: int, tolerance: float) -> None:
    """Raises NumericalError where the picture's noise, relative RMS, is above the tolerance."""
    norm = float(np.sqrt((picture.beauty.astype(np.float64) ** 2).sum()))
    noise = float(np.sqrt(picture.variance.astype(np.float64).sum()))
    if noise > tolerance * norm:
        need = spp * (noise / max(tolerance * norm, 1e-300)) ** 2
        more = f"; --spp {1.1 * need:.0f} should do" if need < MOST_SAMPLES else ""
        raise NumericalError(
            f"{name}: the noise is {noise / max(norm, 1e-300):.2%} at {spp} samples a pixel, above --tolerance "
            f"{tolerance:.2%}{more}; nothing was written"
        )


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
