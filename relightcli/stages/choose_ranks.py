"""`factorize --tolerance`: ranks and coefficients of an asset that keep it, and the error measured at the end.

Direct light is held against the visibility bits at some receivers, tensors of interreflections against themselves in
some clusters; each takes the coarsest step that costs no more than its share (`left_over`).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.brdf.direct_model import LightFactors
from relightcli.core.compress.tucker import sequential_hosvd
from relightcli.core.lights.environment import latlong_to_cube, splat
from relightcli.core.shade.bright import add_irradiance, split_bright
from relightcli.core.shade.irradiance import irradiance, moment_prefix
from relightcli.core.transport.direct_tensor import direct_light, direct_transfer, light_coefficients
from relightcli.core.transport.transfer import Sources
from relightcli.errors import NumericalError
from relightcli.stages.asset import AssetStore
from relightcli.stages.left_over import DIRECT, RANKS, LeftOver
from relightcli.stages.lighting import LightingStore
from relightcli.stages.measured_error import (
    MORE,
    Draft,
    Judge,
    check_skies,
    check_views,
    edit_of,
    trial_skies,
    vertex_strips,
)
from relightcli.stages.transfer_setup import TransferSetup

COEFFICIENTS = (24, 48, 96, 192, 384, 768)
TENSOR_RANKS = ((8, 16), (16, 32), (32, 64), (64, 128), (128, 256))  # along receivers, along light
RECEIVERS, CLUSTERS = 512, 3  # that are tried


@dataclass(frozen=True)
class Ranks:
    """What `factorize` makes an asset with."""

    eigenvectors: int
    light_rank: int
    coefficients: int

    def as_json(self) -> dict[str, int]:
        return asdict(self)


def coefficients_for(lighting: LightingStore, left: LeftOver) -> int:
    """Haar coefficients of direct light: the fewest that cost no more than their share, else the most."""
    count = len(lighting)
    some = np.unique(np.linspace(0, count - 1, min(count, RECEIVERS)).astype(int))
    bits, normals = lighting.bits_of(some), lighting.normal[some]
    skies = [splat(latlong_to_cube(sky, lighting.resolution, 0.0)) for sky in trial_skies().values()]
    exact = [irradiance(bits, normals, moment_prefix(sky), lighting.threads) for sky in skies]
    even = LightFactors(np.full((2, 2, 1), 1.0 / np.pi, np.float32), np.ones(1, np.float32))
    most = 6 * lighting.resolution**2
    for keep in COEFFICIENTS:
        index, scale, value = direct_transfer(bits, normals, even, min(keep, most), lighting.threads)
        errors = []
        for sky, truth in zip(skies, exact, strict=True):
            rest, bright = split_bright(sky)
            found = direct_light(index, scale, value, light_coefficients(rest.radiance()), None, lighting.threads)
            ours = np.maximum(found[:, -1], 0.0)
            if len(bright.texel):
                add_irradiance(bits, normals, bright, ours, lighting.threads)
            off, all_ = np.pi * ours.astype(np.float64) - truth, truth.astype(np.float64)
            errors.append(float(np.sqrt((off**2).sum() / max((all_**2).sum(), 1e-300))))
        if max(errors) <= left.part(DIRECT) or keep >= most:
            return min(keep, most)
    return COEFFICIENTS[-1]


def tensor_ranks(
    setup: TransferSetup,
    sources: Sources,
    order: NDArray[np.int64],
    start: NDArray[np.int64],
    bands: int,
    left: LeftOver,
) -> tuple[int, int]:
    """Ranks along receivers and light: the least that leave no more than their share of interreflections."""
    clusters = len(start) - 1
    tensors = []
    for c in np.unique(np.linspace(0, clusters - 1, min(clusters, CLUSTERS)).astype(int)):
        rows = order[start[c] : start[c + 1]]
        whole = setup.gather_rows(rows, sources, bands)
        tensors.append(whole.reshape(len(rows), setup.count * bands * bands, -1))
    for ranks in TENSOR_RANKS:
        found = [sequential_hosvd(t, (min(ranks[0], t.shape[0]), None, min(ranks[1], t.shape[2]))) for t in tensors]
        norm2 = sum(f.norm2 for f in found)
        if norm2 == 0.0 or sum(f.error2 for f in found) <= left.of_bounces(RANKS) ** 2 * norm2:
            break
    return ranks


def keep_asset_promise(writer: formats.Writer, tolerance: float, bounces: int, threads: int, allow_miss: bool) -> None:
    """Measures the error of an asset, all stages together, and keeps it with it; raises NumericalError where it is more
    than the tolerance. bounces: interreflections that precompute found to matter."""
    lighting = AssetStore(cast("formats.Store", Draft(writer)), threads)
    scene, geometry = lighting.scene, lighting.geometry
    tracer = Tracer(geometry.positions, geometry.faces)
    front, back = lighting.receiver_of_vertex()
    views = check_views(scene, geometry, None)
    strips = [vertex_strips(geometry, tracer, view, front, back, lighting.buried()) for view in views]
    edit = edit_of(scene.materials, set(scene.materials))
    judge = Judge(scene, geometry, tracer)
    truth = max(bounces, lighting.bounces) + MORE
    found = judge.error(lighting, strips, check_skies(), lighting.bounces, truth, edit, tolerance)
    measured: dict[str, Any] = {"share": found.share, "where": found.where, "tolerance": tolerance}
    if np.isfinite(found.bound):
        measured["bound"] = found.bound
    writer.set_attrs({"measured_error": measured})
    if found.share <= tolerance or allow_miss:
        return
    ranks = writer.attrs["ranks"]
    direct = judge.error(lighting, strips, check_skies(), 0, 0, None, tolerance)
    if direct.share > 0.5 * found.share:
        knob = f"--coefficients {2 * ranks['coefficients']}, or a transfer store with a smaller --tolerance"
    elif bounces > lighting.bounces:
        knob = f"none: an asset has {lighting.bounces} interreflections, and the scene calls for {bounces}"
    else:
        knob = f"--eigenvectors {2 * ranks['eigenvectors']} --light-rank {2 * ranks['light_rank']}, or --second-order 2"
    raise NumericalError(
        f"{writer.path}: the error is {found.share:.2%} ({found.where}; of direct light {direct.share:.2%}), more than "
        f"the tolerance of {tolerance:.2%}. What would help: {knob}. The work is kept in {writer.partial_path.name}; "
        "the same command with --allow-miss finishes it as it is"
    )
