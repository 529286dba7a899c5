"""The work of clustering light: cells of the sky judged by transfer vectors, and the fractions of those that pass."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.brdf.models import SPECULAR, MaterialTable
from relightcli.core.lights import quadtree
from relightcli.core.lights.latlong import LUMINANCE
from relightcli.core.lights.quadtree import Cell
from relightcli.core.shade.cluster_sum import GROUP
from relightcli.core.sphere import cube
from relightcli.core.transport import light_clusters as measure
from relightcli.core.transport.light_vectors import LightVectors
from relightcli.run.accounting import Meter
from relightcli.run.blocks import Block, Info

JUDGED = 8_192  # receivers with lobes that a cell is judged by, about
KEPT = 2_048  # transfer vectors that a process keeps for the neighbours of a cell
CHECKS = 256  # random lights at which the clusters are compared with rays
PART = {"all": 1.0, "diffuse": 0.45, "lobes": 1.2}  # of epsilon: parts of the light have cells of their own
FINEST_STEP = 0.5  # of a lobe's transfer, in parts of epsilon: its rounding, even over a step, is 0.14 epsilon
DIFFUSE, LOBE = "diffuse_cell", "lobe_cell"  # cells with fractions, and with lobes: each a run of clusters
SCRATCH = "bits.partial"  # visibility by texel, while the store is written


def as_cell(values: list[int]) -> Cell:
    """A cell out of a ledger or an array."""
    face, r0, r1, c0, c1 = (int(v) for v in values)
    return face, r0, r1, c0, c1


@dataclass(frozen=True)
class ClusterJob:
    """Refines cells, or fills the fractions of leaves that are known. `cells`: one for each block to refine.

    part: what a cell has to be good enough for: all its light, or diffuse light or that of lobes alone.
    """

    partial: str
    resolution: int
    epsilon: float
    criterion: str
    shadows: bool
    lobes: bool
    cells: tuple[Cell, ...] = ()
    part: str = "all"

    def open(self) -> ClusterWorker:
        return ClusterWorker(self)


class ClusterWorker:
    """Transfer vectors of the lights that cells are judged by, some of them kept for the neighbours."""

    def __init__(self, job: ClusterJob) -> None:
        self.job = job

        def read(name: str) -> Any:
            return formats.worker_array(job.partial, name)[:]

        base = np.load(Path(job.partial) / SCRATCH, mmap_mode="r")
        self.base: NDArray[np.uint64] = base
        self.normal = np.ascontiguousarray(read("receivers/normal"), np.float32)
        tracer = Tracer(read("mesh/position"), read("mesh/face")) if job.shadows else None
        self.vectors = LightVectors(base, read("receivers/position"), self.normal, tracer)
        self.side = self.vectors.resolution
        self.centre = cube.texel_directions(self.side)
        self.area: NDArray[np.float64] = read("light_clusters/area")
        self.reflectance: NDArray[np.float64] = read("light_clusters/reflectance")
        self.kept: dict[int, NDArray[np.uint64]] = {}
        self.lobes = _Lobes(self, read) if job.lobes else None

    def run(self, block: Block) -> Info:
        rays = self.vectors.rays
        if self.job.cells:
            info: Info = {"leaves": self.refine(self.job.cells[block.start])}
        else:
            info = self.fill_lobes(block) if block.id.startswith("lobe/") else self.fill(block)
        return {**info, "rays": float(self.vectors.rays - rays)}

    def refine(self, cell: Cell) -> list[Cell]:
        """Leaves of a cell's tree."""
        leaves, stack = [], [cell]
        while stack:
            cell = stack.pop()
            if self.accepts(cell):
                leaves.append(cell)
            else:
                stack += quadtree.children(cell)[::-1]
        return leaves

    def accepts(self, cell: Cell) -> bool:
        """Whether the cell is one cluster: all its samples are within epsilon, a single light always."""
        return quadtree.lights(cell) == 1 or self.worst(cell) < PART[self.job.part] * self.job.epsilon

    def worst(self, cell: Cell) -> float:
        """Largest error of a cell's samples: of the nine, and where those are good enough, of all that are known."""
        if quadtree.lights(cell) == 1:
            return 0.0
        worst = float(self.errors(cell, *self.nine(cell)).max())
        if self.job.criterion == "rms" and worst < self.job.epsilon:
            worst = max(worst, float(self.errors(cell, *self.known(cell)).max()))
        return worst

    def nine(self, cell: Cell) -> tuple[NDArray[np.uint64], NDArray[np.float64]]:
        """Visible bits (S, W) and directions (S, 3) of the cell's up to nine samples."""
        texels, directions = quadtree.samples(cell, self.job.resolution)
        names = texels.tolist()
        missing = [k for k, name in enumerate(names) if name not in self.kept]
        if missing:
            for k, row in zip(missing, self.vectors.visible(directions[missing]), strict=True):
                self.kept[names[k]] = row
        rows = np.stack([self.kept[name] for name in names])
        while len(self.kept) > KEPT:
            del self.kept[next(iter(self.kept))]
        return rows, directions

    def known(self, cell: Cell) -> tuple[NDArray[np.uint64], NDArray[np.float64]]:
        """The nine samples, and all texels of the transfer store that lie in the cell: what the nine have missed."""
        visible, directions = self.nine(cell)
        face, *borders = cell
        r0, r1, c0, c1 = (math.ceil(b * self.side / self.job.resolution - 0.5) for b in borders)
        if (r1 - r0) * (c1 - c0) <= 1:
            return visible, directions
        inside = self.base.reshape(6, self.side, self.side, -1)[face, r0:r1, c0:c1]
        return (
            np.concatenate([visible, inside.reshape(-1, visible.shape[1])]),
            np.concatenate([directions, self.centre[face, r0:r1, c0:c1].reshape(-1, 3)]),
        )

    def errors(self, cell: Cell, visible: NDArray[np.uint64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Error of every sample by the job's criterion."""
        if self.job.criterion == "paper":
            return measure.paper_errors(visible, directions, self.normal, self.reflectance)
        return self.rms(cell, visible, directions, self.job.part)

    def rms(
        self, cell: Cell, visible: NDArray[np.uint64], directions: NDArray[np.float64], part: str
    ) -> NDArray[np.float64]:
        """Error of every sample, and of even light, by area-weighted RMS."""
        radius = self.radius(cell)
        if self.lobes is not None:
            return self.lobes.errors(visible, directions, radius, part)
        return np.sqrt(measure.visibility_errors(visible, directions, radius, self.normal, self.area))

    def radius(self, cell: Cell) -> float:
        """Half the side of a cell."""
        return 0.5 * math.sqrt(float(quadtree.solid_angles(np.array([cell]), self.job.resolution)[0]))

    def fill(self, block: Block) -> Info:
        """Writes the fractions and errors of a range of the cells that have them."""
        rows, cells = self.cells_of(block, DIFFUSE)
        fraction = np.zeros((len(cells), len(self.normal)), np.uint8)
        error, paper = np.zeros(len(cells), np.float32), np.zeros(len(cells), np.float32)
        part = "all" if self.lobes is None else "diffuse"
        for k, cell in enumerate(cells):
            visible, directions = self.taken(cell)
            fraction[k] = measure.fractions(visible, directions, self.radius(cell), self.normal)
            error[k] = self.rms(cell, visible, directions, part).max()
            paper[k] = measure.paper_errors(*self.nine(cell), self.normal, self.reflectance).max()
        self.out("fraction")[rows] = fraction
        self.out("error")[rows] = error
        self.out("paper_error")[rows] = paper
        return {"clusters": len(cells)}

    def fill_lobes(self, block: Block) -> Info:
        """Writes the lobes and errors of a range of the cells that have them."""
        assert self.lobes is not None
        rows, cells = self.cells_of(block, LOBE)
        error, lobes, scales = np.zeros(len(cells), np.float32), [], []
        for k, cell in enumerate(cells):
            visible, directions = self.taken(cell)
            lobe, scale = self.lobes.mean(visible, directions)
            lobes.append(lobe)
            scales.append(scale)
            error[k] = self.rms(cell, visible, directions, "lobes").max()
        self.out("lobe")[rows] = np.stack(lobes)
        self.out("lobe_scale")[rows] = np.stack(scales)
        self.out("lobe_error")[rows] = error
        return {"clusters": len(cells)}

    def taken(self, cell: Cell) -> tuple[NDArray[np.uint64], NDArray[np.float64]]:
        """The samples that a cluster is made from."""
        return self.nine(cell) if self.job.criterion == "paper" else self.known(cell)

    def cells_of(self, block: Block, name: str) -> tuple[slice, list[Cell]]:
        rows = slice(block.start, block.stop)
        return rows, [as_cell(c) for c in self.out(name)[rows]]

    def out(self, name: str) -> Any:
        return formats.worker_array(self.job.partial, f"light_clusters/{name}")

    def check(self, leaves: list[Cell], seed: int) -> Info:
        """RMS error at lights that the clusters were not made from, uniform over the sphere."""
        meter, rays = Meter(), self.vectors.rays
        d = np.random.default_rng(seed).normal(size=(CHECKS, 3))
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        leaf = quadtree.leaves_at(quadtree.build_tree(leaves, self.job.resolution), d)
        visible = self.vectors.visible(d)
        array = self.out("fraction")
        square, worst = 0.0, 0.0
        step = array.chunks[0]
        for start in np.unique(leaf // step) * step:
            block = np.asarray(array[int(start) : int(start) + step])
            for k in np.flatnonzero((leaf >= start) & (leaf < start + step)):
                seen = np.unpackbits(visible[k].view(np.uint8), bitorder="little")[: len(self.normal)]
                height = self.normal @ d[k]
                r = self.radius(leaves[leaf[k]])
                whole = np.where(height >= r, height, np.maximum(height + r, 0.0) ** 2 / (4.0 * r))
                error = block[leaf[k] - start] / 255.0 * whole - seen * np.maximum(height, 0.0)
                here = float(self.area @ error**2)
                square, worst = square + here / CHECKS, max(worst, here)
        return {
            **meter.read(),
            "rays": float(self.vectors.rays - rays),
            "error": math.sqrt(square),
            "worst": math.sqrt(worst),
        }


class _Lobes:
    """The specular part of a worker's transfer vectors, under a fixed view."""

    def __init__(self, worker: ClusterWorker, read: Any) -> None:
        self.worker = worker
        self.view = np.ascontiguousarray(read("light_clusters/view"), np.float32)
        self.rows = read("light_clusters/lobed").astype(np.int64)
        self.material: NDArray[np.int32] = read("light_clusters/material")
        # Cells are judged by some receivers, evenly taken from neighbours in space, that stand for all with a lobe.
        self.judged = self.rows[:: max(1, len(self.rows) // JUDGED)]
        self.table = MaterialTable(read("light_clusters/model"), read("light_clusters/parameters"))
        colour = self.table.parameters[:, SPECULAR : SPECULAR + 3] @ LUMINANCE
        specular = colour[self.material]
        # The reference: what Lambert's law has at normal incidence, sqrt(3 mean over the upper hemisphere of T^2).
        directions = cube.texel_directions(8).reshape(-1, 3)
        every = np.full((len(directions), worker.base.shape[1]), ~np.uint64(0))
        lobe = np.zeros((len(directions), len(worker.normal)))
        lobe[:, self.judged] = self.transfer(every, directions, self.judged)
        whole = worker.reflectance * np.maximum(directions @ worker.normal.T, 0.0) + specular * lobe
        area = worker.area.copy()
        area[self.rows] = 0.0
        area[self.judged] = worker.area[self.judged] * (
            worker.area[self.rows].sum() / max(float(worker.area[self.judged].sum()), 1e-300)
        )
        self.area = area
        solid = np.tile(cube.solid_angles(8).reshape(-1), 6)
        square = float(solid @ (whole**2 @ area)) / (2.0 * np.pi)
        self.reference = math.sqrt(3.0 * square) if square > 0.0 else 1.0
        self.diffuse = worker.reflectance / self.reference
        self.specular = specular / self.reference
        groups = -(-len(self.rows) // GROUP)
        brightest = np.zeros(groups * GROUP)
        brightest[: len(self.rows)] = self.specular[self.rows]
        brightest = brightest.reshape(groups, GROUP).max(axis=1)
        # No step is finer than what the error of a cluster makes of it.
        self.step = np.divide(
            FINEST_STEP * worker.job.epsilon, brightest, where=brightest > 0.0, out=np.zeros(groups)
        ).astype(np.float32)
        matte = worker.area * self.diffuse**2
        matte[self.rows] = 0.0
        self.matte = matte

    def transfer(
        self, visible: NDArray[np.uint64], directions: NDArray[np.float64], rows: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Of some receivers, (S, n)."""
        w = self.worker
        return measure.lobe_transfer(visible, directions, w.normal, self.view, rows, self.material, self.table)

    def errors(
        self, visible: NDArray[np.uint64], directions: NDArray[np.float64], radius: float, part: str
    ) -> NDArray[np.float64]:
        """Error of every sample, of all light or of a part of it."""
        w = self.worker
        if part == "diffuse":
            every = w.area * self.diffuse**2
            return np.sqrt(measure.visibility_errors(visible, directions, radius, w.normal, every))
        diffuse, square = self.diffuse, np.zeros(len(visible) + 1)
        if part == "lobes":
            diffuse = np.zeros_like(diffuse)
        else:
            square = measure.visibility_errors(visible, directions, radius, w.normal, self.matte)
        given = measure.add_glossy_errors(
            square,
            visible,
            directions,
            radius,
            w.normal,
            self.judged,
            self.transfer(visible, directions, self.judged),
            diffuse,
            self.specular,
            self.area,
        )
        return np.sqrt(square / np.maximum(given, 1.0))

    def mean(
        self, visible: NDArray[np.uint64], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Mean transfer (n,) in steps of the scales (G,) of groups of 64."""
        mean = self.transfer(visible, directions, self.rows).mean(axis=0)
        groups = -(-len(mean) // GROUP)
        padded = np.zeros(groups * GROUP, np.float32)
        padded[: len(mean)] = mean
        scale = np.maximum(padded.reshape(groups, GROUP).max(axis=1) / np.float32(255.0), self.step)
        steps = np.divide(
            padded.reshape(groups, GROUP),
            scale[:, None],
            where=scale[:, None] > 0,
            out=np.zeros((groups, GROUP), np.float32),
        )
        return np.rint(steps).astype(np.uint8).reshape(-1)[: len(mean)], scale
