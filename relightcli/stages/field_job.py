"""The work on fields, block by block: self transfer, samples, and their compression.

What the first two make lies under `work/` of a field until the third has made of it what is kept (`field_store`).
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.brdf.models import MODEL_CODES
from relightcli.core.fields.body import Body
from relightcli.core.fields.build import Exits, field_samples, short
from relightcli.core.fields.compression import compress
from relightcli.core.fields.lobe_functions import FUNCTIONS, exits_by_function
from relightcli.core.fields.self_transfer import exits_of, solve
from relightcli.run import blocks as run
from relightcli.scene.model import Material
from relightcli.stages.bodies import body_of
from relightcli.stages.field_store import (
    CHUNK_BYTES,
    Packed,
    pack_per_shell,
    pack_transfer,
    put_packed,
    rounded,
)

WORK = "work"  # group of what only the work needs
OF_WHOLE = 0.5  # of the transfer's tolerance: the error of a glossy object's self transfer


@dataclass(frozen=True)
class FieldSpec:
    """One field to simulate: where it lies and how. `colours` and `points` are those of its body; by_function: what it
    sends is simulated for the functions of a lobe in the place of colours; tolerance of its self transfer,
    transfer_tolerance of the compression."""

    prefix: str
    material: Material
    two_sided: bool
    order: int
    shells: int
    resolution: int
    proxies: int
    colours: int
    by_function: bool
    points: int
    rays: int
    tolerance: float
    transfer_tolerance: float
    seed: int

    @property
    def cells(self) -> int:
        """Samples on a shell."""
        return 6 * self.resolution * self.resolution

    @property
    def sent(self) -> int:
        """Colours or functions of what it sends."""
        return 1 + FUNCTIONS if self.by_function else self.colours

    @property
    def block(self) -> int:
        """Samples in a block, which is a chunk: of one shell, about CHUNK_BYTES of transfer."""
        sample = 4 * self.proxies * self.order**4 * self.sent
        return max(1, min(self.cells, CHUNK_BYTES // sample))

    @property
    def block_prefix(self) -> str:
        """What its blocks are called in the ledger."""
        return self.prefix or "field/"

    @property
    def last_block(self) -> str:
        """The block after which nothing is left to do."""
        return f"{self.block_prefix}pack"


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
        formats.worker_array(self.job.partial, f"{spec.prefix}{WORK}/self")[...] = found.transfer
        formats.worker_array(self.job.partial, f"{spec.prefix}{WORK}/by_order")[...] = found.by_order
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
        self.opened: tuple[int, Body, Tracer, Exits, NDArray[np.float64]] | None = None

    def run(self, block: run.Block) -> run.Info:
        k = bisect.bisect_right(self.first, block.start) - 1
        spec = self.job.fields[k]
        if self.opened is None or self.opened[0] != k:
            self.opened = None
            body, tracer = open_body(self.job.partial, spec)
            transfer: Any = formats.worker_array(self.job.partial, f"{spec.prefix}{WORK}/self")[...]
            radii: Any = formats.worker_array(self.job.partial, f"{spec.prefix}radii")[:]
            proxies: Any = formats.worker_array(self.job.partial, f"{spec.prefix}proxies")[:]
            texture: Any = formats.worker_array(self.job.partial, f"{spec.prefix}mesh/texture")[...]
            self.opened = k, body, tracer, what_is_sent(spec, body, transfer, texture, proxies), radii
        _, body, tracer, exits, radii = self.opened
        start, stop = block.start - self.first[k], block.stop - self.first[k]
        found = field_samples(tracer, body, exits, radii, spec.resolution, start, stop, rays=spec.rays, seed=spec.seed)
        shell, cell = divmod(start, spec.cells)
        cells = slice(cell, cell + stop - start)
        for name, values in (
            ("valid", found.valid),
            (f"{WORK}/occlusion", found.occlusion),
            (f"{WORK}/transfer", found.transfer),
        ):
            formats.worker_array(self.job.partial, f"{spec.prefix}{name}")[shell, cells] = values
        return {"rays": float(found.rays)}


@dataclass(frozen=True)
class PackJob:
    """What is kept of a field, of which all samples are there: one block a field."""

    partial: str
    fields: tuple[FieldSpec, ...]

    def open(self) -> PackWorker:
        return PackWorker(self)


class PackWorker:
    def __init__(self, job: PackJob) -> None:
        self.job = job

    def run(self, block: run.Block) -> run.Info:
        """The arrays, as `packed`, are for the store's owner: only then is it known how large they are."""
        spec = self.job.fields[block.start]
        body, _ = open_body(self.job.partial, spec)

        def work(name: str) -> Any:
            return formats.worker_array(self.job.partial, f"{spec.prefix}{WORK}/{name}")

        made = compress(_Shells(work("transfer")), tolerance=spec.transfer_tolerance, seed=spec.seed)
        packed = pack_transfer("transfer/", made, spec.transfer_tolerance)
        # As what is hidden: beside the whole sphere, what a far object hides would be lost in rounding.
        hidden = -np.asarray(work("occlusion")[...], np.float64)
        hidden[:, :, 0] += np.sqrt(4.0 * np.pi)
        packed += pack_per_shell("hidden", hidden)
        packed += rounded("self", np.asarray(work("by_order")[...]), ("point", "harmonic", "part"))
        if body.terms > 1:
            own = np.asarray(work("self")[...])
            whole = own.sum(axis=1, dtype=np.float64, keepdims=True).astype(np.float32)
            tolerance = OF_WHOLE * spec.transfer_tolerance
            packed += pack_transfer("self_whole/", compress(whole, tolerance=tolerance, seed=spec.seed), tolerance)
        return {"packed": packed, "error": made.error}


