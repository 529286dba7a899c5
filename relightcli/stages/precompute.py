"""Stage precompute: scene file in, transfer store out. What every receiver sees of the sky, block by block."""

from __future__ import annotations

import time
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli import __version__
from relightcli.adapters.rays import Tracer
from relightcli.core.shade import picture, primary
from relightcli.core.sphere import cube, haar, sh
from relightcli.core.transport import visibility
from relightcli.core.transport.camera import make_film
from relightcli.core.transport.light_visibility import POINTS_PER_LIGHT, light_bits
from relightcli.core.transport.local_lights import pack_lights
from relightcli.core.transport.receivers import Receivers, spatial_order, vertex_receivers
from relightcli.core.transport.tessellation import tessellate
from relightcli.errors import InputError
from relightcli.plan import effects
from relightcli.run import blocks as run
from relightcli.scene.build import build_geometry, scene_to_json
from relightcli.scene.model import Geometry, RectangleLight, Scene, SphereLight
from relightcli.scene.parse import load_scene

KIND = "transfer"
BASES = ("visibility", "haar", "sh", "dense")
CHUNK_BYTES = 4_000_000
PILOT_GROUPS = 24  # groups of receivers that a dry run traces
WRONG_BITS = 1e-3  # share of wrong bits above which the user is told
PIXEL_GRIDS = (1, 3)  # samples along a pixel's side, inside and at edges, for pixel receivers


@dataclass(frozen=True)
class Config:
    """Everything that `precompute` needs to know. `basis` beyond visibility is stored in addition to it."""

    scene: Path
    output: Path
    light_resolution: int = 64
    refine: int = 4
    effects: str = "auto"
    receivers: str = "vertices"
    subdivide: bool = True
    basis: str = "visibility"
    coefficients: int = 128
    tolerance: float | None = None
    sh_order: int = 6
    bounces: int = 0
    seed: int = 0
    workers: int = 1
    overwrite: bool = False
    allow_outside: bool = False
    dry_run: bool = False
    quiet: bool = False


@dataclass(frozen=True)
class VisibilityJob:
    """One block: trace the visibility of a range of receivers, and project it on the chosen basis."""

    partial: str
    resolution: int
    refine: int
    shadows: bool
    basis: str
    coefficients: int
    tolerance: float
    sh_order: int
    seed: int
    lights: tuple[SphereLight | RectangleLight, ...]

    def open(self) -> VisibilityWorker:
        return VisibilityWorker(self)


class VisibilityWorker:
    def __init__(self, job: VisibilityJob) -> None:
        self.job = job

        def array(name: str) -> Any:
            return formats.worker_array(job.partial, name)

        self.position, self.normal = array("receivers/position"), array("receivers/normal")
        self.tracer = Tracer(array("mesh/position")[:], array("mesh/face")[:]) if job.shadows else None
        self.out = {name: array(name) for name in _outputs(job)}
        self.lights = pack_lights(job.lights)
        self.directions = cube.texel_directions(job.resolution).reshape(-1, 3).astype(np.float32)
        self.solid_angle = cube.solid_angles(job.resolution).reshape(-1).astype(np.float32)

    def run(self, block: run.Block) -> run.Info:
        job, rows = self.job, slice(block.start, block.stop)
        position, normal = self.position[rows], self.normal[rows]
        info: run.Info = {"rays": 0.0, "checked": 0.0, "wrong": 0.0, "inferred": 0.0, "bits": 0.0}
        start = time.perf_counter()
        if self.tracer is None:
            bits = visibility.horizon_bits(normal, job.resolution)
        else:
            traced = visibility.trace_visibility(
                self.tracer, position, normal, job.resolution, job.refine, job.seed + block.start
            )
            bits = traced.bits
            info |= {
                "rays": float(traced.rays),
                "checked": float(traced.checked),
                "wrong": float(traced.wrong),
                "inferred": float(traced.inferred),
                "bits": float(3 * job.resolution**2 * len(position)),
            }
        if self.lights.number:
            self.out["lights/bits"][rows], rays = light_bits(self.tracer, self.lights, position, normal)
            info["rays"] += float(rays)
        info["trace_seconds"] = time.perf_counter() - start
        self.out["visibility/bits"][rows] = bits
        if job.basis == "sh":
            self.out["direct/sh"][rows] = sh.cosine_transfer(bits, normal, job.sh_order)
        elif job.basis == "haar":
            index, value, dropped = haar.truncated_cosine_transfer(
                bits, normal, self.directions, self.solid_angle, job.coefficients, job.tolerance
            )
            self.out["direct/haar_index"][rows] = index
            self.out["direct/haar_value"][rows] = value
            info["dropped_energy"] = float(dropped.mean())
        elif job.basis == "dense":
            self.out["direct/dense"][rows] = _dense(bits, normal, self.directions, self.solid_angle)
        return info


