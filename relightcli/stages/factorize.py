"""Stage factorize: a clusters store in, a self-contained asset out. [Sun 2007, sec. 3.4]

Per cluster the one-bounce tensor (receivers x light x the rest) is compressed along receivers and light by clustered
tensor approximation, a Tucker-2 decomposition; the two-bounce tensor by a principal component analysis along receivers.
Everything is quantised; every cluster records what compression and quantisation leave out.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli import __version__
from relightcli.adapters.files import need_output
from relightcli.core.compress.tucker import sequential_hosvd
from relightcli.core.parts import in_order, one_blas_thread
from relightcli.core.transport.direct_tensor import KEEP
from relightcli.core.transport.transfer import Sources, light_fit
from relightcli.errors import InputError, StoreError
from relightcli.run.accounting import Account, Meter
from relightcli.stages.budget import summary
from relightcli.stages.choose_ranks import Ranks, coefficients_for, keep_asset_promise, tensor_ranks
from relightcli.stages.copying import copy_arrays
from relightcli.stages.direct_tensors import put_direct
from relightcli.stages.left_over import LeftOver, left_over
from relightcli.stages.lighting import LightingStore
from relightcli.stages.part_cost import Costs, copying, scratch, stored_bytes
from relightcli.stages.tensor_cost import (
    PilotSetup,
    names_but,
    predict_asset_check,
    predict_bounce,
    predict_direct,
)
from relightcli.stages.transfer_setup import COARSE, TransferSetup, coarse_cells, fit_receivers

KIND = "asset"
DEFAULT = Ranks(32, 64, KEEP)
# What rounding may add to the one-bounce core, relative RMS: no step is finer than makes that of all its values.
CORE_ROUNDING = 0.005
LEFT_OUT = ("bounce/hit", "light/basis", "cluster/label")  # of the clusters store's arrays


@dataclass(frozen=True)
class Config:
    """Everything that `factorize` needs to know. second_order: bands of the second bounce, 0 for its mean; tolerance:
    relative RMS of all light, None for the store's, if it has one. eigenvectors, light_rank, coefficients None: what
    the tolerance takes, else DEFAULT."""

    store: Path
    output: Path
    eigenvectors: int | None = None
    light_rank: int | None = None
    second_order: int = 0
    coefficients: int | None = None
    tolerance: float | None = None
    allow_miss: bool = False
    brdf_ranks: tuple[int, int, int] | None = None
    workers: int = 1
    overwrite: bool = False
    dry_run: bool = False
    quiet: bool = False


@one_blas_thread()
def factorize(config: Config) -> dict[str, Any]:
    """Runs the stage; returns a summary. Raises InputError, StoreError, NumericalError, OSError."""
    started, account = time.perf_counter(), Account()
    for name, value in (("--eigenvectors", config.eigenvectors), ("--light-rank", config.light_rank)):
        if value is not None and value < 1:
            raise InputError(f"{name}: expected at least 1; found {value}")
    if config.tolerance is not None and not 0.0 < config.tolerance < 1.0:
        raise InputError(f"--tolerance: expected more than 0 and less than 1; found {config.tolerance}")
    need_output(config.output, store=True)
    with account.step("reading"):
        lighting = LightingStore(config.store, config.workers)
    store = lighting.store
    if store.kind != "clusters":
        raise StoreError(f"{config.store}: expected a store of kind clusters, found {store.kind}; run cluster first.")
    bounces = min(2, lighting.bounces)
    settings = {
        **store.settings,
        "bounces": bounces,
        "second_order": config.second_order,
    }
    left = left_over(store, config.tolerance)
    for name in ("eigenvectors", "light_rank", "coefficients"):
        asked = getattr(config, name)
        if left is None or asked is not None:
            settings[name] = asked or getattr(DEFAULT, name)
    if left is not None:
        settings["asset_tolerance"] = left.tolerance
    read: Any = store.read
    label: NDArray[np.int32] = read("cluster/label")
    clusters = int(label.max()) + 1
    if config.dry_run:
        told = {"dry_run": True, "receivers": len(lighting), "clusters": clusters, "notes": []}
        return {**told, "predicted": _predict(config, lighting, left, label, bounces).as_json(account)}
    if config.brdf_ranks is not None:
        settings["brdf_ranks"] = list(config.brdf_ranks)
    writer = formats.begin(
        config.output,
        KIND,
        settings=settings,
        inputs={"clusters": store.fingerprint},
        program=f"relightcli {__version__}",
        overwrite=config.overwrite,
    )
    notes = []
    if lighting.bounces > bounces:
        notes.append(f"the asset has 2 interreflections of the store's {lighting.bounces}")
    if writer is None:
        return {"store": str(config.output), "status": "up to date", "notes": notes}
    with writer:
        resumed = bool(writer.done)
        writer.set_attrs(store.attrs)
        with account.step("copying"):
            copy_arrays(store, writer, names_but(store, LEFT_OUT))
        with account.step("reading"):
            setup = TransferSetup(lighting, int(store.settings["functions"]), config.workers, writer.partial_path)
        order, start = _by_cluster(label)
        writer.put("cluster/receiver", order.astype(np.int32), dims=("receiver",))
        writer.put("cluster/start", start, dims=("boundary",))
        basis: NDArray[np.float32] = read("light/basis")
        writer.put("one_bounce/basis", basis, dims=("light_cell", "light"))
        bands = int(store.settings["order"])
        with account.step("ranks"):
            ranks = _ranks(config, left, writer, setup, basis, order, start, bands if bounces else 0)
        with account.step("direct"):
            put_direct(writer, lighting, ranks.coefficients, config.workers, config.brdf_ranks)
        if bounces:
            with account.step("one-bounce"):
                _one_bounce(ranks, writer, setup, basis, order, start, bands)
        if bounces > 1:
            with account.step("two-bounce"):
                _two_bounces(ranks.eigenvectors, config.second_order, writer, setup, order, start, bands)
        if left is not None:
            with account.step("check"):
                keep_asset_promise(writer, left.tolerance, lighting.bounces, config.workers, config.allow_miss)
        writer.commit(summary(account, started, resumed, config.workers, store))
    return _summary(config, started, resumed, notes)


def _by_cluster(label: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Receivers by cluster, and where each begins, (clusters + 1,)."""
    counts = np.bincount(label, minlength=int(label.max()) + 1)
    return np.argsort(label, kind="stable"), np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def _predict(
    config: Config, lighting: LightingStore, left: LeftOver | None, label: NDArray[np.int32], bounces: int
) -> Costs:
    """What the stage will take, but for opening the store."""
    store, out = lighting.store, Costs()
    read: Any = store.read
    order, start = _by_cluster(label)
    basis: NDArray[np.float32] = read("light/basis")
    bands = int(store.settings["order"])
    with scratch(KIND, store.settings, {}) as writer:
        out.add(copying(store, names_but(store, LEFT_OUT), writer))
        writer.put("cluster/receiver", order.astype(np.int32), dims=("receiver",))
        writer.put("one_bounce/basis", basis, dims=("light_cell", "light"))
        out.bytes += stored_bytes(writer, "cluster") + stored_bytes(writer, "one_bounce")
        with out.timed():
            setup = PilotSetup(lighting, int(store.settings["functions"]), config.workers, writer.partial_path)
            ranks = _ranks(config, left, writer, setup, basis, order, start, bands if bounces else 0)
    out.add(predict_direct(lighting, ranks.coefficients, config.brdf_ranks))

    def first(writer: formats.Writer, order: NDArray[np.int64], start: NDArray[np.int64]) -> None:
        _one_bounce(ranks, writer, setup, basis, order, start, bands)

    def second(writer: formats.Writer, order: NDArray[np.int64], start: NDArray[np.int64]) -> None:
        _two_bounces(ranks.eigenvectors, config.second_order, writer, setup, order, start, bands)

    if bounces:
        out.add(predict_bounce(lighting, "one_bounce", first, order, start))
    if bounces > 1:
        out.add(predict_bounce(lighting, "two_bounce", second, order, start))
    out.add(setup.more)
    if left is not None:
        out.add(predict_asset_check(lighting, max(lighting.bounces, bounces)))
    return out


