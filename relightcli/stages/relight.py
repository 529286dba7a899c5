"""Stage relight: any store and a sky in, pictures out."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli import __version__
from relightcli.adapters import images
from relightcli.adapters.ply import write_ply
from relightcli.adapters.rays import Tracer
from relightcli.core.lights.latlong import lookup_many, make_latlong
from relightcli.core.shade import picture, primary
from relightcli.core.transport.camera import film_directions, make_film
from relightcli.errors import InputError, NumericalError
from relightcli.scene.model import Camera, Material
from relightcli.scene.settings import apply_settings
from relightcli.stages.lighting import LightingStore, Radiance
from relightcli.stages.shots import Shot, read_shots

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
    frames: Path | None = None
    layers: bool = False
    background: bool = False
    exposure: float = 0.0
    basis: str | None = None
    reference: bool = False
    spp: int = 256
    bounces: int | None = None
    seed: int = 0
    workers: int = 1
    overwrite: bool = False
    dry_run: bool = False
    quiet: bool = False


def relight(config: Config) -> dict[str, Any]:
    """Runs the stage; returns what was written and what it took."""
    started = time.perf_counter()
    suffix = _suffix(config.output)
    _check(config, suffix)
    default = Shot(1, config.env, config.env_rotate, config.camera, config.exposure, config.settings)
    shots = [default] if config.frames is None else read_shots(config.frames, default)
    if config.reference:
        from relightcli.stages.reference import render_reference

        return render_reference(config, shots, suffix, started)
    lighting = LightingStore(config.store, config.workers)
    if config.dry_run:
        return _plan(config, shots, lighting)
    session = _Session(lighting, config)
    opened = time.perf_counter() - started
    written, clocks = [], []
    try:
        for shot in shots:
            clock = time.perf_counter()
            written.append(session.write(shot, suffix))
            clocks.append(time.perf_counter() - clock)
    except BaseException:
        session.abandon()
        raise
    session.finish()
    return {
        "store": str(config.store),
        "output": written if config.frames else written[0],
        "frames": len(written),
        "seconds": time.perf_counter() - started,
        "open_seconds": opened,
        "lighting_seconds": session.lighting_seconds / len(written),
        "frame_seconds": clocks,
        "notes": session.notes,
    }


def _plan(config: Config, shots: list[Shot], lighting: LightingStore) -> dict[str, Any]:
    """What a run would write, with everything that can be wrong looked at, and nothing done."""
    frames = []
    for shot in shots:
        apply_settings(lighting.scene.materials, shot.settings)
        frames.append(
            {
                "output": numbered(config.output, shot.number) if config.frames else config.output,
                "environment": str(resolve_environment(shot.env, lighting.scene.environments)),
                "env_rotate": shot.env_rotate,
                "set": list(shot.settings),
            }
        )
    return {"dry_run": True, "store": str(config.store), "receivers": len(lighting), "frames": frames, "notes": []}


def _suffix(output: str) -> str:
    if output == "-":
        return ".exr"
    suffix = Path(output).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"--output {output}: expected a name ending in {', '.join(SUFFIXES)}, or - for stdout")
    return suffix


def _check(config: Config, suffix: str) -> None:
    sequence = config.frames is not None
    if sequence and suffix != ".zarr" and "#" not in Path(config.output).name:
        raise InputError(f"--output {config.output}: a sequence needs #### in the name for the frame number")
    if config.layers and suffix != ".exr":
        raise InputError(f"--layers: expected an .exr output, which can hold layers; found {config.output}")
    if config.reference and suffix not in PICTURES:
        raise InputError(f"--reference makes pictures; expected one of {', '.join(PICTURES)}; found {config.output}")
    if not np.isfinite(config.env_rotate) or not np.isfinite(config.exposure):
        raise InputError("--env-rotate and --exposure: expected finite numbers")
    if config.bounces is not None and not config.reference and config.bounces != 0:
        raise InputError(
            f"--bounces {config.bounces}: the store holds direct light (0 bounces); only --reference traces more"
        )


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


@dataclass(frozen=True)
class _View:
    """What depends on the camera alone."""

    camera: Camera
    matrix: picture.PixelMatrix
    coverage: NDArray[np.float32]
    active: NDArray[np.bool_]
    towards: NDArray[np.float32]


class _Session:
    """One run over one or many frames; keeps what consecutive frames share."""

    def __init__(self, lighting: LightingStore, config: Config) -> None:
        self.lighting = lighting
        self.config = config
        self.lighting_seconds = 0.0
        self.notes: list[str] = []
        self._views: dict[str, _View] = {}
        self._tracer: Tracer | None = None
        self._maps: dict[str, str] = {}
        self._map: tuple[Path, NDArray[np.float32]] | None = None
        self._writer: formats.Writer | None = None
        self._radiance: list[NDArray[np.float32]] = []

    def write(self, shot: Shot, suffix: str) -> str:
        environment = self._environment(shot)
        materials = apply_settings(self.lighting.scene.materials, shot.settings)
        if suffix in PICTURES:
            return self._write_picture(shot, suffix, environment, materials)
        towards = None
        if self.lighting.scene.cameras:
            eye = np.array(resolve_camera(shot.camera, self.lighting.scene.cameras).eye)
            towards = _towards(eye, self.lighting.position)
        radiance = self._light(shot, environment, materials, towards, None)
        total = radiance.diffuse if radiance.specular is None else radiance.diffuse + radiance.specular
        if suffix == ".ply":
            return self._write_ply(shot, total)
        self._radiance.append(total)
        return self.config.output

    def _environment(self, shot: Shot) -> NDArray[np.float32]:
        path = resolve_environment(shot.env, self.lighting.scene.environments)
        if self._map is None or self._map[0] != path:
            radiance, notes = images.read_environment_with_notes(path)
            self.notes.extend(n for n in notes if n not in self.notes)
            self._map = (path, radiance)
            if self.config.output.endswith(".zarr"):
                self._maps[str(path)] = formats.fingerprint_file(path)
        return self._map[1]

    def _light(
        self,
        shot: Shot,
        environment: NDArray[np.float32],
        materials: dict[str, Material],
        towards: NDArray[np.float32] | None,
        active: NDArray[np.bool_] | None,
    ) -> Radiance:
        clock = time.perf_counter()
        radiance = self.lighting.exit_radiance(
            environment, shot.env_rotate, materials, towards, active, self.config.basis
        )
        self.lighting_seconds += time.perf_counter() - clock
        return radiance

    def _view(self, name: str | None) -> _View:
        lighting = self.lighting
        if lighting.camera_name is not None:
            if name not in (None, lighting.camera_name):
                raise InputError(
                    f"--camera {name}: the store's receivers are the pixels of camera {lighting.camera_name!r}; "
                    "precompute with --receivers vertices for other views"
                )
            name = lighting.camera_name
        camera = resolve_camera(name, lighting.scene.cameras)
        if camera.name not in self._views:
            self._views[camera.name] = self._make_view(camera)
        return self._views[camera.name]

    def _make_view(self, camera: Camera) -> _View:
        lighting = self.lighting
        width, height = camera.size
        if lighting.camera_name is not None:
            read = lighting.store.read
            matrix = picture.sample_matrix(
                read("receivers/pixel"), read("receivers/weight"), read("receivers/texture"), width * height
            )
            active = np.ones(len(lighting), bool)
            return _View(camera, matrix, read("picture/coverage"), active, read("receivers/view"))
        geometry = lighting.geometry
        if self._tracer is None:
            self._tracer = Tracer(geometry.positions, geometry.faces)
        normals = primary.face_normals(geometry.positions, geometry.faces)
        film = make_film(camera)
        base = primary.TEXTURE_GRID if geometry.textures else primary.BASE_GRID
        samples = primary.see(self._tracer, film, geometry.face_object, normals, base)
        front, back = lighting.receiver_of_vertex()
        matrix = picture.vertex_matrix(geometry, samples, normals, front, back, width * height)
        towards = _towards(film.eye, lighting.position)
        return _View(camera, matrix, samples.coverage, matrix.used(len(lighting)), towards)

    def _write_picture(
        self, shot: Shot, suffix: str, environment: NDArray[np.float32], materials: dict[str, Material]
    ) -> str:
        view = self._view(shot.camera)
        width, height = view.camera.size
        radiance = self._light(shot, environment, materials, view.towards, view.active)
        threads = self.config.workers
        rgb = picture.assemble(view.matrix, radiance.diffuse, radiance.specular, threads).reshape(height, width, 3)
        _need_finite(rgb, str(self.config.store))
        alpha = view.coverage
        layers = {"direct": rgb} if self.config.layers else {}
        if self.config.background:
            behind = environment_behind(environment, shot.env_rotate, view.camera) * (1.0 - alpha[..., None])
            if self.config.layers:
                layers["background"] = behind
            rgb, alpha = rgb + behind, np.ones_like(alpha)
        pixels = np.concatenate([rgb, alpha[..., None]], axis=2)
        return self._put_picture(shot, suffix, pixels, layers)

    def _put_picture(
        self, shot: Shot, suffix: str, pixels: NDArray[np.float32], layers: dict[str, NDArray[np.float32]]
    ) -> str:
        config, store = self.config, self.lighting.store
        metadata = {
            "relight:program": f"relightcli {__version__}",
            "relight:store": str(config.store),
            "relight:store_fingerprint": store.fingerprint,
            "relight:environment": str(resolve_environment(shot.env, self.lighting.scene.environments)),
            "relight:env_rotate": float(shot.env_rotate),
            "relight:camera": self._view(shot.camera).camera.name,
            "relight:set": " ".join(shot.settings),
            "relight:bounces": int(store.settings.get("bounces", 0)),
        }
        return put_picture(config, shot, suffix, pixels, layers, metadata)

    def _write_ply(self, shot: Shot, radiance: NDArray[np.float32]) -> str:
        geometry, store = self.lighting.geometry, self.lighting.store
        front, _ = self.lighting.receiver_of_vertex()
        # The mesh as the scene has it: its vertices come first, its faces are kept where precompute has cut them.
        faces: Any = store.read("source/face") if "source/face" in store else geometry.faces
        count = int(faces.max()) + 1 if "source/face" in store else len(geometry.positions)
        colours = np.zeros((count, 3), np.float32)
        lit = front[:count] >= 0
        colours[lit] = radiance[front[:count][lit]]
        _need_finite(colours, str(self.config.store))
        name = numbered(self.config.output, shot.number) if self.config.frames else self.config.output
        write_ply(name, geometry.positions[:count], faces, colours, shot.exposure)
        return name

    def finish(self) -> None:
        """Writes the radiance store, if that is what was asked for."""
        if not self._radiance:
            return
        config, store = self.config, self.lighting.store
        radiance = np.stack(self._radiance)
        _need_finite(radiance, str(config.store))
        writer = formats.begin(
            config.output,
            "radiance",
            settings={
                "env": config.env,
                "env_rotate": config.env_rotate,
                "camera": config.camera,
                "set": list(config.settings),
                "frames": None if config.frames is None else formats.fingerprint_file(config.frames),
            },
            inputs={"store": store.fingerprint, **self._maps},
            program=f"relightcli {__version__}",
            overwrite=config.overwrite,
        )
        if writer is None:
            return
        with writer:
            writer.put("radiance", radiance, dims=("frame", "receiver", "colour"), units="W sr-1 m-2")
            writer.put("receivers/position", self.lighting.position, dims=("receiver", "axis"), units="m")
            writer.commit({})

    def abandon(self) -> None:
        self._radiance = []


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


def environment_behind(environment: NDArray[np.float32], rotate: float, camera: Camera) -> NDArray[np.float32]:
    """The environment through every pixel, (H, W, 3): the mean of 2 x 2 points."""
    film = make_film(camera)
    width, height = camera.size
    sky = make_latlong(environment, rotate)
    total = np.zeros((height, width, 3))
    for dx in (0.25, 0.75):
        for dy in (0.25, 0.75):
            x, y = np.arange(width)[None, :] + dx, np.arange(height)[:, None] + dy
            total += lookup_many(sky, film_directions(film, x, y))
    return (total / 4.0).astype(np.float32)


def _towards(eye: NDArray[np.float64], position: NDArray[np.float64]) -> NDArray[np.float32]:
    d = eye - position
    unit: NDArray[np.float64] = d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-300)
    return unit.astype(np.float32)


def _need_finite(values: NDArray[np.float32], what: str) -> None:
    bad = ~np.isfinite(values)
    if bad.any():
        raise NumericalError(f"{what}: {int(bad.sum())} values of the result are not finite; nothing was written")