def _dense(
    bits: NDArray[np.uint8],
    normal: NDArray[np.float32],
    directions: NDArray[np.float32],
    solid_angle: NDArray[np.float32],
) -> NDArray[np.float32]:
    seen = np.unpackbits(bits.reshape(len(bits), -1), axis=1, bitorder="little")
    weights = np.tile(solid_angle, 6) / np.float32(np.pi)
    out: NDArray[np.float32] = np.maximum(normal @ directions.T, 0.0) * weights * seen
    return out


def _outputs(job: VisibilityJob) -> list[str]:
    more = {"visibility": [], "sh": ["direct/sh"], "dense": ["direct/dense"]}
    more["haar"] = ["direct/haar_index", "direct/haar_value"]
    return ["visibility/bits", *more[job.basis], *(["lights/bits"] if job.lights else [])]


def precompute(config: Config) -> dict[str, Any]:
    """Runs the stage; returns a summary for the user. Raises the errors of `relightcli.errors` and OSError."""
    started = time.perf_counter()
    _check(config)
    asked = effects.parse_effects(config.effects)
    scene = load_scene(config.scene, allow_outside=config.allow_outside)
    effects.need_static({o.name: o.motion for o in scene.objects.values()}, asked)
    geometry = build_geometry(scene)
    both = _both_sides(scene, geometry)
    plan = effects.decide(asked, geometry.positions, geometry.faces, bool(both.any()))
    shadows = next(d.simulate for d in plan if d.effect == "shadows")
    source = geometry
    if shadows and config.subdivide and config.receivers == "vertices":
        geometry = _subdivided(geometry)
    if config.dry_run:
        return _dry_run(config, scene, geometry, both, plan, shadows)
    settings = {
        "effects": [d.effect for d in plan if d.simulate],
        "light_resolution": config.light_resolution,
        "refine": config.refine if shadows else 1,
        "receivers": config.receivers,
        "subdivide": config.subdivide,
        "basis": config.basis,
        "seed": config.seed,
        "bounces": config.bounces,
    }
    if config.basis == "haar":
        settings |= {"coefficients": config.coefficients, "tolerance": config.tolerance}
    if config.basis == "sh":
        settings["sh_order"] = config.sh_order
    writer = formats.begin(
        config.output,
        KIND,
        settings=settings,
        inputs=_inputs(scene),
        program=f"relightcli {__version__}",
        overwrite=config.overwrite,
    )
    if writer is None:
        return {"store": str(config.output), "status": "up to date", "notes": list(geometry.notes)}
    with writer:
        resumed = bool(writer.done)
        receivers = _receivers(config, scene, geometry, both)
        writer.set_attrs(
            {
                "scene": scene_to_json(scene, geometry),
                "plan": [{"effect": d.effect, "simulate": d.simulate, "evidence": d.evidence} for d in plan],
            }
        )
        _put_geometry(writer, geometry)
        if geometry is not source:
            writer.put("source/face", source.faces, dims=("face", "corner"))
        _put_receivers(writer, receivers)
        size = _block_size(config.light_resolution)
        _create_outputs(writer, config, len(receivers), size, len(scene.lights))
        job = VisibilityJob(
            str(writer.partial_path),
            config.light_resolution,
            config.refine,
            shadows,
            config.basis,
            config.coefficients,
            config.tolerance or 0.0,
            config.sh_order,
            config.seed,
            tuple(scene.lights.values()),
        )
        run.run_blocks(
            job,
            run.split("visibility", len(receivers), size),
            writer,
            workers=config.workers,
            label="visibility",
            quiet=config.quiet,
        )
        run.close_worker()
        writer.commit({"seconds": time.perf_counter() - started, "resumed": resumed, "workers": config.workers})
    return _summary(config, started, resumed, geometry)


