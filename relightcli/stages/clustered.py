"""Direct light from clusters of the sky: any map of any resolution, and only what changed from one map to the next.

the map             small bright places become points, for which rays are traced; the rest is shared out over leaves
a new map           moments of the leaves that changed, and what they change in the irradiance [Johan and Nishita,
                    Eq. 15, with C_t for the printed C_i]
specular lobes      as baked in for one view; their colour may change. Without a fixed view: integrated from the
                    visibility bits of the transfer store, for every view and every lobe
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.brdf.models import SPECULAR, MaterialTable, widen
from relightcli.core.lights.environment import latlong_to_cube
from relightcli.core.lights.leaf_light import LeafLight, Splitter
from relightcli.core.lights.points import Points, split_points
from relightcli.core.lights.quadtree import Tree, build_tree, first_leaves, leaves_at, solid_angles
from relightcli.core.shade.cluster_sum import Fractions, Lobes
from relightcli.core.shade.seen_points import point_irradiance, point_lobes
from relightcli.errors import InputError, StoreError
from relightcli.scene.model import Material
from relightcli.stages.light_cluster_job import DIFFUSE, LOBE
from relightcli.stages.lighting import LightingStore, Radiance, _Coats

PARTLY = 0.25  # of the clusters: if more have changed, all are summed again
MANY = 64  # cells that are not summed one by one
KEPT = 256  # points whose visibility is kept


class ClusteredStore(LightingStore):
    """An open store of clustered lights."""

    def __init__(self, store: Path | formats.Store, threads: int) -> None:
        super().__init__(store, threads)
        self._sky: _ClusteredSky | None = None
        self._lobes: _BakedLobes | None = None
        self._colour: tuple[_Coats, NDArray[np.float32]] | None = None

    def exit_radiance(
        self,
        environment: NDArray[np.float32],
        rotate: float,
        materials: dict[str, Material],
        view: NDArray[np.float32] | None,
        active: NDArray[np.bool_] | None = None,
        basis: str | None = None,
        bounces: int | None = None,
    ) -> list[Radiance]:
        """See `LightingStore.exit_radiance`. Raises InputError for a basis, and for lobes that are not baked in."""
        if basis is not None:
            raise InputError("--basis: the store holds clustered lights; use the transfer store it came from")
        return super().exit_radiance(environment, rotate, materials, view, active, None, bounces)

    @property
    def changed(self) -> int | None:
        sky = self.sky
        return len(sky.tree.cell) if sky.changed is None else sky.changed

    def resume(self, previous: Path) -> list[str]:
        self.sky.resume(self._earlier(previous))
        return []

    def put_light(self, writer: formats.Writer) -> None:
        light = self.sky.light
        assert light is not None
        writer.put("light/flux", light.flux, dims=("cluster", "colour"), units="W sr-1 m-2 sr")
        writer.put("light/moment", light.moment, dims=("cluster", "colour", "axis"), units="W m-2")
        writer.put("light/irradiance", self.sky.irradiance, dims=("receiver", "colour"), units="W m-2")

    @property
    def sky(self) -> _ClusteredSky:
        if self._sky is None:
            self._sky = _ClusteredSky(self)
        return self._sky

    def _direct(
        self,
        environment: NDArray[np.float32],
        rotate: float,
        coats: _Coats,
        view: NDArray[np.float32] | None,
        looked_at: NDArray[np.bool_] | None,
        active: NDArray[np.bool_] | None,
        basis: str,
    ) -> Radiance:
        sky = self.sky
        shines = bool(coats.shiny.any()) and view is not None
        baked = "light_clusters/lobe" in self.store or "visibility/bits" not in self.store
        if shines and baked and self._lobes is None:
            self._lobes = _BakedLobes(self, sky.tree)
        sky.set_light(environment, rotate)
        e = sky.lit()
        lamp_e, lamps = self._lamps(coats, view, active)
        if lamp_e is not None:
            e += lamp_e
        diffuse = coats.diffuse(e)
        if not shines or view is None:
            return Radiance(diffuse, None)
        if self._colour is None or self._colour[0] is not coats:
            self._colour = (
                coats,
                coats.table.parameters[:, SPECULAR : SPECULAR + 3].astype(np.float32)[coats.material],
            )
        colour = self._colour[1]
        if self._lobes is None:
            rows = np.flatnonzero(coats.shiny if looked_at is None else coats.shiny & looked_at)
            cells = latlong_to_cube(environment, self.resolution, rotate)
            specular = self._exact_specular(cells, environment, rotate, coats, view, rows)
        else:
            specular = self._lobes.shine(sky, coats, view) * colour
        if lamps is not None:
            specular += lamps * colour
        return Radiance(diffuse, specular)


class Runs:
    """Cells (m, 5) that are runs of a tree's leaves, both in the order of the trees.

    first (m,): the first leaf of each; of (l,): the cell that holds a leaf.
    """

    def __init__(self, tree: Tree, cells: NDArray[np.int32]) -> None:
        self.first = first_leaves(tree, cells)
        self.of = np.repeat(np.arange(len(cells)), np.diff(self.first, append=len(tree.cell)))

    def sum(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """(m, ...) of values (l, ...)."""
        return values if len(self.first) == len(values) else np.add.reduceat(values, self.first)

    def sums(self, values: NDArray[np.float64], cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """Of some cells."""
        if len(cells) == 0:
            return values[:0]
        if len(cells) > MANY:
            return self.sum(values)[cells]
        last = np.append(self.first, len(values))
        return np.stack([values[last[k] : last[k + 1]].sum(axis=0) for k in cells])


class _ClusteredSky:
    """The map in clusters, and its points.

    changed: clusters whose light the last `set_light` changed, None where all were summed.
    """

    def __init__(self, lighting: ClusteredStore) -> None:
        self.lighting = lighting
        read: Any = lighting.store.read
        cells = read("light_clusters/cell")
        self.tree: Tree = build_tree(
            [tuple(c) for c in cells.tolist()], int(lighting.store.settings["cluster_resolution"])
        )
        array: Any = lighting.store.array("light_clusters/fraction")
        step = array.chunks[1]
        columns = (np.asarray(array[:, a : a + step]) for a in range(0, array.shape[1], step))
        own = read(f"light_clusters/{DIFFUSE}")
        radius = 0.5 * np.sqrt(solid_angles(own, self.tree.resolution))
        self.fractions = Fractions(columns, lighting.normal, radius)
        self.runs = Runs(self.tree, own)
        self.light: LeafLight | None = None
        self._groups: NDArray[np.float64] = np.zeros((0, 3, 64))
        self.points = Points(np.zeros((0, 3)), np.zeros((0, 3)))
        self.changed: int | None = None
        self._given: tuple[NDArray[np.float32], float] | None = None
        self._rest: NDArray[np.float32] | None = None
        self._splitter: tuple[tuple[int, int, float], Splitter] | None = None
        self._tracer: Tracer | None = None
        self._seen: dict[bytes, NDArray[np.bool_]] = {}

    def resume(self, previous: formats.Store) -> None:
        """Takes up the light of a radiance store that was made from the same clusters."""
        if "light/moment" not in previous:
            raise StoreError(f"{previous.path}: keeps no light of clusters, as --from needs it")
        read: Any = previous.read
        self.light = LeafLight(read("light/flux"), read("light/moment"))
        self._groups = self.fractions.by_group(read("light/irradiance"))

    def set_light(self, environment: NDArray[np.float32], rotate: float) -> None:
        if self._given is not None and self._given[0] is environment and self._given[1] == rotate:
            self.changed = 0
            return
        rest, self.points, _ = split_points(environment, rotate)
        splitter = self._splitter_of(rest.shape[0], rest.shape[1], rotate)
        threads, old = self.lighting.threads, self.light
        if self._rest is not None and self._given is not None and self._given[1] == rotate and old is not None:
            rows = changed_rows(self._rest, rest) if self._rest.shape == rest.shape else None
        else:
            rows = None
        if rows is not None and old is not None and self._rest is not None:
            gone, come = (splitter.light(m, threads, rows) for m in (self._rest, rest))
            new = LeafLight(old.flux + (come.flux - gone.flux), old.moment + (come.moment - gone.moment))
        else:
            new = splitter.light(rest, threads)
        self._given, self._rest = (environment, rotate), rest
        if old is not None:
            changed = np.flatnonzero((new.moment != old.moment).any(axis=(1, 2)))
            if len(changed) <= PARTLY * len(new.moment):
                runs = np.unique(self.runs.of[changed])
                before, after = (LeafLight(*(self.runs.sums(v, runs) for v in light)) for light in (old, new))
                self.fractions.change(self._groups, runs, before, after, threads)
                self.light, self.changed = new, len(changed)
                return
        self._groups = self.fractions.sum(LeafLight(*map(self.runs.sum, new)), threads)
        self.light, self.changed = new, None

    @property
    def irradiance(self) -> NDArray[np.float64]:
        """Irradiance (N, 3) of all but the points."""
        return self.fractions.by_receiver(self._groups)

    def _splitter_of(self, height: int, width: int, rotate: float) -> Splitter:
        """Kept for maps of the same size, turned alike."""
        key = (height, width, rotate)
        if self._splitter is None or self._splitter[0] != key:
            self._splitter = (key, Splitter(self.tree, *key))
        return self._splitter[1]

    def lit(self) -> NDArray[np.float32]:
        """Irradiance (N, 3) of all."""
        return self.fractions.rounded(self._groups, self.of_points() if len(self.points.flux) else None)

    def of_points(self) -> NDArray[np.float64]:
        """Irradiance (N, 3) of the points."""
        return point_irradiance(self.seen(), self.points, self.lighting.normal, self.lighting.threads)

    def seen(self) -> NDArray[np.bool_]:
        """Who sees the points, (K, N)."""
        found = np.zeros((len(self.points.direction), len(self.lighting)), bool)
        for row, direction in zip(found, self.points.direction, strict=True):
            row[:] = self.sees(direction)
        return found

    def sees(self, direction: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Receivers that see a direction, (N,): rays where its cluster is seen in part."""
        key = direction.tobytes()
        if key not in self._seen:
            fraction = self.fractions.of(int(self.runs.of[leaves_at(self.tree, direction[None])[0]]))
            seen = fraction == 255
            light = direction.astype(np.float32)
            doubtful = np.flatnonzero((fraction > 0) & ~seen)
            doubtful = doubtful[self.lighting.normal[doubtful] @ light > 0.0]
            if "shadows" not in self.lighting.store.settings["effects"]:
                seen[doubtful] = True
            elif len(doubtful):
                if self._tracer is None:
                    self._tracer = Tracer(self.lighting.geometry.positions, self.lighting.geometry.faces)
                tracer = self._tracer
                origins = tracer.offset(self.lighting.position[doubtful], self.lighting.normal[doubtful])
                seen[doubtful] = ~tracer.occluded(origins, np.tile(light, (len(doubtful), 1)))
            self._seen[key] = seen
            while len(self._seen) > KEPT:
                del self._seen[next(iter(self._seen))]
        return self._seen[key]


