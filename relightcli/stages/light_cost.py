"""What clustering light will take, predicted by its dry run from some receivers and some branches of the trees.

Trees are grown for a few thousand receivers (`light_growth`). Clusters are made of some of their leaves, for runs of
neighbours, as they compress alike.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.lights import quadtree
from relightcli.core.transport.light_vectors import LightVectors, transpose_bits
from relightcli.run.blocks import Block
from relightcli.stages.light_cluster_job import (
    CHECKS,
    DIFFUSE,
    JUDGED,
    LOBE,
    SCRATCH,
    ClusterJob,
    ClusterWorker,
    as_cell,
)
from relightcli.stages.light_growth import Grown, extended, grow, mixed, sample, spend
from relightcli.stages.lighting import LightingStore
from relightcli.stages.part_cost import Costs, copying, scratch, stored_bytes

FEW, SOME = 512, 4096  # receivers that cells are judged by
RUN, RUNS = 64, 48  # neighbours, and how many runs of them: receivers that clusters are made for
MEMORY = 64 << 20  # bytes of bits of such receivers
CHECKED = 16  # lights of the check
KINDS = ("light_clusters/fraction", "light_clusters/lobe")


@dataclass(frozen=True)
class Work:
    """What there is to be done.

    parts: of the light that get trees of their own, of PART; level: at which cells are refined in blocks of their own;
    lights, seconds: what may be spent, None where all cells have to be good enough; batch: clusters of a block; checks:
    how often lights are taken that no cluster was made from; put_receivers: writes what cells are judged by;
    make_outputs: creates the arrays of clusters, of so many cells by part, receivers, and receivers with lobes.
    """

    job: ClusterJob
    parts: tuple[str, ...]
    level: int
    lights: int | None
    seconds: float | None
    batch: int
    checks: int
    workers: int
    put_receivers: Callable[[formats.Writer], None]
    make_outputs: Callable[[formats.Writer, list[int], int, int], None]


def predict_lights(lighting: LightingStore, copied: list[str], work: Work) -> tuple[Costs, int]:
    """Costs of clustering the lights, but for opening the store, and how many clusters there will be. copied: arrays
    that are taken over."""
    store, n, out = lighting.store, len(lighting), Costs()
    if not n:
        return out, 6
    few, some, runs = _chosen(n, lighting.resolution)
    with ExitStack() as stack:
        whole = stack.enter_context(scratch("light_clusters", store.settings, {}))
        out.add(copying(store, copied, whole))
        with out.timed():
            work.put_receivers(whole)
        out.bytes += sum(stored_bytes(whole, group) for group in ("light_clusters", "light_factors"))
        once = Costs()
        with once.timed():
            tracer = Tracer(lighting.geometry.positions, lighting.geometry.faces) if work.job.shadows else None
        rows = np.unique(np.concatenate([few, some, runs]))
        with out.timed():
            bits = lighting.bits_of(rows)
        thin = [
            _Thin(stack, lighting, own, bits[np.searchsorted(rows, own)], whole, tracer, work)
            for own in (few, some, runs)
        ]
        out.add(thin[1].turned, n / len(some))
        start = Costs()
        with start.timed():  # kernels are loaded
            for part in work.parts:
                thin[0].worker(part).worst(quadtree.roots(work.job.resolution)[0])
        once.add(thin[1].opened, n / len(some) if work.job.lobes else 1.0)
        trees = [grow(thin[0].worker(part), thin[1].worker(part), n, thin[1].like(n, part)) for part in work.parts]
        grown = [spend(tree, work.job.resolution, work.lights, work.seconds) for tree in trees]
        blocks = []
        for tree in grown:
            cells = sum(node.weight for node in tree.judged if len(node.path) == work.level + 1)
            serial = Costs()
            for node in tree.judged:
                serial.add(node.costs, node.weight)
            blocks.append((serial, round(cells) if work.lights is None and work.seconds is None else 1))
        filled, size = _fill(thin[2], thin[0], grown, n, work)
        blocks.append((filled, sum(-(-round(tree.count) // work.batch) for tree in grown)))
        loading = Costs()
        if work.workers > 1:
            with loading.timed():
                subprocess.run([sys.executable, "-c", f"import {ClusterJob.__module__}"], check=True)
        for cost, count in blocks:
            _share(out, cost, count, once, (loading, start), work.workers)
        out.bytes += size
        with out.timed(work.checks * CHECKS / CHECKED * n / len(some)):
            d = np.random.default_rng(0).normal(size=(CHECKED, 3))
            thin[1].worker(work.parts[0]).vectors.visible(d / np.linalg.norm(d, axis=1, keepdims=True))
        out.add(start)
        out.add(once, 1.0 + len(work.parts))
    return out, round(sum(tree.count for tree in grown))


def _chosen(n: int, resolution: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Few receivers, some, both evenly taken, and runs of neighbours; rising."""
    most = max(FEW, MEMORY // (6 * resolution * resolution // 8))
    few, some = (np.unique(np.linspace(0, n - 1, min(n, count, most)).astype(np.int64)) for count in (FEW, SOME))
    first = np.unique(np.linspace(0, max(0, -(-n // RUN) - 1), min(RUNS, max(1, most // RUN))).astype(np.int64))
    runs = (RUN * first[:, None] + np.arange(RUN)).reshape(-1)
    return few, some, runs[runs < n]


class _Thin:
    """Some receivers with all that clusters are judged by, in a folder that is thrown away.

    turned: costs of their bits by texel; opened: of what a process reads before it begins.
    """

    def __init__(
        self,
        stack: ExitStack,
        lighting: LightingStore,
        rows: NDArray[np.int64],
        bits: NDArray[np.uint8],
        whole: formats.Writer,
        tracer: Tracer | None,
        work: Work,
    ) -> None:
        self.rows, self.work, self.turned, self.opened = rows, work, Costs(), Costs()
        self.writer = writer = stack.enter_context(scratch("light_clusters", lighting.store.settings, {}))
        position, normal = lighting.position[rows], lighting.normal[rows]
        writer.put("receivers/position", position, dims=("receiver", "axis"), units="m")
        writer.put("receivers/normal", normal, dims=("receiver", "axis"))
        area = whole.read("light_clusters/area")[rows]
        total = float(area.sum())
        area = area / total if total > 0.0 else np.full(len(rows), 1.0 / len(rows))
        writer.put("light_clusters/area", area, dims=("receiver",))
        writer.put("light_clusters/reflectance", whole.read("light_clusters/reflectance")[rows], dims=("receiver",))
        self.lobed, self.every_lobed = 0, 0
        if work.job.lobes:
            lobed = whole.read("light_clusters/lobed")
            own = np.flatnonzero(np.isin(rows, lobed)).astype(np.int32)
            self.lobed, self.every_lobed = len(own), len(lobed)
            writer.put("light_clusters/lobed", own, dims=("lobed",))
            writer.put("light_clusters/view", whole.read("light_clusters/view")[rows], dims=("receiver", "axis"))
            writer.put("light_clusters/material", whole.read("light_clusters/material")[rows], dims=("receiver",))
            for name, dims in (("model", ("material",)), ("parameters", ("material", "parameter"))):
                writer.put(f"light_clusters/{name}", whole.read(f"light_clusters/{name}"), dims=dims)
        with self.turned.timed():
            shape = (6 * lighting.resolution**2, -(-len(rows) // 64))
            base = np.lib.format.open_memmap(writer.partial_path / SCRATCH, "w+", np.uint64, shape)
            transpose_bits([(slice(0, len(rows)), bits)], base)
        job = replace(work.job, partial=str(writer.partial_path), shadows=False)
        with self.opened.timed():
            self._worker = ClusterWorker(job)
        self._worker.vectors = LightVectors(base, position, normal, tracer)

    def worker(self, part: str) -> ClusterWorker:
        """Judges that part of the light."""
        self._worker.job = replace(self._worker.job, part=part)
        return self._worker

    def like(self, n: int, part: str) -> float:
        """Of how many receivers like these judging a cell takes as long as in a store of n."""
        lobes = self._worker.lobes
        if lobes is None or part == "diffuse" or not len(lobes.judged):
            return float(n)
        judged = -(-self.every_lobed // max(1, self.every_lobed // JUDGED))
        return len(self.rows) * judged / len(lobes.judged)

    def fill(self, name: str, cells: NDArray[np.int32]) -> Costs:
        """Makes clusters of some cells, those with fractions or those with lobes; what that takes and leaves."""
        out, worker = Costs(), self.worker("all")
        first = Block("lobe/0" if name == LOBE else "fraction/0", 0, len(cells))
        with out.timed():
            (worker.fill_lobes if name == LOBE else worker.fill)(first)
        return out

    def make_room(self, cells: dict[str, NDArray[np.int32]]) -> None:
        """For clusters of those cells, by name."""
        for name, own in cells.items():
            self.writer.put(f"light_clusters/{name}", own, dims=(name, "cell_border"))
        self.work.make_outputs(self.writer, [len(own) for own in cells.values()], len(self.rows), self.lobed)


def _fill(runs: _Thin, few: _Thin, grown: list[Grown], n: int, work: Work) -> tuple[Costs, float]:
    """What it takes to make all clusters, and the bytes of all their arrays."""
    names = (DIFFUSE, LOBE) if work.job.lobes else (DIFFUSE,)
    trees = dict(zip(names, grown * (len(names) // len(grown)), strict=True))
    parts = dict(zip(names, work.parts * (len(names) // len(grown)), strict=True))
    cells = {name: sample(tree, runs.worker(parts[name]), n) for name, tree in trees.items()}
    out, size = Costs(), 0.0
    whole = n == len(runs.rows)
    for thin in (runs,) if whole else (few, runs):
        thin.make_room(cells)
    for name, tree in trees.items():
        less = Costs() if whole else few.fill(name, cells[name])
        more = runs.fill(name, cells[name])
        times = tree.count / len(cells[name])
        out.add(extended(less, more, len(few.rows), len(runs.rows), n), times)
        kind = KINDS[name == LOBE]
        of_receivers = stored_bytes(runs.writer, kind) * n / len(runs.rows)
        if name == DIFFUSE:
            own = runs.worker(parts[name])
            mean = sum(mixed(own, as_cell(cell)) for cell in cells[name].tolist()) / len(cells[name])
            every = sum(node.weight * node.mixed for node in tree.leaves) / tree.count
            of_receivers *= every / mean if mean > 0.0 else 1.0
        else:
            of_receivers += stored_bytes(runs.writer, "light_clusters/lobe_scale") * n / len(runs.rows)
        cell = stored_bytes(runs.writer, f"light_clusters/{name}") / len(cells[name])
        size += times * of_receivers + tree.count * (cell + 8.0)  # and two errors
    # The cells of all trees laid over one another, with their solid angles: little less than all.
    cell = stored_bytes(runs.writer, f"light_clusters/{DIFFUSE}") / len(cells[DIFFUSE])
    return out, size + sum(tree.count for tree in grown) * (cell + 8.0)


def _share(out: Costs, cost: Costs, blocks: int, once: Costs, start: tuple[Costs, ...], workers: int) -> None:
    """Adds costs of so many blocks, shared by processes that have to start, or by none but this one."""
    processes = min(workers, blocks)
    if processes < 2:
        out.add(cost)
        out.add(once)
        return
    for own in (*start, once):
        out.add(Costs(own.seconds, processes * own.cpu_seconds))
    out.add(Costs(-(-blocks // processes) / blocks * cost.seconds, cost.cpu_seconds))