def _check(config: Config) -> None:
    resolution = config.light_resolution
    if resolution not in (16, 32, 64, 128, 256):
        raise InputError(f"--light-resolution: expected 16, 32, 64, 128 or 256 texels a face; found {resolution}")
    if config.refine not in (1, 2, 4, 8) or config.refine * 4 > resolution:
        raise InputError(
            f"--refine: expected 1, 2, 4 or 8, at most a quarter of --light-resolution; found {config.refine}"
        )
    if config.basis not in BASES:
        raise InputError(f"--basis: expected one of {', '.join(BASES)}; found {config.basis!r}")
    if not 1 <= config.coefficients <= 6 * resolution * resolution:
        raise InputError(f"--coefficients: expected 1 to {6 * resolution * resolution}; found {config.coefficients}")
    if config.tolerance is not None and not 0.0 < config.tolerance < 1.0:
        raise InputError(f"--tolerance: expected more than 0 and less than 1; found {config.tolerance}")
    if not 1 <= config.sh_order <= 16:
        raise InputError(f"--sh-order: expected 1 to 16; found {config.sh_order}")
    if config.bounces != 0:
        raise InputError(
            f"--bounces: this version simulates direct light only, expected 0; found {config.bounces} "
            "(relight --reference traces any number)"
        )


def _subdivided(geometry: Geometry) -> Geometry:
    finer = tessellate(geometry)
    more = len(finer.positions) - len(geometry.positions)
    if more == 0:
        return geometry
    note = f"faces too large to carry shadows were cut: {more} more vertices (--no-subdivide keeps them whole)"
    return replace(finer, notes=(*geometry.notes, note))


def _both_sides(scene: Scene, geometry: Geometry) -> NDArray[np.bool_]:
    """Objects whose back is lit too: two-sided ones, and membranes that let light through."""
    materials = list(scene.materials.values())
    translucent = np.array([materials[m].model == "translucent" for m in geometry.material], bool)
    both: NDArray[np.bool_] = geometry.two_sided | translucent
    return both


def _inputs(scene: Scene) -> dict[str, str]:
    files = {scene.path} | {o.mesh for o in scene.objects.values()}
    files |= {m.diffuse_texture for m in scene.materials.values() if m.diffuse_texture is not None}
    return {_short(path, scene.path.parent): formats.fingerprint_file(path) for path in sorted(files)}


def _short(path: Path, folder: Path) -> str:
    try:
        return path.relative_to(folder).as_posix()
    except ValueError:
        return str(path)


def _receivers(config: Config, scene: Scene, geometry: Geometry, both: NDArray[np.bool_]) -> Receivers | PixelReceivers:
    if config.receivers == "vertices":
        return vertex_receivers(geometry.positions, geometry.normals, geometry.faces, geometry.vertex_object, both)
    kind, _, name = config.receivers.partition(":")
    if kind != "pixels" or not name:
        raise InputError(f"--receivers: expected vertices or pixels:CAMERA; found {config.receivers!r}")
    if name not in scene.cameras:
        known = ", ".join(scene.cameras) or "none"
        raise InputError(f"--receivers: {scene.path} has no camera {name!r}; it has: {known}")
    if (both & ~geometry.two_sided).any():
        raise InputError(
            "--receivers pixels: translucent materials need light from the side that the camera does not see; "
            "use --receivers vertices"
        )
    return _pixel_receivers(scene, name, geometry)


@dataclass(frozen=True)
class PixelReceivers:
    """Receivers at what a camera sees, with the picture they belong to; `texture` (N, 3) is the texture's colour."""

    points: Receivers
    pixel: NDArray[np.int32]
    weight: NDArray[np.float32]
    view: NDArray[np.float32]
    texture: NDArray[np.float32]
    coverage: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.points)


