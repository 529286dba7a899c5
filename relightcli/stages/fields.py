"""Fields of what moves: which there are to simulate, their simulation, and where they are kept.

Objects that are the same in their own frames share a field. With a library, fields are stores of their own there, named
by what they were made from: an object is simulated once and used in many scenes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli import __version__
from relightcli.adapters.gltf import buffer_files
from relightcli.adapters.rays import Tracer
from relightcli.core.fields.adaptive import adaptive_radii, least_resolution
from relightcli.core.fields.albedos import NODES
from relightcli.core.fields.body import Body
from relightcli.core.fields.build import RAYS, field_samples
from relightcli.core.fields.field import shell_radii
from relightcli.core.fields.lobe_functions import FUNCTIONS
from relightcli.core.fields.proxies import POWER, place_proxies
from relightcli.core.fields.sources import source_field
from relightcli.core.transport.receivers import Receivers, join_receivers
from relightcli.core.transport.shading import vertex_colours
from relightcli.errors import InputError
from relightcli.scene.bodies import OwnMesh, own_mesh, put_meshes, vertex_numbers
from relightcli.scene.materials import table_from_material
from relightcli.scene.model import Geometry, Scene
from relightcli.stages.bodies import body_of
from relightcli.stages.field_job import FieldSpec, simulate, what_is_sent
from relightcli.stages.field_store import copy_field, put_body, put_source

KIND = "field"
DIFFUSE_RESOLUTION, GLOSSY_RESOLUTION = 16, 32  # [Pan 2007, section 6]
SPACINGS = ("geometric", "paper", "adaptive")
DIRECTION_ERROR = 0.05  # relative, that `adaptive` allows between the directions of the innermost sphere
PILOT_SHELLS, PILOT = 4, 32  # spheres and samples of each that a dry run traces
DIFFUSE_TOLERANCE, GLOSSY_TOLERANCE = 0.01, 0.02  # of the compressed transfer
RATIO = 25.0  # that a dry run counts on
NOISE = 0.5  # of the scene's tolerance: what the self transfer's own noise may be


@dataclass(frozen=True)
class FieldSettings:
    """What `--field-*` says. resolution None: by measured error where `spacing` is adaptive; else 16, and 32 for
    objects with a specular lobe that is not adjustable. tolerance None: 0.01, and 0.02 for objects with a lobe."""

    shells: int = 16
    resolution: int | None = None
    proxies: int = 8
    order: int = 4
    spacing: str = "geometric"
    tolerance: float | None = None
    library: Path | None = None

    def check(self) -> None:
        """Raises InputError for values out of range."""
        for name, value, low, high in (
            ("shells", self.shells, 2, 256),
            ("resolution", self.resolution_of(False), 1, 128),
            ("proxies", self.proxies, 1, 256),
            ("order", self.order, 1, 8),
        ):
            if not low <= value <= high:
                raise InputError(f"--field-{name}: expected {low} to {high}; found {value}")
        tolerance = self.tolerance_of(False)
        if not 0.001 <= tolerance <= 0.5:
            raise InputError(f"--field-tolerance: expected 0.001 to 0.5; found {tolerance}")
        if self.spacing not in SPACINGS:
            raise InputError(f"--field-spacing: expected one of {', '.join(SPACINGS)}; found {self.spacing!r}")

    def resolution_of(self, glossy: bool) -> int:
        """Directions along a cube face."""
        if self.resolution is None:
            return GLOSSY_RESOLUTION if glossy else DIFFUSE_RESOLUTION
        return self.resolution

    def tolerance_of(self, glossy: bool) -> float:
        """Relative error of the compressed transfer."""
        if self.tolerance is None:
            return GLOSSY_TOLERANCE if glossy else DIFFUSE_TOLERANCE
        return self.tolerance

    def as_json(self) -> dict[str, Any]:
        """What the store's bytes hang on."""
        return {
            "shells": self.shells,
            "resolution": self.resolution,
            "proxies": self.proxies,
            "order": self.order,
            "spacing": self.spacing,
            "transfer_tolerance": self.tolerance,
        }


@dataclass(frozen=True)
class Mover:
    """One rigid object: its mesh in its own frame, the body, the number of its field, and whether that holds for any
    albedo (`core.fields.albedos`) or is one of functions of its lobe (`core.fields.lobe_functions`)."""

    mesh: OwnMesh
    body: Body
    field: int
    any_albedo: bool
    by_function: bool


@dataclass(frozen=True)
class Distinct:
    """One field to simulate: its spec, body, mean texture around vertices, shells, proxies, what it is made from."""

    spec: FieldSpec
    body: Body
    texture: NDArray[np.float32]
    radii: NDArray[np.float64]
    proxies: NDArray[np.float64]
    settings: dict[str, Any]
    inputs: dict[str, str]


