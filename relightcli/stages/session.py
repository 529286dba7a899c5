"""One run of relight over one or many frames, and what consecutive frames share."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli import __version__
from relightcli.adapters import images
from relightcli.adapters.ply import write_ply
from relightcli.adapters.rays import Tracer
from relightcli.core.lights.latlong import make_latlong
from relightcli.core.shade import picture, primary
from relightcli.core.shade.backdrop import backdrop
from relightcli.core.transport.camera import make_film
from relightcli.errors import NumericalError
from relightcli.run.accounting import Account, Meter
from relightcli.scene.model import Camera, Material
from relightcli.scene.settings import apply_settings
from relightcli.stages.budget import summary
from relightcli.stages.lighting import LightingStore, Radiance, together
from relightcli.stages.outputs import (
    PICTURES,
    Config,
    layer_names,
    numbered,
    put_picture,
    resolve_camera,
    resolve_environment,
)
from relightcli.stages.shots import Shot

CHANGES = ("light", "materials", "places")


@dataclass(frozen=True)
class _View:
    """What depends on the camera alone."""

    camera: Camera
    matrix: picture.PixelMatrix
    coverage: NDArray[np.float32]
    active: NDArray[np.bool_]
    towards: NDArray[np.float32]


class Session:
    """One run over one or many frames; keeps what consecutive frames share."""

    def __init__(self, lighting: LightingStore, config: Config) -> None:
        self.lighting = lighting
        self.config = config
        lighting.apart = config.layers
        self.lighting_seconds = 0.0
        self.notes: list[str] = []
        self._views: dict[str, _View] = {}
        self._tracer: Tracer | None = None
        self._map: tuple[Path, NDArray[np.float32]] | None = None
        self._radiance: list[NDArray[np.float32]] = []
        self._last: tuple[object, ...] = ()
        self._poses: tuple[str, ...] | None = None
        self._moves: tuple[str, ...] | None = None
        self._positions: list[NDArray[np.float64]] = []
        self._seconds: dict[str, list[float]] = {}
        self._writer: formats.Writer | None = None
        self._started, self._meter = time.perf_counter(), Meter()

    def light(self, shot: Shot, suffix: str) -> tuple[_View | None, NDArray[np.float32], list[Radiance]]:
        """One frame's view, where the output is a picture, its environment, and the receivers' light in parts."""
        self._pose(shot.poses)
        self._move(shot.moves)
        materials = apply_settings(self.lighting.scene.materials, shot.settings)
        if suffix in PICTURES:
            with ThreadPoolExecutor(1) as reader:  # the map is read while the view is made
                reading = reader.submit(self._environment, shot)
                view = self._view(shot.camera)
                environment = reading.result()
            return view, environment, self._light(shot, environment, materials, view.towards, view.active)
        environment = self._environment(shot)
        towards = None
        if self.lighting.scene.cameras:
            eye = np.array(resolve_camera(shot.camera, self.lighting.scene.cameras).eye)
            towards = _towards(eye, self.lighting.position)
        return None, environment, self._light(shot, environment, materials, towards, None)

    def write(self, shot: Shot, suffix: str) -> str:
        view, environment, parts = self.light(shot, suffix)
        if view is not None:
            return self._write_picture(shot, suffix, view, environment, parts)
        radiance = together(parts)
        total = radiance.diffuse if radiance.specular is None else radiance.diffuse + radiance.specular
        if suffix == ".ply":
            return self._write_ply(shot, total)
        self._radiance.append(total)
        self._positions.append(self.lighting.position)
        return self.config.output

    def _pose(self, poses: tuple[str, ...]) -> None:
        """Poses objects; what was seen of others is not kept."""
        if poses == self._poses or (self._poses is None and not poses):
            return
        self._poses = poses
        self.notes.extend(n for n in self.lighting.set_poses(poses) if n not in self.notes)
        self._views.clear()
        self._tracer = None

    def _move(self, moves: tuple[str, ...]) -> None:
        """Puts things elsewhere; what was seen of others is not kept."""
        if moves == self._moves or (self._moves is None and not moves):
            return
        self._moves = moves
        self.notes.extend(n for n in self.lighting.set_moves(moves) if n not in self.notes)
        self._views.clear()
        self._tracer = None

    def _environment(self, shot: Shot) -> NDArray[np.float32]:
        path = resolve_environment(shot.env, self.lighting.scene.environments)
        if self._map is None or self._map[0] != path:
            radiance, notes = images.read_environment_with_notes(path)
            self.notes.extend(n for n in notes if n not in self.notes)
            self._map = (path, radiance)
        return self._map[1]

    def _light(
        self,
        shot: Shot,
        environment: NDArray[np.float32],
        materials: dict[str, Material],
        towards: NDArray[np.float32] | None,
        active: NDArray[np.bool_] | None,
    ) -> list[Radiance]:
        clock = time.perf_counter()
        radiance = self.lighting.exit_radiance(
            environment, shot.env_rotate, materials, towards, active, self.config.basis, self.config.bounces
        )
        seconds = time.perf_counter() - clock
        self.lighting_seconds += seconds
        now = (id(environment), shot.env_rotate), shot.settings, shot.moves
        if self._last:
            changed = [kind for kind, a, b in zip(CHANGES, now, self._last, strict=True) if a != b]
            kind = changed[0] if changed else "view"
            self._seconds.setdefault(kind, []).append(seconds)
        self._last = now
        return radiance

    def rates(self) -> dict[str, float]:
        """Frames of light per second, median, by what has changed: light, else materials, else places, else view."""
        return {kind: 1.0 / max(median(seconds), 1e-9) for kind, seconds in self._seconds.items()}

    def _view(self, name: str | None) -> _View:
        lighting = self.lighting
        if lighting.camera_name is not None:
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
            towards = np.zeros((len(lighting), 3), np.float32)
            towards[: lighting.pixels] = read("receivers/view")
            active = np.arange(len(lighting)) < lighting.pixels
            return _View(camera, matrix, read("picture/coverage"), active, towards)
        geometry = lighting.geometry
        if self._tracer is None:
            self._tracer = Tracer(geometry.positions, geometry.faces, lighting.threads)
        normals = primary.face_normals(geometry.positions, geometry.faces)
        film = make_film(camera)
        base = primary.TEXTURE_GRID if geometry.textures else primary.BASE_GRID
        samples = primary.see(self._tracer, film, geometry.face_object, normals, base)
        front, back = lighting.receiver_of_vertex()
        matrix = picture.vertex_matrix(geometry, samples, normals, front, back, lighting.buried(), width * height)
        towards = _towards(film.eye, lighting.position)
        return _View(camera, matrix, samples.coverage, matrix.used(len(lighting)), towards)

    def _write_picture(
        self, shot: Shot, suffix: str, view: _View, environment: NDArray[np.float32], parts: list[Radiance]
    ) -> str:
        width, height = view.camera.size
        threads = self.config.workers
        layers = {}
        if self.config.layers:
            direct, *bounced = parts
            split = [Radiance(direct.diffuse, None), *bounced, Radiance(np.zeros_like(direct.diffuse), direct.specular)]
            for name, part in zip(layer_names(len(parts)), split, strict=True):
                flat = picture.assemble(view.matrix, part.diffuse, part.specular, threads)
                layers[name] = flat.reshape(height, width, 3)
            rgb = np.sum(list(layers.values()), axis=0)
        else:
            total = together(parts)
            rgb = picture.assemble(view.matrix, total.diffuse, total.specular, threads).reshape(height, width, 3)
        _need_finite(rgb, str(self.config.store))
        alpha = view.coverage
        if self.config.background:
            behind = backdrop(make_latlong(environment, shot.env_rotate), make_film(view.camera), threads)
            behind *= 1.0 - alpha[..., None]
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
            "relight:bounces": self.lighting.bounces if config.bounces is None else config.bounces,
        }
        if shot.poses:
            metadata["relight:pose"] = " ".join(shot.poses)
        if config.suns != "soft":
            metadata["relight:suns"] = config.suns
        if shot.moves:
            metadata["relight:move"] = " ".join(shot.moves)
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

    def begin(self, shots: list[Shot]) -> bool:
        """Starts the radiance store, if that is asked for. False: it is there, made from the same, and up to date.

        Raises StoreError where one made from others is there, or another run is making one.
        """
        config = self.config
        if not config.output.endswith(".zarr"):
            return True
        maps = {resolve_environment(shot.env, self.lighting.scene.environments) for shot in shots}
        previous = {} if config.previous is None else {"previous": formats.open_store(config.previous).fingerprint}
        self._writer = formats.begin(
            config.output,
            "radiance",
            settings={
                "env": config.env,
                "env_rotate": config.env_rotate,
                "camera": config.camera,
                "set": list(config.settings),
                "basis": config.basis,
                "bounces": config.bounces,
                "frames": None if config.frames is None else formats.fingerprint_file(config.frames),
                **({"pose": list(config.poses)} if config.poses else {}),
                **({} if config.suns == "soft" else {"suns": config.suns}),
                **({"move": list(config.moves)} if config.moves else {}),
            },
            inputs={
                "store": self.lighting.store.fingerprint,
                **{str(path): formats.fingerprint_file(path) for path in sorted(maps)},
                **previous,
            },
            program=f"relightcli {__version__}",
            overwrite=config.overwrite,
        )
        return self._writer is not None

    def finish(self) -> None:
        """Writes the radiance store, if that is what was asked for."""
        writer = self._writer
        if writer is None:
            return
        radiance = np.stack(self._radiance)
        _need_finite(radiance, str(self.config.store))
        writer.put("radiance", radiance, dims=("frame", "receiver", "colour"), units="W sr-1 m-2")
        if self._poses is None and self._moves is None:
            writer.put("receivers/position", self.lighting.position, dims=("receiver", "axis"), units="m")
        else:
            posed = np.stack(self._positions)
            writer.put("receivers/position", posed, dims=("frame", "receiver", "axis"), units="m")
        self.lighting.put_light(writer)
        account = Account()
        account.steps["light"] = self._meter.read()
        writer.commit(summary(account, self._started, False, self.config.workers, self.lighting.store))

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Lets the radiance store go; what was not finished is of no use to the next run."""
        if self._writer is not None:
            self._writer.abandon()


def _towards(eye: NDArray[np.float64], position: NDArray[np.float64]) -> NDArray[np.float32]:
    d = eye - position
    unit: NDArray[np.float64] = d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-300)
    return unit.astype(np.float32)


def _need_finite(values: NDArray[np.float32], what: str) -> None:
    bad = ~np.isfinite(values)
    if bad.any():
        raise NumericalError(f"{what}: {int(bad.sum())} values of the result are not finite; nothing was written")
