"""What clustering light will take, predicted by its dry run from some receivers and some branches of the trees.

Trees are grown level by level for a few thousand receivers. Of each level no more than KEPT cells are split, taken
evenly from all that have to be, in the order of their errors: each stands for as many as were left out. What a cell
takes with so many receivers and with fewer says what it takes with all. Clusters are made of some leaves, for runs of
neighbours, as they compress alike.
"""

from __future__ import annotations

import heapq
import math
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.lights import quadtree
from relightcli.core.lights.quadtree import Cell
from relightcli.core.transport.light_vectors import LightVectors, transpose_bits
from relightcli.run.blocks import Block
from relightcli.stages.light_cluster_job import (
    CHECKS,
    DIFFUSE,
    JUDGED,
    LOBE,
    PART,
    SCRATCH,
    ClusterJob,
    ClusterWorker,
    as_cell,
)
from relightcli.stages.lighting import LightingStore
from relightcli.stages.part_cost import Costs, copying, scratch, stored_bytes

FEW, SOME = 512, 4096  # receivers that cells are judged by
RUN, RUNS = 64, 48  # neighbours, and how many runs of them: receivers that clusters are made for
MEMORY = 64 << 20  # bytes of bits of such receivers
KEPT = 32  # cells of a level that are split
FILLED, NEIGHBOURS = 512, 64  # clusters that are made, and how many of them stand together
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


@dataclass
class _Node:
    """A cell that was judged, and how many it stands for. path: quarters on the way to it; costs: of judging it; mixed:
    the share of receivers that see a part of it."""

    cell: Cell
    path: tuple[int, ...]
    weight: float
    error: float
    splits: bool
    costs: Costs
    mixed: float
    children: list[_Node] = field(default_factory=list)


@dataclass
class _Grown:
    """A tree: nodes that were judged; leaves; the least error times solid angle of what was split within a budget."""

    judged: list[_Node]
    leaves: list[_Node]
    least: float = 0.0

    @property
    def count(self) -> float:
        """Leaves of the whole tree."""
        return sum(node.weight for node in self.leaves)