def _ranks(
    config: Config,
    left: LeftOver | None,
    writer: formats.Writer,
    setup: TransferSetup,
    basis: NDArray[np.float32],
    order: NDArray[np.int64],
    start: NDArray[np.int64],
    bands: int,
) -> Ranks:
    """What was asked for, was chosen before an interruption, or is chosen now. bands 0: no interreflections."""
    asked = (config.eigenvectors, config.light_rank, config.coefficients)
    given = Ranks(*(value or least for value, least in zip(asked, astuple(DEFAULT), strict=True)))
    if left is None:
        return given
    if "ranks" in writer.attrs:
        return Ranks(**writer.attrs["ranks"])
    if config.coefficients is None:
        given = replace(given, coefficients=coefficients_for(setup.lighting, left))
    if bands and (config.eigenvectors is None or config.light_rank is None):
        along, light = tensor_ranks(setup, setup.sources(basis), order, start, bands, left)
        given = replace(given, eigenvectors=config.eigenvectors or along, light_rank=config.light_rank or light)
    writer.set_attrs({"ranks": given.as_json()})
    return given


def _one_bounce(
    ranks: Ranks,
    writer: formats.Writer,
    setup: TransferSetup,
    basis: NDArray[np.float32],
    order: NDArray[np.int64],
    start: NDArray[np.int64],
    bands: int,
) -> None:
    clusters, most = len(start) - 1, int(np.diff(start).max())
    lights = basis.shape[1] + setup.lamps
    rank_v, rank_l = min(ranks.eigenvectors, most), min(ranks.light_rank, lights)
    rest = setup.count * bands * bands
    outputs = _Outputs(
        writer,
        "one_bounce",
        {
            "receiver_factor": ((most, rank_v), ("place", "eigenvector"), (1,)),
            "light_factor": ((lights, rank_l), ("lamp_or_light", "light_eigenvector"), (0,)),
            "core": ((rank_l, rank_v, rest), ("light_eigenvector", "eigenvector", "channel_and_harmonic"), (2,)),
        },
        clusters,
        {"core": "int8", "receiver_factor": "int8"},
        {"core": CORE_ROUNDING},
    )
    todo = [c for c in range(clusters) if f"one-bounce/{c}" not in writer.done]
    if not todo:
        return
    sources = setup.sources(basis)
    _put_fit(writer, "one_bounce", setup, sources)

    def compress(c: int) -> dict[str, float]:
        rows = order[start[c] : start[c + 1]]
        tensor = setup.gather_rows(rows, sources, bands).reshape(len(rows), rest, lights)
        found = sequential_hosvd(tensor, (rank_v, None, rank_l))
        u_v, _, u_l = found.factors
        assert u_v is not None
        assert u_l is not None
        core = np.transpose(found.core, (2, 0, 1))
        kept = outputs.put(c, {"receiver_factor": u_v, "light_factor": u_l, "core": core})
        back = np.einsum("lvq,nv->nlq", kept["core"], kept["receiver_factor"][: len(rows)], optimize=True)
        back = np.einsum("ml,nlq->nqm", kept["light_factor"], back, optimize=True)
        error2 = float(((tensor - back).astype(np.float64) ** 2).sum())
        return {"receivers": len(rows), "norm2": found.norm2, "compression2": found.error2, "error2": error2}

    _record(writer, "one-bounce", compress, todo, setup.threads)