class _BakedLobes:
    """Specular light of the view that the clusters were made for, without the specular colours."""

    def __init__(self, lighting: ClusteredStore, tree: Tree) -> None:
        self.lighting = lighting
        store = lighting.store
        if "light_clusters/lobe" not in store:
            raise InputError(
                f"{store.path}: made without a fixed view, so it has no specular lobes; cluster again with --camera"
            )
        read: Any = store.read
        self.rows: NDArray[np.int64] = read("light_clusters/lobed").astype(np.int64)
        self.view: NDArray[np.float32] = read("light_clusters/view")
        self.table = MaterialTable(read("light_clusters/model"), read("light_clusters/parameters"))
        self.lobes = Lobes(read("light_clusters/lobe"), read("light_clusters/lobe_scale"))
        self._good: tuple[_Coats, NDArray[np.float32]] | None = None  # what has been checked
        self.runs = Runs(tree, read(f"light_clusters/{LOBE}"))
        self._of: LeafLight | None = None
        self._flux: NDArray[np.float64] | None = None
        self._even = self.lobes.dark()

    def _check(self, coats: _Coats, view: NDArray[np.float32]) -> None:
        lighting = self.lighting
        if not np.allclose(view[self.rows], self.view[self.rows], atol=1e-4):
            raise InputError(
                f"{lighting.store.path}: its specular lobes are for camera {lighting.store.settings['camera']!r} only"
            )
        wide = widen(coats.table, 0.5 * np.pi / lighting.resolution)
        baked = np.zeros(len(lighting), bool)
        baked[self.rows] = True
        used = np.unique(coats.material[coats.shiny])
        same = (wide.model == self.table.model) & (
            np.delete(wide.parameters, np.s_[: SPECULAR + 3], axis=1)
            == np.delete(self.table.parameters, np.s_[: SPECULAR + 3], axis=1)
        ).all(axis=1)
        if not same[used].all() or not baked[coats.shiny].all():
            names = [list(lighting.scene.materials)[m] for m in used if not same[m]] or ["a material"]
            raise InputError(
                f"{', '.join(names)}: another specular lobe than the clusters were made for; its colours may change, "
                "for other changes use the transfer store it came from"
            )

    def shine(self, sky: _ClusteredSky, coats: _Coats, view: NDArray[np.float32]) -> NDArray[np.float32]:
        """(N, 3). Raises InputError for another view, or other lobes than were baked in."""
        lighting = self.lighting
        if self._good is None or self._good[0] is not coats or self._good[1] is not view:
            self._check(coats, view)
            self._good = (coats, view)
        assert sky.light is not None
        if self._of is not sky.light:
            flux = self.runs.sum(sky.light.flux)
            old = np.zeros_like(flux) if self._flux is None else self._flux
            changed = np.flatnonzero((flux != old).any(axis=1))
            if len(changed) > PARTLY * len(old):
                changed, old = np.arange(len(old)), np.zeros_like(old)
                self._even = self.lobes.dark()
            self.lobes.add(self._even, changed, flux[changed] - old[changed], lighting.threads)
            self._of, self._flux = sky.light, flux
        more = None
        if len(sky.points.flux):
            more = point_lobes(
                sky.seen(),
                sky.points,
                lighting.normal,
                self.view,
                self.rows,
                coats.material,
                self.table,
                lighting.threads,
            )
        return self.lobes.put(self._even, more, self.rows, len(lighting))


def changed_rows(old: NDArray[np.float32], new: NDArray[np.float32]) -> NDArray[np.int64]:
    """Per column of two maps (H, W, 3) the range of rows that differ, (W, 2), half open; empty where none do."""
    rows = np.zeros((old.shape[1], 2), np.int64)
    _changed_rows(np.ascontiguousarray(old), np.ascontiguousarray(new), rows)
    return rows


@njit(cache=True, nogil=True)
def _changed_rows(old, new, rows):  # type: ignore[no-untyped-def]
    for i in range(old.shape[0]):
        for j in range(old.shape[1]):
            if old[i, j, 0] != new[i, j, 0] or old[i, j, 1] != new[i, j, 1] or old[i, j, 2] != new[i, j, 2]:
                if rows[j, 1] == 0:
                    rows[j, 0] = i
                rows[j, 1] = i + 1
