"""Stage cluster: a transfer store in; out comes the same with receivers in groups and a basis for their light.

Receivers whose interreflections are alike are grouped by CPCA over their one-bounce tensors [Sun 2007, sec. 3.4; Sloan
2003]; the light axis of those tensors gets an orthonormal basis whose rank follows from a tolerance.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli import __version__
from relightcli.adapters.files import need_output
from relightcli.core.brdf.transport_basis import FUNCTIONS
from relightcli.core.compress.groups import grouped
from relightcli.core.compress.tucker import gram_spectrum
from relightcli.core.parts import for_each, in_order, one_blas_thread
from relightcli.errors import InputError, StoreError
from relightcli.run.accounting import Account, Meter
from relightcli.stages.budget import summary
from relightcli.stages.copying import copy_arrays
from relightcli.stages.left_over import basis_tolerance, left_over, spend
from relightcli.stages.lighting import LightingStore, need_still
from relightcli.stages.tensor_cost import predict_cluster
from relightcli.stages.transfer_setup import BLOCK, CELLS, TransferSetup, coarse_cells

KIND = "clusters"
ORDER = 4  # bands of the tensors
TOLERANCE = 0.01  # of the basis for light, unless there is a reason for another
SKETCH = 128  # random directions that stand in for a receiver's tensor
SAMPLE = 1024  # receivers whose full tensors show what light they react to
RECEIVERS_PER_CLUSTER = 1000


@dataclass(frozen=True)
class Config:
    """Everything that `cluster` needs to know. `clusters` None: one per 1000 receivers; tolerance None: a part of what
    is left of the store's, else TOLERANCE."""

    store: Path
    output: Path
    clusters: int | None = None
    tolerance: float | None = None
    functions: int = FUNCTIONS
    seed: int = 0
    workers: int = 1
    overwrite: bool = False
    dry_run: bool = False
    quiet: bool = False


@one_blas_thread()
def cluster(config: Config) -> dict[str, Any]:
    """Runs the stage; returns a summary. Raises InputError, StoreError, NumericalError, OSError."""
    started, account = time.perf_counter(), Account()
    if config.tolerance is not None and not 0.0 < config.tolerance < 1.0:
        raise InputError(f"--tolerance: expected more than 0 and less than 1; found {config.tolerance}")
    need_output(config.output, store=True)
    with account.step("reading"):
        lighting = LightingStore(config.store, config.workers)
    need_still(lighting.store)
    if lighting.store.kind != "transfer":
        raise StoreError(f"{config.store}: expected a store of kind transfer, found {lighting.store.kind}.")
    _need_bounces(lighting)
    tolerance = config.tolerance or basis_tolerance(lighting.store) or TOLERANCE
    clusters = config.clusters or max(1, round(len(lighting) / RECEIVERS_PER_CLUSTER))
    settings = {
        **lighting.store.settings,
        "clusters": clusters,
        "cluster_tolerance": tolerance,
        "functions": config.functions,
        "cluster_seed": config.seed,
        "order": ORDER,
    }
    if config.dry_run:
        costs = predict_cluster(lighting, clusters, tolerance, config.functions, config.seed, SAMPLE, ORDER, SKETCH)
        told = {"dry_run": True, "receivers": len(lighting), "clusters": clusters, "notes": []}
        return {**told, "predicted": costs.as_json(account)}
    writer = formats.begin(
        config.output,
        KIND,
        settings=settings,
        inputs={"transfer": lighting.store.fingerprint},
        program=f"relightcli {__version__}",
        overwrite=config.overwrite,
    )
    if writer is None:
        return {"store": str(config.output), "status": "up to date", "notes": []}
    with writer:
        resumed = bool(writer.done)
        writer.set_attrs(lighting.store.attrs)
        with account.step("copying"):
            copy_arrays(lighting.store, writer, lighting.store.names())
        with account.step("reading"):
            setup = TransferSetup(lighting, config.functions, config.workers, writer.partial_path)
        if "light-basis" not in writer.done:
            with account.step("light-basis"):
                meter = Meter()
                basis, held_out = _light_basis(setup, tolerance, config.seed)
                writer.put("light/basis", basis, dims=("light_cell", "light"))
                writer.record("light-basis", {**meter.read(), "error": held_out})
        if "groups" not in writer.done:
            with account.step("groups"):
                meter = Meter()
                rows = _sketch(setup, config)
                label, left = grouped(rows, clusters, config.seed, config.workers)
                writer.put("cluster/label", label, dims=("receiver",))
                writer.record("groups", {**meter.read(), "clusters": int(label.max()) + 1, "error": left})
        spare = left_over(lighting.store)
        if spare is not None:
            error = next(float(block["error"]) for block in writer.blocks if block["id"] == "light-basis")
            writer.set_attrs({"spent": spend(lighting.store, "cluster", error * spare.bounced)})
        writer.commit(summary(account, started, resumed, config.workers, lighting.store))
    store = formats.open_store(config.output, KIND)
    info = {block["id"]: block for block in store.blocks}
    return {
        "store": str(config.output),
        "status": "resumed" if resumed else "written",
        "receivers": len(lighting),
        "clusters": info["groups"]["clusters"],
        "light_rank": int(store.layouts["light/basis"].shape[1]),
        "light_error": info["light-basis"]["error"],
        "bytes": sum(size.stored for size in store.sizes().values()),
        "seconds": time.perf_counter() - started,
        "notes": [],
    }