def predict_lights(lighting: LightingStore, copied: list[str], work: Work) -> tuple[Costs, int]:
    """Costs of clustering the lights, but for opening the store, and how many clusters there will be. copied: arrays
    that are taken over."""
    store, n, out = lighting.store, len(lighting), Costs()
    few, some, runs = _chosen(n, lighting.resolution)
    with ExitStack() as stack:
        whole = stack.enter_context(scratch("light_clusters", store.settings, {}))
        out.add(copying(store, copied, whole))
        with out.timed():
            work.put_receivers(whole)
        out.bytes += stored_bytes(whole, "light_clusters")
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
        trees = [_grow(thin[0].worker(part), thin[1].worker(part), n, thin[1].like(n, part)) for part in work.parts]
        grown = [_spend(tree, work) for tree in trees]
        blocks = []
        for tree in grown:
            cells = sum(node.weight for node in tree.judged if len(node.path) == work.level + 1)
            serial = Costs()
            for node in tree.judged:
                serial.add(node.costs, node.weight)
            blocks.append((serial, round(cells) if work.lights is None and work.seconds is None else 1))
        filled, size = _fill(thin[2], thin[0], grown, n, work)
        blocks.append((filled, sum(-(-round(tree.count) // work.batch) for tree in grown)))
        for cost, count in blocks:
            _share(out, cost, count, once, start, work)
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


def _grow(few: ClusterWorker, some: ClusterWorker, n: int, like: float) -> list[_Node]:
    """The six trees of a store of n receivers, grown until all cells are good enough. like: of how many receivers as
    these judging is to be told."""
    job = some.job
    scale = _scale(some, n)
    roots = [(cell, (cell[0],)) for cell in quadtree.roots(job.resolution)]
    out: list[_Node] = []
    level: list[tuple[Cell, tuple[int, ...], _Node | None]] = [(cell, path, None) for cell, path in roots]
    weight = 1.0
    while level:
        costs = [Costs(), Costs()]
        again = level[:: max(1, len(level) // KEPT)] if len(some.normal) < n else []
        if again:
            with costs[0].timed(1.0 / len(again)):
                for cell, _, _ in again:
                    few.worst(cell)
        with costs[1].timed(1.0 / len(level)):
            errors = [scale * some.worst(cell) for cell, _, _ in level]
        cost = _extended(costs[0], costs[1], len(few.normal), len(some.normal), like)
        splits = []
        for (cell, path, parent), error in zip(level, errors, strict=True):
            able = quadtree.lights(cell) > 1 and error >= PART[job.part] * job.epsilon
            node = _Node(cell, path, weight, error, able, cost, _mixed(some, cell))
            out.append(node)
            if parent is not None:
                parent.children.append(node)
            if able:
                splits.append(node)
        splits.sort(key=lambda node: -node.error)
        if len(splits) > KEPT:
            picked = ((np.arange(KEPT) + 0.5) * len(splits) / KEPT).astype(int)
            weight *= len(splits) / KEPT
            splits = [splits[k] for k in picked]
        level = [
            (part, (*node.path, k), node) for node in splits for k, part in enumerate(quadtree.children(node.cell))
        ]
    return out


def _mixed(worker: ClusterWorker, cell: Cell) -> float:
    """Share of receivers that see some of a cell's nine samples: of these a cluster's bytes come."""
    visible, _ = worker.nine(cell)
    mixed = np.bitwise_and.reduce(visible) ^ np.bitwise_or.reduce(visible)
    return int(np.bitwise_count(mixed).sum()) / len(worker.normal)


def _extended(few: Costs, some: Costs, count: int, more: int, like: float) -> Costs:
    """Costs for `like` receivers, where they are known for fewer: `count` of them and `more`."""
    out = Costs()
    out.add(some)
    if like != more > count:
        for key in ("seconds", "cpu_seconds"):
            slope = max(0.0, getattr(some, key) - getattr(few, key)) / (more - count)
            setattr(out, key, max(0.0, getattr(some, key) + slope * (like - more)))
    return out


def _spend(nodes: list[_Node], work: Work) -> _Grown:
    """What is judged and what is left whole; within a budget the largest errors are split first."""
    roots = [node for node in nodes if len(node.path) == 1]
    if work.lights is None and work.seconds is None:
        return _Grown(nodes, [node for node in nodes if not node.splits])
    out = _Grown([], [])
    count, spent = 0.0, 0.0
    waiting: list[tuple[float, tuple[int, ...], _Node]] = []

    def judge(some: list[_Node]) -> None:
        nonlocal count, spent
        for node in some:
            out.judged.append(node)
            count += node.weight
            spent += node.weight * node.costs.seconds
            size = float(quadtree.solid_angles(np.array([node.cell]), work.job.resolution)[0])
            if node.splits:
                heapq.heappush(waiting, (-node.error * size, node.path, node))
            else:
                out.leaves.append(node)

    judge(roots)
    while waiting and (work.lights is None or count < work.lights) and (work.seconds is None or spent < work.seconds):
        key, _, node = heapq.heappop(waiting)
        out.least = -key
        count -= node.weight
        judge(node.children)
    out.leaves += [node for _, _, node in waiting]
    return out


def _sample(tree: _Grown, worker: ClusterWorker, n: int) -> NDArray[np.int32]:
    """Some leaves (m, 5) in the order of the trees, neighbours by neighbours: all there are, or those at some places of
    the trees, grown anew by a worker."""
    leaves = sorted(tree.leaves, key=lambda node: node.path)
    if tree.count <= FILLED and all(node.weight == 1.0 for node in leaves):
        return np.array([node.cell for node in leaves], np.int32)
    ends = np.cumsum([node.weight for node in leaves])
    groups = FILLED // NEIGHBOURS
    first = np.searchsorted(ends, (np.arange(groups) + 0.5) * ends[-1] / groups)
    found: dict[Cell, None] = {}
    for k in first:
        found |= dict.fromkeys(_from(tree, worker, n, leaves[k].path))
    return np.array(list(found), np.int32)


def _from(tree: _Grown, worker: ClusterWorker, n: int, path: tuple[int, ...]) -> list[Cell]:
    """NEIGHBOURS leaves from a cell on, in the order of the trees."""
    job, stack = worker.job, quadtree.roots(worker.job.resolution)[path[0] :][::-1]
    out: list[Cell] = []
    for quarter in path[1:]:
        stack += quadtree.children(stack.pop())[: quarter - 1 if quarter else None : -1]
    while stack and len(out) < NEIGHBOURS:
        cell = stack.pop()
        error = _scale(worker, n) * worker.worst(cell)
        size = float(quadtree.solid_angles(np.array([cell]), job.resolution)[0])
        able = quadtree.lights(cell) > 1 and error >= PART[job.part] * job.epsilon
        if able and error * size >= tree.least:
            stack += quadtree.children(cell)[::-1]
        else:
            out.append(cell)
    return out


def _scale(worker: ClusterWorker, n: int) -> float:
    """Of errors at a worker's receivers, those at n like them: the paper divides the norm by their number."""
    return math.sqrt(len(worker.normal) / n) if worker.job.criterion == "paper" else 1.0


def _fill(runs: _Thin, few: _Thin, grown: list[_Grown], n: int, work: Work) -> tuple[Costs, float]:
    """What it takes to make all clusters, and the bytes of all their arrays."""
    names = (DIFFUSE, LOBE) if work.job.lobes else (DIFFUSE,)
    trees = dict(zip(names, grown * (len(names) // len(grown)), strict=True))
    parts = dict(zip(names, work.parts * (len(names) // len(grown)), strict=True))
    cells = {name: _sample(tree, runs.worker(parts[name]), n) for name, tree in trees.items()}
    out, size = Costs(), 0.0
    whole = n == len(runs.rows)
    for thin in (runs,) if whole else (few, runs):
        thin.make_room(cells)
    for name, tree in trees.items():
        less = Costs() if whole else few.fill(name, cells[name])
        more = runs.fill(name, cells[name])
        times = tree.count / len(cells[name])
        out.add(_extended(less, more, len(few.rows), len(runs.rows), n), times)
        kind = KINDS[name == LOBE]
        of_receivers = stored_bytes(runs.writer, kind) * n / len(runs.rows)
        if name == DIFFUSE:
            own = runs.worker(parts[name])
            mean = sum(_mixed(own, as_cell(cell)) for cell in cells[name].tolist()) / len(cells[name])
            every = sum(node.weight * node.mixed for node in tree.leaves) / tree.count
            of_receivers *= every / mean if mean > 0.0 else 1.0
        else:
            of_receivers += stored_bytes(runs.writer, "light_clusters/lobe_scale") * n / len(runs.rows)
        cell = stored_bytes(runs.writer, f"light_clusters/{name}") / len(cells[name])
        size += times * of_receivers + tree.count * (cell + 8.0)  # and two errors
    # The cells of all trees laid over one another, with their solid angles: little less than all.
    cell = stored_bytes(runs.writer, f"light_clusters/{DIFFUSE}") / len(cells[DIFFUSE])
    return out, size + sum(tree.count for tree in grown) * (cell + 8.0)


def _share(out: Costs, cost: Costs, blocks: int, once: Costs, start: Costs, work: Work) -> None:
    """Adds costs of so many blocks, shared by processes that have to start, or by none but this one."""
    processes = min(work.workers, blocks)
    if processes < 2:
        out.add(cost)
        out.add(once)
        return
    loading = Costs()
    with loading.timed():
        subprocess.run([sys.executable, "-c", f"import {ClusterJob.__module__}"], check=True)
    for own in (loading, once, start):
        out.add(Costs(own.seconds, processes * own.cpu_seconds))
    out.add(Costs(-(-blocks // processes) / blocks * cost.seconds, cost.cpu_seconds))
