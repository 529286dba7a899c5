"""`cluster --tolerance` of lights: how alike the lights of a cluster have to be, and the error that is left.

Judged is the exit radiance under one small light from anywhere, all of its cluster's other lights being dark:

    share = (sum_l sum_i a_i (ours_il - true_il)^2 / sum_l sum_i a_i true_il^2)^(1/2)

over CHECKS random lights l and all receivers i of area a_i. Under a sky errors of many lights cancel each other in
part, so that its picture is nearer to the truth than that.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.core.lights import quadtree
from relightcli.core.lights.quadtree import Cell
from relightcli.core.shade.cluster_sum import GROUP
from relightcli.errors import InputError, NumericalError
from relightcli.run.accounting import Meter
from relightcli.run.blocks import Info
from relightcli.stages.left_over import LeftOver, left_over, spend
from relightcli.stages.light_cluster_job import ClusterWorker

CHECKS = 256
PER_TOLERANCE = 1.0  # epsilon, in units of what is left of the tolerance


def need_tolerance(store: formats.Store, tolerance: float | None, criterion: str) -> LeftOver | None:
    """What the stages before have left of a tolerance, or of the store's; None where no error is promised. Raises
    InputError for a tolerance that cannot be kept."""
    if tolerance is None:
        return None if criterion == "paper" else left_over(store)
    if not 0.0 < tolerance < 1.0:
        raise InputError(f"--tolerance: expected more than 0 and less than 1; found {tolerance}")
    if criterion == "paper":
        raise InputError("--tolerance: goes with --criterion rms; the paper's error is no share of the light")
    return left_over(store, tolerance)


def epsilon_for(left: LeftOver) -> float:
    """The error that clusters may have, so that what is left is kept."""
    return PER_TOLERANCE * left.left


def keep_lights_promise(
    writer: formats.Writer,
    worker: ClusterWorker,
    trees: list[list[Cell]],
    left: LeftOver,
    source: formats.Store,
    seed: int,
    allow_miss: bool,
) -> None:
    """Measures the error under lights that no cluster was made from and keeps it with the store; raises NumericalError
    where it is more than what is left of the tolerance. source: the store that this one is made from."""
    if "promise" not in writer.done:
        meter, rays = Meter(), worker.vectors.rays
        share = light_error(worker, trees, seed)
        info: Info = {**meter.read(), "rays": float(worker.vectors.rays - rays), "share": share}
        writer.record("promise", info)
    share = float(next(block["share"] for block in writer.blocks if block["id"] == "promise"))
    writer.set_attrs({"spent": spend(source, "cluster", share)})
    if share <= left.left or allow_miss:
        return
    epsilon = float(writer.settings["epsilon"])
    finer = f"--epsilon {0.9 * epsilon * left.left / share:.2g}"
    if writer.settings["lights"] is not None or writer.settings["seconds"] is not None:
        finer = "more --lights or --seconds, or none of them"
    raise NumericalError(
        f"{writer.path}: clusters cost {share:.2%} under a light from anywhere, more than the {left.left:.2%} that are "
        f"left of the tolerance of {left.tolerance:.2%}. What would help: {finer}. The work is kept in "
        f"{writer.partial_path.name}; the same command with --allow-miss finishes it as it is"
    )


def light_error(worker: ClusterWorker, trees: list[list[Cell]], seed: int) -> float:
    """The share above. trees: the cells that have fractions and, if lobes are kept, those that have lobes."""
    d = np.random.default_rng((seed, 1)).normal(size=(CHECKS, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    d = d[np.argsort(_leaves(worker, trees[0], d), kind="stable")]  # chunk by chunk
    visible = worker.vectors.visible(d)
    lobes = worker.lobes
    diffuse = worker.reflectance if lobes is None else lobes.diffuse
    leaf, fraction = _leaves(worker, trees[0], d), _Rows(worker.out("fraction"))
    if lobes is not None:
        lobe_leaf, steps, scale = _leaves(worker, trees[1], d), _Rows(worker.out("lobe")), worker.out("lobe_scale")[:]
    off, whole = 0.0, 0.0
    for k in range(CHECKS):
        seen = np.unpackbits(visible[k].view(np.uint8), bitorder="little")[: len(worker.normal)]
        height = worker.normal @ d[k]
        radius = worker.radius(trees[0][leaf[k]])
        even = np.where(height >= radius, height, np.maximum(height + radius, 0.0) ** 2 / (4.0 * radius))
        true = diffuse * (seen * np.maximum(height, 0.0))
        error = diffuse * (fraction[int(leaf[k])] / 255.0 * even) - true
        if lobes is not None:
            rows = lobes.rows
            shine = lobes.transfer(visible[k : k + 1], d[k : k + 1], rows)[0].astype(np.float64)
            ours = steps[int(lobe_leaf[k])] * np.repeat(scale[lobe_leaf[k]].astype(np.float64), GROUP)[: len(rows)]
            error[rows] += lobes.specular[rows] * (ours - shine)
            true[rows] += lobes.specular[rows] * shine
        off += float(worker.area @ error**2)
        whole += float(worker.area @ true**2)
    return math.sqrt(off / whole) if whole > 0.0 else 0.0


def _leaves(worker: ClusterWorker, leaves: list[Cell], d: NDArray[np.float64]) -> NDArray[np.int64]:
    return quadtree.leaves_at(quadtree.build_tree(leaves, worker.job.resolution), d)


class _Rows:
    """Rows of an array in a store; the last chunk is kept."""

    def __init__(self, array: Any) -> None:
        self.array, self.start, self.block = array, -1, np.zeros((0, 0), np.uint8)

    def __getitem__(self, row: int) -> NDArray[np.uint8]:
        step = self.array.chunks[0]
        start = row // step * step
        if start != self.start:
            self.start, self.block = start, np.asarray(self.array[start : start + step])
        found: NDArray[np.uint8] = self.block[row - start]
        return found