def direct_only(path: Path) -> bool:
    """Whether a transfer store holds no interreflections, so that only its lights can be clustered."""
    store = formats.open_store(path)
    return store.kind == "transfer" and "bounce/hit" not in store


def _need_bounces(lighting: LightingStore) -> None:
    if lighting.camera_name is not None:
        raise StoreError(
            f"{lighting.store.path}: its receivers are pixels of a camera; precompute with --receivers vertices"
        )
    if "bounce/hit" not in lighting.store:
        raise StoreError(
            f"{lighting.store.path}: holds direct light only, which needs no clusters; precompute with --bounces 1 or 2"
        )


def _light_basis(setup: TransferSetup, tolerance: float, seed: int) -> tuple[NDArray[np.float32], float]:
    """Basis (6 CELLS^2, L) of what light one-bounce tensors react to, and the relative RMS that it leaves of those of
    receivers that it was not made from."""
    n = len(setup.lighting)
    picked = np.random.default_rng(seed).permutation(n)[:SAMPLE]
    cells = 6 * CELLS * CELLS
    tensors = np.empty((len(picked), setup.count * ORDER * ORDER, cells), np.float32)
    seen = setup.seen_from(picked)
    for face in range(6):
        own = slice(face * CELLS * CELLS, (face + 1) * CELLS * CELLS)
        sources = setup.sources(np.eye(cells, dtype=np.float32)[:, own], seen)
        tensors[:, :, own] = setup.gather_rows(picked, sources, ORDER).reshape(len(picked), -1, CELLS * CELLS)
        del sources
    half = max(1, len(picked) // 2)
    values, vectors = gram_spectrum(_gram(tensors[:half].reshape(-1, cells), setup.threads))
    left = np.sqrt(np.maximum(0.0, 1.0 - np.cumsum(values) / max(values.sum(), 1e-300)))
    rank = int(np.argmax(left <= tolerance)) + 1 if (left <= tolerance).any() else len(values)
    basis = np.ascontiguousarray(vectors[:, :rank], np.float32)
    gram = _gram((tensors[half:] if len(picked) > half else tensors).reshape(-1, cells), setup.threads)
    norm2, kept = float(np.trace(gram)), float(np.einsum("cl,cd,dl->", basis, gram, basis, optimize=True))
    return basis, float(np.sqrt(max(0.0, 1.0 - kept / norm2))) if norm2 else 0.0


def _gram(rows: NDArray[np.float32], threads: int) -> NDArray[np.float64]:
    """rows' rows, (D, D), in float64."""

    def square(first: int) -> NDArray[np.float64]:
        part = rows[first : first + (1 << 14)].astype(np.float64)
        return part.T @ part

    return sum(in_order(square, range(0, len(rows), 1 << 14), threads), np.zeros((rows.shape[1],) * 2))


def _sketch(setup: TransferSetup, config: Config) -> NDArray[np.float32]:
    """Random projections of the receivers' tensors under coarse light, (N, SKETCH): their distances are nearly kept."""
    sources = setup.sources(coarse_cells())
    n, size = len(setup.lighting), setup.count * ORDER * ORDER * sources.even.shape[1]
    rng = np.random.default_rng(config.seed)
    directions = rng.standard_normal((size, min(SKETCH, size))).astype(np.float32) / np.float32(np.sqrt(SKETCH))
    out = np.empty((n, directions.shape[1]), np.float32)

    def project(start: int) -> None:
        rows = np.arange(start, min(start + BLOCK, n))
        out[rows] = setup.gather_rows(rows, sources, ORDER).reshape(len(rows), -1) @ directions

    for_each(project, range(0, n, BLOCK), setup.threads)
    return out
