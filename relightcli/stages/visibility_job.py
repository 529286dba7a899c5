"""The work of precompute on one block of receivers: their visibility, what blocks it, its projection on a basis."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.sphere import cube, haar, sh
from relightcli.core.transport import visibility
from relightcli.core.transport.hits import Surfaces, trace_hits
from relightcli.core.transport.light_visibility import POINTS_PER_LIGHT, light_bits
from relightcli.core.transport.local_lights import pack_lights
from relightcli.core.transport.receivers import receivers_of_vertices
from relightcli.run import blocks as run
from relightcli.run.accounting import Meter
from relightcli.scene.model import RectangleLight, SphereLight
from relightcli.stages.receiver_setup import hidden

CHUNK_BYTES = 4_000_000


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
    bounce_cells: int  # cells along a side of the cube of what is seen; 0: no interreflections
    pixels: int = 0  # receivers before the first that is on a vertex
    movers: tuple[int, ...] = ()  # objects that move: each is alone, and the others are together
    entities: tuple[int, ...] = (0,)  # the first receiver of the others, then of every mover
    posed: tuple[int, ...] = ()  # objects that only their own receivers see, in the pose in which they stand

    def open(self) -> VisibilityWorker:
        return VisibilityWorker(self)


class VisibilityWorker:
    def __init__(self, job: VisibilityJob) -> None:
        self.job = job

        def array(name: str) -> Any:
            return formats.worker_array(job.partial, name)

        self.array = array
        self.position, self.normal = array("receivers/position"), array("receivers/normal")
        self.object = array("receivers/object") if job.posed else None
        self.opened: _Open | None = None
        self.out = {name: array(name) for name in _outputs(job)}
        self.lights = pack_lights(job.lights)
        self.directions = cube.texel_directions(job.resolution).reshape(-1, 3).astype(np.float32)
        self.solid_angle = cube.solid_angles(job.resolution).reshape(-1).astype(np.float32)

    def run(self, block: run.Block) -> run.Info:
        job, rows = self.job, slice(block.start, block.stop)
        position, normal = self.position[rows], self.normal[rows]
        info: run.Info = {"rays": 0.0, "checked": 0.0, "wrong": 0.0, "inferred": 0.0, "bits": 0.0}
        info |= {f"{part}_{key}": 0.0 for part in _costs(job) for key in ("rays", "seconds", "cpu_seconds")}
        pieces = []
        for entity, first, end in self._parts(block.start, block.stop):
            part = slice(first - block.start, end - block.start)
            seen = self._open(entity)
            own = np.zeros(0, bool)
            if self.object is not None:
                own = np.isin(self.object[first:end], job.posed)
            if not own.any():
                pieces.append(self._see(seen.still, seen.surfaces, first, position[part], normal[part], info))
                continue
            found = [
                (some, self._see(tracer, seen.surfaces, first, position[part][some], normal[part][some], info))
                for tracer, some in ((seen.still, ~own), (seen.tracer, own))
                if some.any()
            ]
            pieces.append(_joined(found))
        for name in pieces[0]:
            self.out[name][rows] = np.concatenate([piece[name] for piece in pieces])
        bits = np.concatenate([piece["visibility/bits"] for piece in pieces])
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

    def _parts(self, start: int, stop: int) -> list[tuple[int, int, int]]:
        """(entity, first, past the last receiver) of a block's parts; pixels and vertices apart, as if alone."""
        cuts = sorted({*self.job.entities, self.job.pixels})
        ends = [start, *(c for c in cuts if start < c < stop), stop]
        return [(bisect_right(self.job.entities, a) - 1, a, b) for a, b in pairwise(ends)]

    def _open(self, entity: int) -> _Open:
        """Rays over what an entity's receivers can see, and who receives there."""
        if self.opened is None or self.opened.entity != entity:
            self.opened = None
            array, job = self.array, self.job
            owner = array("mesh/face_object")[:]
            own = owner == job.movers[entity - 1] if entity else ~np.isin(owner, job.movers)
            tracer = still = None
            if job.shadows:
                mesh, faces = array("mesh/position")[:], array("mesh/face")[:][own]
                tracer = still = Tracer(mesh, faces)
                if job.posed:
                    still = Tracer(mesh, hidden(faces, owner[own], job.posed))
            self.opened = _Open(entity, tracer, still, _surfaces(array, own) if job.bounce_cells else None)
        return self.opened

    def _see(
        self,
        tracer: Tracer | None,
        surfaces: Surfaces | None,
        first: int,
        position: NDArray[np.float64],
        normal: NDArray[np.float32],
        info: dict[str, float],
    ) -> dict[str, NDArray[Any]]:
        """What receivers of the part from `first` on see of sky, lights and surfaces, by array."""
        job = self.job
        meter, rays = Meter(), 0
        if tracer is None:
            bits = visibility.horizon_bits(normal, job.resolution)
        else:
            traced = visibility.trace_visibility(tracer, position, normal, job.resolution, job.refine, job.seed + first)
            bits = traced.bits
            rays = traced.rays
            info["checked"] += float(traced.checked)
            info["wrong"] += float(traced.wrong)
            info["inferred"] += float(traced.inferred)
            info["bits"] += float(3 * job.resolution**2 * len(bits))
        _add(info, "trace", meter, rays)
        out: dict[str, NDArray[Any]] = {"visibility/bits": bits}
        if self.lights.number:
            meter = Meter()
            out["lights/bits"], rays = light_bits(tracer, self.lights, position, normal)
            _add(info, "light", meter, rays)
        if surfaces is not None and tracer is not None:
            meter = Meter()
            hits = trace_hits(tracer, surfaces, position, normal, bits, job.bounce_cells, first, job.seed)
            out["bounce/hit"], rays = hits
            _add(info, "bounce", meter, rays)
        return out


