"""Fields in a store: what arrays there are, the work on one block of them, and reading them again.

A field lies under a prefix: `fields/0/` in a transfer store, none in a store of its own (kind `field`):

    mesh/position, normal, face, texture   the object in its own frame; its texture's mean colour around vertices
    point, normal, vertex, side            the points that light is known at (`core.fields.body`)
    radii, proxies                         see `core.fields.field.Field`
    self                                   self transfer of the points
    valid, occlusion, transfer             the samples
"""

from __future__ import annotations

import bisect
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.fields.body import Body
from relightcli.core.fields.build import field_samples
from relightcli.core.fields.field import Field, SelfTransfer, SourceField
from relightcli.core.fields.self_transfer import exits_of, solve
from relightcli.run import blocks as run
from relightcli.scene.model import Material
from relightcli.stages.bodies import body_of

CHUNK_BYTES = 4_000_000


@dataclass(frozen=True)
class FieldSpec:
    """One field to simulate: where it lies and how. `colours` and `points` are those of its body."""

    prefix: str
    material: Material
    two_sided: bool
    order: int
    shells: int
    resolution: int
    proxies: int
    colours: int
    points: int
    rays: int
    tolerance: float
    seed: int

    @property
    def cells(self) -> int:
        """Samples on a shell."""
        return 6 * self.resolution * self.resolution

    @property
    def block(self) -> int:
        """Samples in a block, which is a chunk: of one shell, about CHUNK_BYTES of transfer."""
        sample = 4 * self.proxies * self.order**4 * self.colours
        return max(1, min(self.cells, CHUNK_BYTES // sample))


@dataclass(frozen=True)
class SelfJob:
    """Self transfer: one block a field."""

    partial: str
    fields: tuple[FieldSpec, ...]

    def open(self) -> SelfWorker:
        return SelfWorker(self)


class SelfWorker:
    def __init__(self, job: SelfJob) -> None:
        self.job = job

    def run(self, block: run.Block) -> run.Info:
        spec = self.job.fields[block.start]
        body, tracer = open_body(self.job.partial, spec)
        proxies = formats.worker_array(self.job.partial, f"{spec.prefix}proxies")[:]
        found = solve(tracer, body, np.asarray(proxies), spec.tolerance, spec.seed)
        formats.worker_array(self.job.partial, f"{spec.prefix}self")[...] = found.transfer
        return {"rays": float(found.rays), "noise": found.noise, "reflections": float(found.rounds)}


@dataclass(frozen=True)
class SampleJob:
    """Samples of fields, whose self transfer is there. Blocks count samples through all fields."""

    partial: str
    fields: tuple[FieldSpec, ...]

    def open(self) -> SampleWorker:
        return SampleWorker(self)


class SampleWorker:
    def __init__(self, job: SampleJob) -> None:
        self.job = job
        self.first = [0]
        for spec in job.fields:
            self.first.append(self.first[-1] + spec.shells * spec.cells)
        self.opened: tuple[int, Body, Tracer, NDArray[np.float32], NDArray[np.float64]] | None = None

    def run(self, block: run.Block) -> run.Info:
        k = bisect.bisect_right(self.first, block.start) - 1
        spec = self.job.fields[k]
        if self.opened is None or self.opened[0] != k:
            self.opened = None
            body, tracer = open_body(self.job.partial, spec)
            transfer: Any = formats.worker_array(self.job.partial, f"{spec.prefix}self")[...]
            radii: Any = formats.worker_array(self.job.partial, f"{spec.prefix}radii")[:]
            self.opened = k, body, tracer, exits_of(body, transfer), radii
        _, body, tracer, exits, radii = self.opened
        start, stop = block.start - self.first[k], block.stop - self.first[k]
        found = field_samples(tracer, body, exits, radii, spec.resolution, start, stop, rays=spec.rays, seed=spec.seed)
        shell, cell = divmod(start, spec.cells)
        cells = slice(cell, cell + stop - start)
        for name, values in (("valid", found.valid), ("occlusion", found.occlusion), ("transfer", found.transfer)):
            formats.worker_array(self.job.partial, f"{spec.prefix}{name}")[shell, cells] = values
        return {"rays": float(found.rays)}


def open_body(partial: str, spec: FieldSpec) -> tuple[Body, Tracer]:
    """The body of an unfinished store's field, and rays over its mesh."""

    def read(name: str) -> Any:
        return formats.worker_array(partial, f"{spec.prefix}mesh/{name}")[...]

    body = body_of(
        read("position"), read("normal"), read("face"), spec.two_sided, read("texture"), spec.material, spec.order
    )
    return body, Tracer(body.positions, body.faces)


def put_body(
    writer: formats.Writer,
    spec: FieldSpec,
    body: Body,
    texture: NDArray[np.float32],
    radii: NDArray[np.float64],
    proxies: NDArray[np.float64],
) -> None:
    """The mesh and what is known before any ray; and the arrays that the blocks fill. texture (V, 3)."""
    p, n = spec.prefix, spec.order**2
    writer.put(f"{p}mesh/position", body.positions, dims=("vertex", "axis"))
    writer.put(f"{p}mesh/normal", body.normals, dims=("vertex", "axis"))
    writer.put(f"{p}mesh/face", body.faces, dims=("face", "corner"))
    writer.put(f"{p}mesh/texture", texture, dims=("vertex", "colour"))
    writer.put(f"{p}point", body.point, dims=("point", "axis"))
    writer.put(f"{p}normal", body.normal, dims=("point", "axis"))
    writer.put(f"{p}vertex", body.vertex, dims=("point",))
    writer.put(f"{p}side", body.side, dims=("point",))
    writer.put(f"{p}radii", radii, dims=("shell",))
    writer.put(f"{p}proxies", proxies, dims=("proxy", "axis"))
    m, c = spec.proxies, spec.colours
    matrix = ("proxy", "harmonic", "light_harmonic", "reflected_colour")
    rows = max(1, CHUNK_BYTES // (4 * m * n * n * c))
    writer.array(
        f"{p}self",
        shape=(spec.points, m, n, n, c),
        dtype=np.float32,
        chunks=(rows, m, n, n, c),
        dims=("point", *matrix),
        attrs={"description": "light that a point receives per light at a proxy"},
    )
    shape, chunks = (spec.shells, spec.cells), (1, spec.block)
    writer.array(f"{p}valid", shape=shape, dtype=bool, chunks=chunks, dims=("shell", "direction"))
    writer.array(
        f"{p}occlusion",
        shape=(*shape, n),
        dtype=np.float32,
        chunks=(*chunks, n),
        dims=("shell", "direction", "harmonic"),
        attrs={"description": "what passes the object"},
    )
    writer.array(
        f"{p}transfer",
        shape=(*shape, m, n, n, c),
        dtype=np.float32,
        chunks=(*chunks, m, n, n, c),
        dims=("shell", "direction", *matrix),
        attrs={"description": "radiance of the object per light at a proxy"},
    )


def simulate(
    writer: formats.Writer, specs: list[FieldSpec], workers: int, quiet: bool, scheduler: str | None = None
) -> None:
    """Every block of the fields that `put_body` has laid down and the ledger does not hold."""
    fields = tuple(specs)
    partial = str(writer.partial_path)
    own = [run.Block(f"{s.prefix or 'field/'}self", k, k + 1) for k, s in enumerate(specs)]
    job = SelfJob(partial, fields)
    run.run_blocks(job, own, writer, workers=workers, label="self transfer", quiet=quiet, scheduler=scheduler)
    blocks, first = [], 0
    for spec in specs:
        for shell in range(spec.shells):
            for cell in range(0, spec.cells, spec.block):
                start = first + shell * spec.cells + cell
                stop = min(start + spec.block, first + (shell + 1) * spec.cells)
                blocks.append(run.Block(f"{spec.prefix or 'field/'}samples/{shell:03d}/{cell:06d}", start, stop))
        first += spec.shells * spec.cells
    samples = SampleJob(partial, fields)
    run.run_blocks(samples, blocks, writer, workers=workers, label="fields", quiet=quiet, scheduler=scheduler)
    run.close_worker()


def copy_field(store: formats.Store, writer: formats.Writer, prefix: str) -> None:
    """All arrays of a finished `field` store, under a prefix."""
    for name in store.names():
        layout = store.layouts[name]
        source = store.array(name)
        attrs = {k: v for k, v in source.attrs.items() if k == "description"}
        target = writer.array(
            f"{prefix}{name}",
            shape=layout.shape,
            dtype=layout.data_type,
            chunks=layout.chunks,
            dims=layout.dims,
            attrs=attrs or None,
        )
        for start in range(0, layout.shape[0], layout.chunks[0]):
            rows = slice(start, start + layout.chunks[0])
            target[rows] = source[rows]


def read_field(store: formats.Store, prefix: str = "") -> tuple[Field, SelfTransfer]:
    """The field under a prefix of a finished store."""
    read: Any = store.read
    radii, valid = read(f"{prefix}radii"), read(f"{prefix}valid")
    position, face = read(f"{prefix}mesh/position"), read(f"{prefix}mesh/face")
    corners = position[np.unique(face)]
    center = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    radius = float(np.sqrt(((corners - center) ** 2).sum(axis=1).max()))
    field = Field(
        center,
        radius,
        radii,
        round((valid.shape[1] / 6) ** 0.5),
        valid,
        read(f"{prefix}proxies"),
        read(f"{prefix}occlusion"),
        read(f"{prefix}transfer"),
    )
    return field, SelfTransfer(read(f"{prefix}self"))


def put_source(writer: formats.Writer, prefix: str, field: SourceField) -> None:
    """The field of a local light."""
    writer.put(f"{prefix}radii", field.radii, dims=("shell",), units="m")
    writer.put(f"{prefix}radius", np.array(field.radius), dims=(), units="m")
    writer.put(f"{prefix}radiance", field.radiance, dims=("shell", "direction", "harmonic", "colour"))


def read_source(store: formats.Store, prefix: str) -> SourceField:
    """The field of a local light, about its centre, with the scene's axes."""
    read: Any = store.read
    radiance = read(f"{prefix}radiance")
    resolution = round((radiance.shape[1] / 6) ** 0.5)
    return SourceField(np.zeros(3), float(read(f"{prefix}radius")), read(f"{prefix}radii"), resolution, radiance)
