"""What cluster and factorize will take, predicted by their dry runs from a part of their work."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.core.compress.cpca import cpca
from relightcli.core.compress.groups import TERMS, TOGETHER
from relightcli.core.compress.tucker import gram_spectrum
from relightcli.core.transport.transfer import Sources
from relightcli.stages.check_cost import predict_check
from relightcli.stages.direct_tensors import put_direct
from relightcli.stages.lighting import LightingStore
from relightcli.stages.part_cost import Costs, copying, grown, scratch, stored_bytes
from relightcli.stages.transfer_setup import BLOCK, CELLS, TransferSetup

FEW, SOME = 16, 64  # receivers whose tensors are gathered
GROUPED = 1024  # receivers that are put in groups
DIRECT = (16, 256)  # receivers whose direct light is compressed
SMALL = 5_000  # receivers of a store all of whose light is looked at
FEW_CLUSTERS = 4  # that receivers are put in
LARGER = 3  # clusters that are compressed


def predict_cluster(
    lighting: LightingStore,
    clusters: int,
    tolerance: float,
    functions: int,
    seed: int,
    sample: int,
    order: int,
    sketch: int,
) -> Costs:
    """Costs of cluster, but for opening the store. sample, order, sketch: as `stages.cluster` has them."""
    store, n, cells = lighting.store, len(lighting), 6 * CELLS * CELLS
    out = Costs()
    with scratch("clusters", store.settings, store.attrs) as writer:
        out.add(copying(store, store.names(), writer))
        with out.timed():
            setup = TransferSetup(lighting, functions, lighting.threads, writer.partial_path)
        eye = np.eye(cells, dtype=np.float32)
        # What a basis weighs matters in small stores, where all faces of the sky cost little.
        faces = range(6) if n <= SMALL else range(1)
        picked = np.random.default_rng(seed).permutation(n)
        some, parts = picked[: min(SOME, sample)], []
        with out.timed():
            sources = setup.sources(eye[:, : CELLS**2])  # loads kernels as well
            setup.gather_rows(picked[:FEW], sources, order)
        # Six faces of some for the basis, and six of all for the groups, of which one is done.
        share = len(setup.seen_from(picked[:sample])) / n
        for face in faces:
            with out.timed((5.0 + 6.0 * share) / len(faces)):
                sources = setup.sources(eye[:, face * CELLS**2 : (face + 1) * CELLS**2])
            with out.timed(6.0 / len(faces) * min(n, sample) / len(some)):
                parts.append(setup.gather_rows(some, sources, order)[..., : CELLS**2].reshape(-1, CELLS**2))
        whole = np.concatenate(parts * (6 // len(faces)), axis=1)
        with out.timed(min(n, sample) / len(some)):
            gram = whole.astype(np.float64).T @ whole.astype(np.float64)
        with out.timed():
            values = gram_spectrum(gram)[0]
        left = np.sqrt(np.maximum(0.0, 1.0 - np.cumsum(values) / max(values.sum(), 1e-300)))
        rank = 6 // len(faces) * (int(np.argmax(left <= tolerance)) + 1)
        out.bytes += 4 * cells * min(cells, rank)
        grouped = picked[: min(n, GROUPED)]
        coarse = _first_lights(sources, 24 + setup.lamps)
        with out.timed(n / len(grouped)):
            rows = [setup.gather_rows(grouped[a : a + BLOCK], coarse, order) for a in range(0, len(grouped), BLOCK)]
            tensors = np.concatenate(rows).reshape(len(grouped), -1)
            directions = np.random.default_rng(seed).standard_normal((tensors.shape[1], min(sketch, tensors.shape[1])))
            drawn = tensors @ directions.astype(np.float32)
        clusters = min(clusters, max(1, round(clusters * TOGETHER / n)))  # that a receiver is compared with
        own = min(clusters, FEW_CLUSTERS)

        def group(count: int) -> Costs:
            cost = Costs()
            with cost.timed():
                label = cpca(drawn[:count], own, TERMS, seed).label
            writer.put("cluster/label", label, dims=("receiver",))
            cost.bytes = stored_bytes(writer, "cluster")
            writer.drop("cluster/label")
            return cost

        grouping = grown(group, (len(drawn) // 2, len(drawn)), n)
        out.add(Costs(grouping.seconds, grouping.cpu_seconds), clusters / own)
        out.bytes += grouping.bytes
    return out


def _first_lights(sources: Sources, count: int) -> Sources:
    return sources._replace(
        even=np.ascontiguousarray(sources.even[:, :count]), factor=np.ascontiguousarray(sources.factor[:, :, :count])
    )


class PilotSetup(TransferSetup):
    """Sources are made once for all that asks for them; those of second bounces from some receivers, as if the others
    were like them. `more`: what the others would take."""

    def __init__(self, lighting: LightingStore, functions: int, threads: int, folder: Path | None = None) -> None:
        super().__init__(lighting, functions, threads, folder)
        self.known: dict[tuple[str, int], Sources] = {}
        self.more = Costs()

    def sources(self, basis: NDArray[np.float32], only: NDArray[np.int64] | None = None) -> Sources:
        assert only is None  # nothing that is predicted asks for some
        key = "first", basis.shape[1]
        if key not in self.known:
            self.known[key] = super().sources(basis)
        return self.known[key]

    def second_sources(self, lights: Sources, order: int, only: NDArray[np.int64] | None = None) -> Sources:
        key = "second", order
        if key not in self.known:
            n = len(self.lighting)
            some = np.unique(np.linspace(0, n - 1, min(n, SOME)).astype(np.int64))
            super().second_sources(lights, order, some[:2])  # loads kernels
            with self.more.timed(n / len(some) - 1.0):
                found = super().second_sources(lights, order, some)
            like = some[np.clip(np.searchsorted(some, np.arange(n)), 0, len(some) - 1)]
            shiny = np.flatnonzero(self.row >= 0)
            stand_in = some[self.row[some] >= 0]
            factor = found.factor
            if len(stand_in):
                place = stand_in[np.clip(np.searchsorted(stand_in, shiny), 0, len(stand_in) - 1)]
                factor = found.factor[self.row[place]]
            self.known[key] = found._replace(even=found.even[like], factor=factor)
        return self.known[key]


@dataclass(frozen=True)
class _Thinned:
    """Some receivers of a store, as far as `put_direct` looks at them."""

    lighting: LightingStore
    rows: NDArray[np.int64]

    def __getattr__(self, name: str) -> Any:
        value = getattr(self.lighting, name)
        return value[self.rows] if name in ("object", "normal") else value

    def bits_of(self, receivers: NDArray[np.int64]) -> NDArray[np.uint8]:
        return self.lighting.bits_of(self.rows[receivers])


def predict_direct(lighting: LightingStore, coefficients: int, ranks: tuple[int, int, int] | None) -> Costs:
    """Costs of an asset's direct light."""
    n = len(lighting)

    def part(count: int) -> Costs:
        rows = np.unique(np.linspace(0, n - 1, count).astype(np.int64))
        out = Costs()
        with scratch("asset", lighting.store.settings, {}) as writer:
            with out.timed():
                put_direct(
                    writer, cast("LightingStore", _Thinned(lighting, rows)), coefficients, lighting.threads, ranks
                )
            out.bytes = stored_bytes(writer, "direct")
        return out

    few, some = (min(n, count) for count in DIRECT)
    return grown(part, (few, some), n)