def _costs(job: VisibilityJob) -> list[str]:
    """What a block's costs are kept apart by: visibility, local lights, interreflections."""
    return ["trace", *(["light"] if job.lights else []), *(["bounce"] if job.bounce_cells else [])]


def _add(info: dict[str, float], part: str, meter: Meter, rays: int) -> None:
    """Adds to a block's costs those of one part; `rays` are of all parts."""
    found = meter.read()
    info["rays"] += float(rays)
    info[f"{part}_rays"] += float(rays)
    info[f"{part}_seconds"] += found["seconds"]
    info[f"{part}_cpu_seconds"] += found["cpu_seconds"]


@dataclass(frozen=True)
class _Open:
    """Rays over an entity; `still` over it without what is posed, for the receivers of other objects."""

    entity: int
    tracer: Tracer | None
    still: Tracer | None
    surfaces: Surfaces | None


def _joined(parts: list[tuple[NDArray[np.bool_], dict[str, NDArray[Any]]]]) -> dict[str, NDArray[Any]]:
    """One array of each name, its rows put together from parts."""
    out = {}
    for name, values in parts[0][1].items():
        out[name] = np.empty((len(parts[0][0]), *values.shape[1:]), values.dtype)
        for some, found in parts:
            out[name][some] = found[name]
    return out


def _surfaces(array: Any, own: NDArray[np.bool_]) -> Surfaces:
    """Mesh and receivers of the unfinished store, as `trace_hits` wants them; `array` opens one by name. own (F,): the
    faces that are traced."""
    position = array("mesh/position")[:]
    front, back = receivers_of_vertices(array("receivers/vertex")[:], array("receivers/side")[:], len(position))
    two_sided = array("objects/two_sided")[:][array("mesh/face_object")[:][own]]
    buried = array("receivers/buried")[:]
    return Surfaces(position, array("mesh/normal")[:], array("mesh/face")[:][own], two_sided, front, back, buried)


def _dense(
    bits: NDArray[np.uint8],
    normal: NDArray[np.float32],
    directions: NDArray[np.float32],
    solid_angle: NDArray[np.float32],
) -> NDArray[np.float32]:
    seen = np.unpackbits(bits.reshape(len(bits), -1), axis=1, bitorder="little")
    weights = np.tile(solid_angle, 6) / np.float32(np.pi)
    # Spelled out: the bytes of a matrix product depend on the library's threads.
    height = sum(normal[:, x, None] * directions[:, x] for x in range(3))
    out: NDArray[np.float32] = np.maximum(height, 0.0) * weights * seen
    return out


def _outputs(job: VisibilityJob) -> list[str]:
    more = {"visibility": [], "sh": ["direct/sh"], "dense": ["direct/dense"]}
    more["haar"] = ["direct/haar_index", "direct/haar_value"]
    lights = ["lights/bits"] if job.lights else []
    bounce = ["bounce/hit"] if job.bounce_cells else []
    return ["visibility/bits", *more[job.basis], *lights, *bounce]


def block_size(resolution: int) -> int:
    """Receivers per block: a power of two whose visibility bits fill about one chunk."""
    per_receiver = 6 * resolution * resolution // 8
    size = 64
    while size * 2 * per_receiver <= CHUNK_BYTES:
        size *= 2
    return min(size, 4096)


def create_outputs(writer: formats.Writer, job: VisibilityJob, count: int, size: int) -> None:
    """The arrays that the job's blocks fill, `count` receivers long, a chunk per block of `size` (of `direct/dense`
    several)."""
    resolution = job.resolution
    if job.lights:
        n = len(job.lights) * POINTS_PER_LIGHT // 8
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
    if job.bounce_cells:
        c = job.bounce_cells
        writer.array(
            "bounce/hit",
            shape=(count, 6, c, c),
            dtype=np.int32,
            chunks=(size, 6, c, c),
            dims=("receiver", "cube_face", "cell_row", "cell_column"),
            attrs={"description": "1 + the receiver seen through the blocked part of the cell; 0: nothing that shines"},
            codec="zstd_shuffled",
        )
    if job.basis == "sh":
        n = job.sh_order**2
        writer.array("direct/sh", shape=(count, n), dtype=np.float32, chunks=(size, n), dims=("receiver", "harmonic"))
    elif job.basis == "haar":
        n = job.coefficients
        for name, dtype in (("haar_index", np.int32), ("haar_value", np.float32)):
            writer.array(
                f"direct/{name}", shape=(count, n), dtype=dtype, chunks=(size, n), dims=("receiver", "coefficient")
            )
    elif job.basis == "dense":
        n = 6 * resolution * resolution
        rows = max(1, CHUNK_BYTES // (4 * n))
        while size % rows:
            rows -= 1
        writer.array("direct/dense", shape=(count, n), dtype=np.float32, chunks=(rows, n), dims=("receiver", "texel"))