def _put_fit(writer: formats.Writer, group: str, setup: TransferSetup, sources: Sources) -> None:
    """How light is matched by what it does at some receivers."""
    some = fit_receivers(len(setup.lighting))
    fit, keep = light_fit(sources.even[some, : sources.even.shape[1] - setup.lamps])
    writer.put(f"{group}/fit", fit, dims=(f"{group}_light", "fit_receiver"))
    writer.put(f"{group}/keep", keep, dims=(f"{group}_light", f"{group}_old_light"))


def _two_bounces(
    eigenvectors: int,
    second_order: int,
    writer: formats.Writer,
    setup: TransferSetup,
    order: NDArray[np.int64],
    start: NDArray[np.int64],
    bands: int,
) -> None:
    clusters, most = len(start) - 1, int(np.diff(start).max())
    rank = min(eigenvectors, most)
    coarse = 6 * COARSE * COARSE + setup.lamps
    harmonics = max(1, second_order**2)
    size = setup.count * harmonics * coarse * setup.count
    outputs = _Outputs(
        writer,
        "two_bounce",
        {
            "receiver_factor": ((most, rank), ("place", "eigenvector"), (1,)),
            "core": ((rank, size), ("eigenvector", "channels_harmonic_light"), (1,)),
        },
        clusters,
        {},
        {},
    )
    todo = [c for c in range(clusters) if f"two-bounce/{c}" not in writer.done]
    if not todo:
        return
    lights = setup.sources(coarse_cells())
    _put_fit(writer, "two_bounce", setup, lights)
    sources = setup.second_sources(lights, bands)

    def compress(c: int) -> dict[str, float]:
        rows = order[start[c] : start[c + 1]]
        tensor = setup.gather_rows(rows, sources, second_order).reshape(len(rows), size, 1)
        found = sequential_hosvd(tensor, (rank, None, None))
        u_v = found.factors[0]
        assert u_v is not None
        kept = outputs.put(c, {"receiver_factor": u_v, "core": found.core[:, :, 0]})
        back = kept["receiver_factor"][: len(rows)] @ kept["core"]
        error2 = float(((tensor[:, :, 0] - back).astype(np.float64) ** 2).sum())
        return {"receivers": len(rows), "norm2": found.norm2, "compression2": found.error2, "error2": error2}

    _record(writer, "two-bounce", compress, todo, setup.threads)