def _pixel_receivers(scene: Scene, name: str, geometry: Geometry) -> PixelReceivers:
    film = make_film(scene.cameras[name])
    tracer = Tracer(geometry.positions, geometry.faces)
    normals = primary.face_normals(geometry.positions, geometry.faces)
    samples = primary.see(tracer, film, geometry.face_object, normals, *PIXEL_GRIDS)
    seen = picture.lit_surface(geometry, samples)
    order = spatial_order(seen.position)
    sample = seen.path[order]
    position, normal = seen.position[order], seen.shading[order].astype(np.float32)
    face = samples.face[sample]
    facing = np.einsum("nx,nx->n", normals[face], samples.direction[sample]) < 0
    points = Receivers(
        position,
        normal,
        geometry.face_object[face].astype(np.int32),
        np.full(len(sample), -1, np.int32),
        np.where(facing, 1, -1).astype(np.int8),
    )
    return PixelReceivers(
        points,
        samples.pixel[sample],
        samples.weight[sample],
        seen.viewer[order].astype(np.float32),
        seen.albedo[order].astype(np.float32),
        samples.coverage,
    )


def _put_geometry(writer: formats.Writer, geometry: Geometry) -> None:
    put = writer.put
    put("mesh/position", geometry.positions, dims=("vertex", "axis"), units="m")
    put("mesh/normal", geometry.normals, dims=("vertex", "axis"))
    put("mesh/uv", geometry.uvs, dims=("vertex", "coordinate"))
    put("mesh/face", geometry.faces, dims=("face", "corner"))
    put("mesh/vertex_object", geometry.vertex_object, dims=("vertex",))
    put("mesh/face_object", geometry.face_object, dims=("face",))
    put("objects/material", geometry.material, dims=("object",))
    put("objects/two_sided", geometry.two_sided, dims=("object",))
    for material, texture in geometry.textures.items():
        put(f"textures/{material}/radiance", texture, dims=("row", "column", "colour"))


def _put_receivers(writer: formats.Writer, receivers: Receivers | PixelReceivers) -> None:
    points = receivers.points if isinstance(receivers, PixelReceivers) else receivers
    put = writer.put
    put("receivers/position", points.position, dims=("receiver", "axis"), units="m")
    put("receivers/normal", points.normal, dims=("receiver", "axis"))
    put("receivers/object", points.object, dims=("receiver",))
    put("receivers/side", points.side, dims=("receiver",))
    if isinstance(receivers, PixelReceivers):
        put("receivers/pixel", receivers.pixel, dims=("receiver",))
        put("receivers/weight", receivers.weight, dims=("receiver",))
        put("receivers/view", receivers.view, dims=("receiver", "axis"))
        put("receivers/texture", receivers.texture, dims=("receiver", "colour"))
        put("picture/coverage", receivers.coverage, dims=("row", "column"))
    else:
        put("receivers/vertex", points.vertex, dims=("receiver",))


def _block_size(resolution: int) -> int:
    """Receivers per block: a power of two whose visibility bits fill about one chunk."""
    per_receiver = 6 * resolution * resolution // 8
    size = 64
    while size * 2 * per_receiver <= CHUNK_BYTES:
        size *= 2
    return min(size, 4096)


