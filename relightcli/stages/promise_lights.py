"""`cluster --tolerance` of lights: how alike the lights of a cluster have to be, and the error that is left.

Judged is the exit radiance under one soft light at a time, some lights l of equal flux within SOFT of a direction d:

    share = (sum_d sum_i a_i (sum_l ours_il - true_il)^2 / sum_d sum_i a_i (sum_l true_il)^2)^(1/2)

over random directions and all receivers i of area a_i. Harder light is no cluster's: small bright places of a map, and
cells that hold much of its light, are taken apart when a picture is made. Under a whole sky errors of many places
cancel each other in part.
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

PLACES, LIGHTS = 48, 16  # random directions, and lights about each
SOFT = math.radians(10.0)
# The share in units of epsilon's square, at the most of two scenes each at several epsilons: 5.0 to 6.7, and with lobes
# in the clusters 4.4 to 9.9; soft lights span several cells, more of them the smaller these are.
SHARE, SHARE_OF_LOBES = 8.0, 13.0


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


def epsilon_for(left: LeftOver, lobes: bool) -> float:
    """The error that clusters may have, so that what is left is kept. lobes: they hold specular lobes as well."""
    return math.sqrt(left.left / (SHARE_OF_LOBES if lobes else SHARE))


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
    finer = f"--epsilon {0.9 * epsilon * math.sqrt(left.left / share):.2g}"
    if writer.settings["lights"] is not None or writer.settings["seconds"] is not None:
        finer = "more --lights or --seconds, or none of them"
    raise NumericalError(
        f"{writer.path}: clusters cost {share:.2%} under soft lights from anywhere, more than the {left.left:.2%} that "
        f"are left of the tolerance of {left.tolerance:.2%}. What would help: {finer}. The work is kept in "
        f"{writer.partial_path.name}; the same command with --allow-miss finishes it as it is"
    )


def light_error(worker: ClusterWorker, trees: list[list[Cell]], seed: int) -> float:
    """The share above. trees: the cells that have fractions and, if lobes are kept, those that have lobes."""
    d = _soft_lights(seed)
    place = np.repeat(np.arange(PLACES), LIGHTS)
    order = np.argsort(_leaves(worker, trees[0], d), kind="stable")  # chunk by chunk
    lobes = worker.lobes
    diffuse = worker.reflectance if lobes is None else lobes.diffuse
    leaf, fraction = _leaves(worker, trees[0], d), _Rows(worker.out("fraction"))
    if lobes is not None:
        lobe_leaf, steps, scale = _leaves(worker, trees[1], d), _Rows(worker.out("lobe")), worker.out("lobe_scale")[:]
    error, true = np.zeros((PLACES, len(worker.normal))), np.zeros((PLACES, len(worker.normal)))
    for k in order:
        bits = worker.vectors.visible(d[k : k + 1])
        seen = np.unpackbits(bits[0].view(np.uint8), bitorder="little")[: len(worker.normal)]
        height = worker.normal @ d[k]
        radius = worker.radius(trees[0][leaf[k]])
        even = np.where(height >= radius, height, np.maximum(height + radius, 0.0) ** 2 / (4.0 * radius))
        exact = diffuse * (seen * np.maximum(height, 0.0))
        ours = diffuse * (fraction[int(leaf[k])] / 255.0 * even)
        if lobes is not None:
            rows = lobes.rows
            shine = lobes.transfer(bits, d[k : k + 1], rows)[0].astype(np.float64)
            kept = steps[int(lobe_leaf[k])] * np.repeat(scale[lobe_leaf[k]].astype(np.float64), GROUP)[: len(rows)]
            exact[rows] += lobes.specular[rows] * shine
            ours[rows] += lobes.specular[rows] * kept
        error[place[k]] += ours - exact
        true[place[k]] += exact
    off, whole = (float((values**2 @ worker.area).sum()) for values in (error, true))
    return math.sqrt(off / whole) if whole > 0.0 else 0.0


def _soft_lights(seed: int) -> NDArray[np.float64]:
    """Directions (PLACES * LIGHTS, 3), place by place."""
    rng = np.random.default_rng((seed, 1))
    middle = rng.normal(size=(PLACES, 3))
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    # Even over the cap about each: the height falls evenly from 1 to cos(SOFT).
    height = 1.0 - (1.0 - math.cos(SOFT)) * rng.random((PLACES, LIGHTS, 1))
    aside = rng.normal(size=(PLACES, LIGHTS, 3))
    aside -= np.einsum("plk,pk->pl", aside, middle)[..., None] * middle[:, None]
    aside /= np.linalg.norm(aside, axis=2, keepdims=True)
    out: NDArray[np.float64] = height * middle[:, None] + np.sqrt(1.0 - height**2) * aside
    return out.reshape(-1, 3)


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