def _record(
    writer: formats.Writer, name: str, compress: Callable[[int], dict[str, float]], clusters: list[int], threads: int
) -> None:
    """Compresses clusters, several at a time. A cluster's costs are all that was spent since the one before it."""
    meter = Meter()
    with closing(in_order(compress, clusters, threads)) as results:
        for c, found in zip(clusters, results, strict=True):
            writer.record(f"{name}/{c}", {**meter.read(), **found})
            meter = Meter()


class _Outputs:
    """Quantised factors, one chunk per cluster; ranks that a cluster does not have are zero.

    codes: types, int16 where none is given; rounding: relative RMS that rounding may add, as little as the type lets if
    none is given.
    """

    def __init__(
        self,
        writer: formats.Writer,
        group: str,
        arrays: dict[str, tuple[tuple[int, ...], tuple[str, ...], tuple[int, ...]]],
        clusters: int,
        codes: dict[str, str],
        rounding: dict[str, float],
    ) -> None:
        self.shapes, self.axes, self.codes, self.rounding = {}, {}, {}, rounding
        self.values: dict[str, Any] = {}
        self.scales: dict[str, Any] = {}
        for name, (shape, dims, axes) in arrays.items():
            self.codes[name] = codes.get(name, "int16")
            self.shapes[name], self.axes[name] = shape, axes
            self.values[name] = writer.array(
                f"{group}/{name}",
                shape=(clusters, *shape),
                dtype=self.codes[name],
                chunks=(1, *shape),
                dims=("cluster", *dims),
                attrs={"scale": f"{group}/{name}_scale"},
                codec="zstd",
            )
            scale_shape = tuple(1 if k in axes else n for k, n in enumerate(shape))
            self.scales[name] = writer.array(
                f"{group}/{name}_scale",
                shape=(clusters, *scale_shape),
                dtype="float32",
                chunks=(1, *scale_shape),
                dims=("cluster", *(f"one_{d}" if k in axes else d for k, d in enumerate(dims))),
                codec="zstd",
            )

    def put(self, cluster: int, found: dict[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float32]]:
        """Writes a cluster's factors; returns them as they will be read."""
        out = {}
        for name, values in found.items():
            padded = np.zeros(self.shapes[name])
            padded[tuple(slice(0, n) for n in values.shape)] = values
            # A step s makes a relative RMS of s sqrt(number / 12) / norm.
            least = self.rounding.get(name, 0.0) * float(np.sqrt(12.0 * (values**2).mean()))
            codes, scale = formats.quantise(padded, self.codes[name], axis=self.axes[name], least=least)  # type: ignore[arg-type]
            self.values[name][cluster] = codes
            self.scales[name][cluster] = scale
            out[name] = formats.dequantise(codes, scale)
        return out


def _summary(config: Config, started: float, resumed: bool, notes: list[str]) -> dict[str, Any]:
    store = formats.open_store(config.output, KIND)
    errors = {}
    for effect in ("one-bounce", "two-bounce"):
        blocks = [b for b in store.blocks if b["id"].startswith(effect)]
        norm2 = sum(b["norm2"] for b in blocks)
        if norm2 > 0.0:
            worst = max((b["error2"] / b["norm2"] for b in blocks if b["norm2"] > 0.0), default=0.0)
            errors[effect.replace("-", "_")] = {
                "compression": (sum(b["compression2"] for b in blocks) / norm2) ** 0.5,
                "total": (sum(b["error2"] for b in blocks) / norm2) ** 0.5,
                "worst_cluster": worst**0.5,
            }
    return {
        "store": str(config.output),
        "status": "resumed" if resumed else "written",
        "receivers": int(store.layouts["cluster/receiver"].shape[0]),
        "errors": errors,
        "bytes": sum(size.stored for size in store.sizes().values()),
        "seconds": time.perf_counter() - started,
        "notes": notes,
    }
