"""Tucker decompositions of factorize and of BRDFs against tensorly's partial_tucker, at the same ranks.

The tensors are real ones: interreflections of a cluster of receivers, and measured Cook-Torrance materials over views
and lights. tensorly iterates from an SVD of every unfolding; ours goes mode after mode by subspaces (`factorize`), or
iterates as well from Gram matrices (BRDFs). Errors are what the core lacks of the tensor's norm.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.asset import metal_scene
from benchmarks.processes import run_tool
from benchmarks.report import Report, Row, Table
from benchmarks.scenes import Setting

REPEATS, ENOUGH = 3, 2.0  # calls, and the seconds after which there is no other
TRANSPORT, BRDF = (64, None, 96), (4, 8, 8)  # ranks; no rank: the mode is left alone
BANDS = 4
Ranks = tuple[int | None, int | None, int | None]


def transport_tensor(setting: Setting) -> NDArray[np.float32]:
    """Receivers x channels and harmonics x lights: one bounce in the largest cluster of a small scene."""
    from relightcli.stages.lighting import LightingStore
    from relightcli.stages.transfer_setup import TransferSetup

    scene, _ = metal_scene(setting, 400 if setting.quick else 4_000)
    transfer, clusters = (scene.parent / f"{name}.zarr" for name in ("transfer", "clusters"))
    if not clusters.exists():
        run_tool("precompute", scene, "-o", transfer, "--bounces", "1", "--no-subdivide")
        run_tool("cluster", transfer, "-o", clusters)
    lighting = LightingStore(clusters, 1)
    setup = TransferSetup(lighting, int(lighting.store.settings["functions"]), 1)
    label = lighting.store.read("cluster/label")
    rows = np.flatnonzero(label == np.bincount(label).argmax())[: 64 if setting.quick else 512]
    found = setup.gather_rows(rows, setup.sources(lighting.store.read("light/basis")), BANDS)
    return np.ascontiguousarray(found.reshape(len(rows), -1, found.shape[-1]), np.float32)


def brdf_tensor(setting: Setting) -> NDArray[np.float64]:
    """Entries x views x lights: fits to measured materials, without their lobes."""
    from relightcli.core.brdf.dataset import cook_torrance_set
    from relightcli.core.brdf.measured import fits
    from relightcli.core.brdf.specular_lobes import fit_lobes, lobes_on_grid

    points = [(fit.f0, fit.roughness) for fit in fits()]
    brdfs = cook_torrance_set(points[:: 8 if setting.quick else 1], 8 if setting.quick else 20)
    return brdfs.values - lobes_on_grid(brdfs.grid, fit_lobes(brdfs))


def fastest(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of the fastest of a few calls, one if they are long, and what the last returned."""
    seconds, spent = math.inf, 0.0
    for _ in range(REPEATS):
        clock = time.perf_counter()
        found = call()
        took = time.perf_counter() - clock
        seconds, spent = min(seconds, took), spent + took
        if spent > ENOUGH:
            break
    return seconds, found


def tensorly_error(x: NDArray[np.floating], ranks: Ranks) -> tuple[float, float]:
    """Seconds, and the relative error."""
    from tensorly.decomposition import partial_tucker

    modes = [mode for mode, rank in enumerate(ranks) if rank is not None]
    wanted = [min(rank, x.shape[mode]) for mode, rank in enumerate(ranks) if rank is not None]
    seconds, ((core, _), _) = fastest(lambda: partial_tucker(x, wanted, modes))
    return seconds, lacking(x, core)


def lacking(x: NDArray[np.floating], core: NDArray[np.floating]) -> float:
    """|X - reconstruction| / |X| of a core between orthonormal factors, summed in float64."""
    whole, kept = (float((part.astype(np.float64) ** 2).sum()) for part in (x, core))
    return math.sqrt(max(0.0, 1.0 - kept / whole))


def measure(setting: Setting) -> Report:
    from relightcli.core.compress.tucker import hooi, sequential_hosvd

    transport, brdf = transport_tensor(setting), brdf_tensor(setting)
    report = Report("one bounce of a cluster of a small scene, and measured materials; the fastest call each")
    peer = find_spec("tensorly") is not None
    if not peer:
        report.skipped.append("tensorly is not installed: pip install 'relightcli[bench]'")
    table: list[tuple[str | int | float, ...]] = []
    for name, x, ranks, ours in (
        ("one bounce, as factorize does", transport, TRANSPORT, sequential_hosvd),
        ("one bounce, iterated", transport, TRANSPORT, hooi),
        ("materials, iterated", brdf, BRDF, hooi),
    ):
        shape = " x ".join(f"{n:,}" for n in x.shape)
        seconds, found = fastest(lambda ours=ours, x=x, ranks=ranks: ours(x, ranks))  # type: ignore[misc]
        error = lacking(x, found.core)
        table.append((name, shape, "ours", seconds, error))
        work = f"{name}, {shape}, error {error:.5f}"
        if peer:
            theirs, their_error = tensorly_error(x, ranks)
            table.append((name, shape, "tensorly", theirs, their_error))
            against = f"tensorly, error {their_error:.5f}: {theirs:.3g} s"
            report.rows.append(Row(work, seconds, "s", against, theirs / seconds))
        else:
            report.rows.append(Row(work, seconds, "s"))
    report.tables.append(Table("seconds and relative error", ("tensor", "size", "by", "s", "error"), tuple(table)))
    return report