def _create_outputs(writer: formats.Writer, config: Config, count: int, size: int, lights: int) -> None:
    resolution = config.light_resolution
    if lights:
        n = lights * POINTS_PER_LIGHT // 8
        writer.array(
            "lights/bits",
            shape=(count, n),
            dtype=np.uint8,
            chunks=(size, n),
            dims=("receiver", "point_byte"),
            attrs={
                "bit_order": "little",
                "description": "1 where the light's point is above the horizon and unblocked",
            },
            codec="zstd",
        )
    writer.array(
        "visibility/bits",
        shape=(count, 6, resolution, resolution // 8),
        dtype=np.uint8,
        chunks=(size, 6, resolution, resolution // 8),
        dims=("receiver", "cube_face", "texel_row", "texel_column_byte"),
        attrs={"bit_order": "little", "description": "1 where the texel's centre is above the horizon and unblocked"},
        codec="zstd",
    )
    if config.basis == "sh":
        n = config.sh_order**2
        writer.array("direct/sh", shape=(count, n), dtype=np.float32, chunks=(size, n), dims=("receiver", "harmonic"))
    elif config.basis == "haar":
        n = config.coefficients
        for name, dtype in (("haar_index", np.int32), ("haar_value", np.float32)):
            writer.array(
                f"direct/{name}", shape=(count, n), dtype=dtype, chunks=(size, n), dims=("receiver", "coefficient")
            )
    elif config.basis == "dense":
        n = 6 * resolution * resolution
        rows = max(1, CHUNK_BYTES // (4 * n))
        while size % rows:
            rows -= 1
        writer.array("direct/dense", shape=(count, n), dtype=np.float32, chunks=(rows, n), dims=("receiver", "texel"))


def _summary(config: Config, started: float, resumed: bool, geometry: Geometry) -> dict[str, Any]:
    store = formats.open_store(config.output, KIND)
    total = {
        key: sum(b.get(key, 0.0) for b in store.blocks) for key in ("rays", "checked", "wrong", "inferred", "bits")
    }
    # Share of all bits above the horizon that the check predicts to be wrong; what it found was mended.
    wrong = total["wrong"] / total["checked"] * total["inferred"] / total["bits"] if total["checked"] else 0.0
    notes = list(geometry.notes)
    if wrong > WRONG_BITS:
        notes.append(f"{wrong:.1e} of the visibility bits are wrong: fine structures; --refine 2 or 1 traces more")
    return {
        "store": str(config.output),
        "status": "resumed" if resumed else "written",
        "receivers": int(store.array("receivers/side").shape[0]),
        "rays": int(total["rays"]),
        "wrong_bits": wrong,
        "checked_bits": int(total["checked"]),
        "bytes": sum(size.stored for size in store.sizes().values()),
        "peak_bytes": int(max((b.get("peak_bytes", 0.0) for b in store.blocks), default=0)),
        "seconds": time.perf_counter() - started,
        "notes": notes,
    }


def _raw_bytes(geometry: Geometry, points: Receivers) -> int:
    arrays: list[NDArray[Any]] = [
        geometry.positions,
        geometry.normals,
        geometry.uvs,
        geometry.faces,
        points.position,
        points.normal,
    ]
    return sum(a.nbytes for a in [*arrays, *geometry.textures.values()])


def _dry_run(
    config: Config,
    scene: Scene,
    geometry: Geometry,
    both: NDArray[np.bool_],
    plan: list[effects.Decision],
    shadows: bool,
) -> dict[str, Any]:
    """The plan with its cost, predicted from a pilot of a few hundred receivers.

    The bytes are an upper bound: the mesh counts uncompressed, and the pilot's bits compress worse in small groups.
    """
    receivers = _receivers(config, scene, geometry, both)
    points = receivers.points if isinstance(receivers, PixelReceivers) else receivers
    rays = seconds = packed = 0.0
    if shadows and len(points):
        tracer = Tracer(geometry.positions, geometry.faces)
        starts = np.linspace(0, max(0, len(points) - visibility.GROUP), PILOT_GROUPS + 1).astype(int)
        pilot = 0
        for k, start in enumerate(starts):
            rows = slice(start, start + visibility.GROUP)
            clock = time.perf_counter()
            block = visibility.trace_visibility(
                tracer, points.position[rows], points.normal[rows], config.light_resolution, config.refine, config.seed
            )
            if k:  # the first run pays for compilation
                seconds += time.perf_counter() - clock
                rays += block.rays
                pilot += len(block.bits)
                packed += len(zlib.compress(block.bits.tobytes(), 1))
        rays *= len(points) / pilot
        packed *= len(points) / pilot
        seconds *= len(points) / pilot / max(1, config.workers)
    return {
        "dry_run": True,
        "store": str(config.output),
        "receivers": len(points),
        "plan": [{"effect": d.effect, "simulate": d.simulate, "evidence": d.evidence} for d in plan],
        "predicted": {"rays": int(rays), "seconds": seconds, "bytes": int(packed) + _raw_bytes(geometry, points)},
        "notes": list(geometry.notes),
    }