@dataclass(frozen=True)
class Moving:
    """Everything that may be moved, before any ray: the rigid objects, and the fields that they need."""

    movers: tuple[Mover, ...]
    fields: tuple[Distinct, ...]

    def renumbered(self, first: int) -> Moving:
        """The same, its fields numbered from `first`."""
        fields = [replace(f, spec=replace(f.spec, prefix=f"fields/{first + k}/")) for k, f in enumerate(self.fields)]
        return Moving(tuple(replace(mover, field=first + mover.field) for mover in self.movers), tuple(fields))


def find_movers(scene: Scene, settings: FieldSettings, cut: bool, seed: int) -> Moving:
    """The rigid objects of a scene. Raises InputError for one that no field can be made of."""
    movers: list[Mover] = []
    fields: list[Distinct] = []
    known: dict[str, int] = {}
    for name, spec in scene.objects.items():
        if spec.motion != "rigid":
            continue
        material = scene.materials[spec.material]
        if material.model == "translucent":
            raise InputError(
                f"{scene.path}: objects.{name}: expected a material that lets no light through for an object that "
                f"moves; {spec.material!r} is translucent"
            )
        mesh = own_mesh(scene, name, cut)
        texture = vertex_colours(mesh.geometry)
        own = mesh.geometry
        any_albedo = material.adjustable and material.model == "lambert" and bool((texture == texture[:, :1]).all())
        if any_albedo:
            material = replace(material, diffuse=NODES)
        body = body_of(own.positions, own.normals, own.faces, spec.two_sided, texture, material, settings.order)
        by_function = material.adjustable and body.terms > 1
        files = [spec.mesh, *buffer_files(spec.mesh)]
        if material.diffuse_texture is not None:
            files.append(material.diffuse_texture)
        inputs = {f"file{i}": formats.fingerprint_file(file) for i, file in enumerate(files)}
        reflectance = table_from_material(replace(material, adjustable=False))
        made = {
            **settings.as_json(),
            "material": {k: v for k, v in reflectance.items() if k != "diffuse_texture"},
            "shape": mesh.shape.tolist(),
            "two_sided": spec.two_sided,
            "cut": cut,
            "tolerance": NOISE * scene.tolerance,
            "rays": RAYS,
            "proxy_power": POWER,
            "seed": seed,
        }
        if by_function:
            made["functions"] = FUNCTIONS
        key = formats.fingerprint_json({"settings": made, "inputs": inputs})
        if key not in known:
            known[key] = len(fields)
            proxies = place_proxies(body.point, settings.proxies, seed)
            radii, resolution = _samples(body, settings, seed, by_function)
            field = FieldSpec(
                f"fields/{len(fields)}/",
                material,
                spec.two_sided,
                settings.order,
                settings.shells,
                resolution,
                len(proxies),
                body.colours,
                by_function,
                len(body.point),
                RAYS,
                NOISE * scene.tolerance,
                settings.tolerance_of(body.terms > 1),
                seed,
            )
            fields.append(Distinct(field, body, texture, radii, proxies, made, inputs))
        movers.append(Mover(mesh, body, known[key], any_albedo, by_function))
    return Moving(tuple(movers), tuple(fields))


def _samples(body: Body, settings: FieldSettings, seed: int, by_function: bool) -> tuple[NDArray[np.float64], int]:
    """Radii of the shells, and directions along a cube face: of fields of functions, of which there are five in one,
    no more than of diffuse ones."""
    resolution = settings.resolution_of(body.terms > 1 and not by_function)
    if settings.spacing != "adaptive":
        return shell_radii(body.radius, settings.shells, settings.spacing), resolution
    tracer = Tracer(body.positions, body.faces)
    radii = adaptive_radii(tracer, body, settings.shells, seed)
    if settings.resolution is None:
        resolution = least_resolution(tracer, body, float(radii[0]), DIRECTION_ERROR, seed)
    return radii, resolution


def place(moving: Moving, geometry: Geometry) -> Geometry:
    """`geometry`, in which these objects are uncut, with their own meshes."""
    return put_meshes(geometry, [mover.mesh for mover in moving.movers])


def without(moving: Moving, geometry: Geometry) -> Geometry:
    """`geometry` without the faces of what moves."""
    own = [geometry.object_names.index(mover.mesh.name) for mover in moving.movers]
    keep = ~np.isin(geometry.face_object, own)
    return replace(geometry, faces=geometry.faces[keep], face_object=geometry.face_object[keep])