class _Shells(Sequence[NDArray[np.float32]]):
    """The samples of one shell after the other."""

    def __init__(self, array: Any) -> None:
        self.array = array

    def __len__(self) -> int:
        return int(self.array.shape[0])

    def __getitem__(self, shell: Any) -> Any:
        if not 0 <= shell < len(self):
            raise IndexError(shell)
        return np.asarray(self.array[shell], np.float32)


class _PackLedger:
    """Puts what is packed into the store before its block counts as done."""

    def __init__(self, writer: formats.Writer, specs: list[FieldSpec]) -> None:
        self.writer = writer
        self.prefix = {spec.last_block: spec.prefix for spec in specs}

    @property
    def done(self) -> Set[str]:
        return self.writer.done

    def record(self, block_id: str, info: dict[str, Any]) -> None:
        packed: list[Packed] = info.pop("packed")
        put_packed(self.writer, self.prefix[block_id], packed)
        self.writer.record(block_id, info)


def open_body(partial: str, spec: FieldSpec) -> tuple[Body, Tracer]:
    """The body of an unfinished store's field, and rays over its mesh."""

    def read(name: str) -> Any:
        return formats.worker_array(partial, f"{spec.prefix}mesh/{name}")[...]

    body = body_of(
        read("position"), read("normal"), read("face"), spec.two_sided, read("texture"), spec.material, spec.order
    )
    return body, Tracer(body.positions, body.faces)


def what_is_sent(
    spec: FieldSpec,
    body: Body,
    transfer: NDArray[np.float32],
    texture: NDArray[np.float32],
    proxies: NDArray[np.float64],
) -> Exits:
    """Exit radiance of a field's body with this self transfer, in the form that its samples take; texture (V, 3)."""
    if spec.by_function:
        grey = texture[body.vertex].mean(axis=1)
        return exits_by_function(body, MODEL_CODES[spec.material.model], transfer, grey, proxies)
    return short(body, exits_of(body, transfer), proxies)


def make_room(writer: formats.Writer, spec: FieldSpec) -> None:
    """The arrays that the blocks of a field fill, unless they are all done."""
    shape, chunks, p, n = (spec.shells, spec.cells), (1, spec.block), spec.prefix, spec.order**2
    writer.array(f"{p}valid", shape=shape, dtype=bool, chunks=chunks, dims=("shell", "direction"))
    if spec.last_block in writer.done:
        return
    matrix = ("proxy", "harmonic", "light_harmonic", "reflected_colour")
    size = spec.proxies, n, n, spec.colours
    rows = max(1, CHUNK_BYTES // (4 * spec.proxies * n * n * spec.colours))
    for name, outer, outer_chunks, inner, dims in (
        ("self", (spec.points,), (rows,), size, ("point", *matrix)),
        ("by_order", (spec.points,), (rows,), (n, 1 + 2 * spec.colours), ("point", "harmonic", "part")),
        ("occlusion", shape, chunks, (n,), ("shell", "direction", "harmonic")),
        ("transfer", shape, chunks, (*size[:-1], spec.sent), ("shell", "direction", *matrix[:-1], "sent_colour")),
    ):
        writer.array(
            f"{p}{WORK}/{name}",
            shape=(*outer, *inner),
            dtype=np.float32,
            chunks=(*outer_chunks, *inner),
            dims=dims,
            codec="none",
        )


def simulate(
    writer: formats.Writer, specs: list[FieldSpec], workers: int, quiet: bool, scheduler: str | None = None
) -> None:
    """Every block of the fields that `put_body` has laid down and the ledger does not hold."""
    fields = tuple(specs)
    partial = str(writer.partial_path)
    for spec in specs:
        make_room(writer, spec)
    own = [run.Block(f"{s.block_prefix}self", k, k + 1) for k, s in enumerate(specs)]
    job = SelfJob(partial, fields)
    run.run_blocks(job, own, writer, workers=workers, label="self transfer", quiet=quiet, scheduler=scheduler)
    blocks, first = [], 0
    for spec in specs:
        for shell in range(spec.shells):
            for cell in range(0, spec.cells, spec.block):
                start = first + shell * spec.cells + cell
                stop = min(start + spec.block, first + (shell + 1) * spec.cells)
                blocks.append(run.Block(f"{spec.block_prefix}samples/{shell:03d}/{cell:06d}", start, stop))
        first += spec.shells * spec.cells
    samples = SampleJob(partial, fields)
    run.run_blocks(samples, blocks, writer, workers=workers, label="fields", quiet=quiet, scheduler=scheduler)
    run.close_worker()
    pack = [run.Block(spec.last_block, k, k + 1) for k, spec in enumerate(specs)]
    ledger = _PackLedger(writer, specs)
    run.run_blocks(
        PackJob(partial, fields), pack, ledger, workers=workers, label="compression", quiet=quiet, apart=True
    )
    for spec in specs:
        writer.drop(f"{spec.prefix}{WORK}")
