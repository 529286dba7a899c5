"""Trees of clustered lights as a pilot grows them, for some receivers: branches that stand for others.

Trees are grown level by level. Of each level no more than KEPT cells are split, taken evenly from all that have to be,
in the order of their errors: each stands for as many as were left out. What a cell takes with so many receivers and
with fewer says what it takes with all.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from relightcli.core.lights import quadtree
from relightcli.core.lights.quadtree import Cell
from relightcli.stages.light_cluster_job import PART, ClusterWorker
from relightcli.stages.part_cost import Costs

KEPT = 32  # cells of a level that are split
FILLED, NEIGHBOURS = 512, 64  # leaves that clusters are made of, and how many of them stand together


@dataclass
class Node:
    """A cell that was judged, and how many it stands for. path: quarters on the way to it; costs: of judging it; mixed:
    the share of receivers that see a part of it."""

    cell: Cell
    path: tuple[int, ...]
    weight: float
    error: float
    splits: bool
    costs: Costs
    mixed: float
    children: list[Node] = field(default_factory=list)


@dataclass
class Grown:
    """A tree: nodes that were judged; leaves; the least error times solid angle of what was split within a budget."""

    judged: list[Node]
    leaves: list[Node]
    least: float = 0.0

    @property
    def count(self) -> float:
        """Leaves of the whole tree."""
        return sum(node.weight for node in self.leaves)


def grow(few: ClusterWorker, some: ClusterWorker, n: int, like: float) -> list[Node]:
    """The six trees of a store of n receivers, grown until all cells are good enough. like: of how many receivers as
    these judging is to be told."""
    job = some.job
    scale = _scale(some, n)
    roots = [(cell, (cell[0],)) for cell in quadtree.roots(job.resolution)]
    out: list[Node] = []
    level: list[tuple[Cell, tuple[int, ...], Node | None]] = [(cell, path, None) for cell, path in roots]
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
        cost = extended(costs[0], costs[1], len(few.normal), len(some.normal), like)
        splits = []
        for (cell, path, parent), error in zip(level, errors, strict=True):
            able = quadtree.lights(cell) > 1 and error >= PART[job.part] * job.epsilon
            node = Node(cell, path, weight, error, able, cost, mixed(some, cell))
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


def mixed(worker: ClusterWorker, cell: Cell) -> float:
    """Share of receivers that see some of a cell's nine samples and not all: of these a cluster's bytes come."""
    visible, _ = worker.nine(cell)
    some = np.bitwise_and.reduce(visible) ^ np.bitwise_or.reduce(visible)
    return int(np.bitwise_count(some).sum()) / len(worker.normal)


def extended(few: Costs, some: Costs, count: int, more: int, like: float) -> Costs:
    """Costs for `like` receivers, where they are known for fewer: `count` of them and `more`."""
    out = Costs()
    out.add(some)
    if like != more > count:
        for key in ("seconds", "cpu_seconds"):
            slope = max(0.0, getattr(some, key) - getattr(few, key)) / (more - count)
            setattr(out, key, max(0.0, getattr(some, key) + slope * (like - more)))
    return out


def spend(nodes: list[Node], resolution: int, lights: int | None, seconds: float | None) -> Grown:
    """What is judged and what is left whole; within a budget of clusters or seconds the largest errors go first."""
    roots = [node for node in nodes if len(node.path) == 1]
    if lights is None and seconds is None:
        return Grown(nodes, [node for node in nodes if not node.splits])
    out = Grown([], [])
    count, spent = 0.0, 0.0
    waiting: list[tuple[float, tuple[int, ...], Node]] = []

    def judge(some: list[Node]) -> None:
        nonlocal count, spent
        for node in some:
            out.judged.append(node)
            count += node.weight
            spent += node.weight * node.costs.seconds
            size = float(quadtree.solid_angles(np.array([node.cell]), resolution)[0])
            if node.splits:
                heapq.heappush(waiting, (-node.error * size, node.path, node))
            else:
                out.leaves.append(node)

    judge(roots)
    while waiting and (lights is None or count < lights) and (seconds is None or spent < seconds):
        key, _, node = heapq.heappop(waiting)
        out.least = -key
        count -= node.weight
        judge(node.children)
    out.leaves += [node for _, _, node in waiting]
    return out


def sample(tree: Grown, worker: ClusterWorker, n: int) -> NDArray[np.int32]:
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


def _from(tree: Grown, worker: ClusterWorker, n: int, path: tuple[int, ...]) -> list[Cell]:
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