def predict_bounce(
    lighting: LightingStore, group: str, compress: Any, order: NDArray[np.int64], start: NDArray[np.int64]
) -> Costs:
    """Costs of compressing all clusters. compress(writer, order, start): does so with those clusters, into `group`."""
    sizes = np.diff(start)
    # About the middle, by size: what they take goes with it.
    chosen = np.argsort(sizes, kind="stable")[max(0, len(sizes) // 2 - 1) :][:LARGER]

    def part(receivers: int) -> Costs:
        own = chosen[: np.searchsorted(np.cumsum(sizes[chosen]), receivers) + 1]
        rows = np.concatenate([order[start[c] : start[c + 1]] for c in own])
        out = Costs()
        with scratch("asset", lighting.store.settings, {}) as writer:
            with out.timed():
                compress(writer, rows, np.concatenate([[0], np.cumsum(sizes[own])]).astype(np.int64))
            out.bytes = stored_bytes(writer, group)
        return out

    totals = np.cumsum(sizes[chosen])
    return grown(part, (int(totals[0]), int(totals[-1])), int(sizes.sum()))


def predict_asset_check(lighting: LightingStore, bounces: int) -> Costs:
    """Costs of path tracing for the check of an asset; its own light is a small part."""
    found = predict_check(None, lighting.scene, lighting.geometry, bounces, (), None)
    return Costs(found["seconds"], found["cpu_seconds"])


def names_but(store: formats.Store, left_out: tuple[str, ...]) -> list[str]:
    """Arrays of a store without some."""
    return [name for name in store.names() if name not in left_out]