def add_points(
    moving: Moving, source: Geometry, geometry: Geometry, receivers: Receivers
) -> tuple[Receivers, tuple[int, ...]]:
    """Receivers of the static objects, then the points of every mover where the scene has it, in the order of its
    field; and the first receiver of each of these groups. source: the geometry before its movers were put in."""
    starts = [0]
    count = len(source.positions)
    for mover in moving.movers:
        body, matrix = mover.body, mover.mesh.placement
        k = geometry.object_names.index(mover.mesh.name)
        number = vertex_numbers(source, k, len(body.positions), count)
        count += int((number >= count).sum())
        normal = body.normal.astype(np.float64) @ matrix[:3, :3].T
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        starts.append(len(receivers))
        points = Receivers(
            body.point @ matrix[:3, :3].T + matrix[:3, 3],
            normal.astype(np.float32),
            np.full(len(normal), k, np.int32),
            number[body.vertex].astype(np.int32),
            body.side,
        )
        receivers = join_receivers(receivers, points)
    return receivers, tuple(starts)


def describe(moving: Moving, scene: Scene, starts: tuple[int, ...], first_source: int = 0) -> dict[str, Any]:
    """The attribute `fields` of the store.

    objects: name to the number of its field, its first receiver and their number, its placement (4, 4), own frame to
    world, whether the field holds for any albedo, or is one of functions of a lobe; lights: name to the number of its
    source field, under `sources/`.
    """
    objects = {
        mover.mesh.name: {
            "field": mover.field,
            "first": starts[1 + i],
            "count": len(mover.body.point),
            "placement": mover.mesh.placement.tolist(),
            "any_albedo": mover.any_albedo,
            "by_function": mover.by_function,
        }
        for i, mover in enumerate(moving.movers)
    }
    return {"objects": objects, "lights": {name: {"source": j} for j, name in enumerate(scene.lights, first_source)}}


def put_fields(
    writer: formats.Writer,
    moving: Moving,
    scene: Scene,
    settings: FieldSettings,
    workers: int,
    quiet: bool,
    scheduler: str | None = None,
    first_source: int = 0,
) -> None:
    """Simulates every field into the store, or takes it from the library, where it is simulated if it is not there."""
    if settings.library is None:
        for field in moving.fields:
            _put_body(writer, field)
        simulate(writer, [field.spec for field in moving.fields], workers, quiet, scheduler)
    else:
        settings.library.mkdir(parents=True, exist_ok=True)
        for field in moving.fields:
            copy_field(_from_library(field, settings, workers, quiet, scheduler), writer, field.spec.prefix)
    spacing = "geometric" if settings.spacing == "adaptive" else settings.spacing
    for j, light in enumerate(scene.lights.values(), first_source):
        source = source_field(light, settings.shells, settings.resolution_of(False), settings.order, spacing)
        put_source(writer, f"sources/{j}/", source, light.radiance)


def predict(moving: Moving) -> tuple[float, float, float]:
    """Rays, seconds of one process and bytes that the fields take, from a pilot of samples. Bytes: as
    RATIO says."""
    rays = seconds = size = 0.0
    for field in moving.fields:
        spec, body = field.spec, field.body
        tracer = Tracer(body.positions, body.faces)
        n = spec.order**2
        nothing = np.zeros((spec.points, spec.proxies, n, n, spec.colours), np.float32)
        dark = what_is_sent(spec, body, nothing, field.texture, field.proxies)
        for _ in range(2):  # the first run pays for compilation
            clock = time.perf_counter()
            for shell in np.linspace(0, spec.shells - 1, PILOT_SHELLS).astype(int):
                start = int(shell) * spec.cells
                field_samples(
                    tracer, body, dark, field.radii, spec.resolution, start, start + min(PILOT, spec.cells), spec.rays
                )
            taken = time.perf_counter() - clock
        samples = spec.shells * spec.cells
        seconds += taken * samples / (PILOT_SHELLS * min(PILOT, spec.cells))
        rays += float(samples * spec.rays)
        size += 4.0 * samples * spec.proxies * n * n * spec.sent / RATIO
    return rays, seconds, size


def library_store(field: Distinct, library: Path) -> Path:
    """Where a library keeps a field."""
    key = formats.fingerprint_json({"settings": field.settings, "inputs": field.inputs})
    return library / f"{key.partition(':')[2][:32]}.zarr"


def _from_library(
    field: Distinct, settings: FieldSettings, workers: int, quiet: bool, scheduler: str | None
) -> formats.Store:
    assert settings.library is not None
    path = library_store(field, settings.library)
    writer = formats.begin(
        path, KIND, settings=field.settings, inputs=field.inputs, program=f"relightcli {__version__}"
    )
    if writer is not None:
        with writer:
            alone = replace(field, spec=replace(field.spec, prefix=""))
            _put_body(writer, alone)
            simulate(writer, [alone.spec], workers, quiet, scheduler)
            writer.commit({})
    return formats.open_store(path, KIND)


def _put_body(writer: formats.Writer, field: Distinct) -> None:
    put_body(writer, field.spec.prefix, field.body, field.texture, field.radii, field.proxies)
