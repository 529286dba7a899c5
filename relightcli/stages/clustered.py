"""Direct light from clusters of the sky: any map of any resolution, and only what changed from one map to the next.

the map             small bright places become points, for which rays are traced; the rest is shared out over leaves.
                    Cells that hold much of it are cut into smaller lights (`core.lights.bright_cells`)
a new map           moments of the leaves that changed, and what they change in the irradiance [Johan and Nishita,
                    Eq. 15, with C_t for the printed C_i]
specular lobes      as baked in for one view; their colour may change. Without a fixed view: from the light of the
                    factors of BRDFs, if the store is made for that (`light_factors`), else integrated from the
                    visibility bits of the transfer store, for every view and every lobe
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.brdf.models import SPECULAR, MaterialTable, widen
from relightcli.core.lights.bright_cells import bright_cells, cut
from relightcli.core.lights.environment import latlong_to_cube
from relightcli.core.lights.leaf_light import LeafLight, Splitter
from relightcli.core.lights.points import Points, Rows, both, row_light, split_points
from relightcli.core.lights.quadtree import Tree, build_tree, first_leaves, leaves_at, solid_angles
from relightcli.core.shade.cluster_sum import Fractions, Lobes
from relightcli.core.shade.seen_points import point_irradiance, point_lobes
from relightcli.errors import InputError, StoreError
from relightcli.scene.model import Material
from relightcli.stages.light_cluster_job import DIFFUSE, LOBE
from relightcli.stages.lighting import LightingStore, Radiance, _Coats

if TYPE_CHECKING:
    from relightcli.stages.light_factors import LightFactors

PARTLY = 0.25  # of the clusters: if more have changed, all are summed again
MANY = 64  # cells that are not summed one by one
KEPT = 64  # points whose visibility is kept at least
ROOM = 64 << 20  # bytes for such


class ClusteredStore(LightingStore):
    """An open store of clustered lights."""

    def __init__(self, store: Path | formats.Store, threads: int) -> None:
        super().__init__(store, threads)
        self._sky: ClusteredSky | None = None
        self._lobes: _BakedLobes | None = None
        self._factors: LightFactors | None = None
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
        if len(self.sky.bright):
            writer.put("light/bright", self.sky.bright, dims=("bright",))

    @property
    def sky(self) -> ClusteredSky:
        if self._sky is None:
            self._sky = ClusteredSky(self)
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
            specular = self._shine(environment, rotate, coats, view, looked_at)
        else:
            specular = self._lobes.shine(sky, coats, view, colour)
        if lamps is not None:
            specular += lamps * colour
        return Radiance(diffuse, specular)

    def _shine(
        self,
        environment: NDArray[np.float32],
        rotate: float,
        coats: _Coats,
        view: NDArray[np.float32],
        looked_at: NDArray[np.bool_] | None,
    ) -> NDArray[np.float32]:
        """Specular light of the sky towards any view, (N, 3), of receivers that are `looked_at`, 0 of others."""
        wanted = coats.shiny if looked_at is None else coats.shiny & looked_at
        found = None
        if self.store.settings.get("light_factors"):
            if self._factors is None:
                from relightcli.stages.light_factors import LightFactors  # what diffuse light need not wait for

                self._factors = LightFactors(self, self.sky)
            found, known = self._factors.specular(coats.table, coats.material, view, wanted)
            wanted = wanted & ~known
            if not wanted.any():
                return found
        cells = latlong_to_cube(environment, self.resolution, rotate)
        exact = self._exact_specular(cells, environment, rotate, coats, view, np.flatnonzero(wanted))
        return exact if found is None else found + exact


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
        first = self.first[cells]
        count = np.append(self.first, len(values))[cells + 1] - first
        start = np.cumsum(count) - count
        return np.add.reduceat(values[np.arange(count.sum()) + np.repeat(first - start, count)], start)


class _Cut:
    """The cells of a tree that are cut under the last light."""

    def __init__(self, runs: Runs, cells: NDArray[np.int32], error: NDArray[np.float32], resolution: int) -> None:
        self.runs, self.cells, self.error, self.resolution = runs, cells, error, resolution
        self.flux = np.zeros((0, 3))  # of the cells, under the last light
        self._known: tuple[NDArray[Any], ...] = ()
        self._parts = Points(np.zeros((0, 3)), np.zeros((0, 3)))

    def of(self, light: LeafLight, rest: NDArray[np.float32], rotate: float) -> tuple[NDArray[np.int64], Points]:
        """Bright cells under the light of a map, and their parts: the last ones if their light has not changed."""
        flux = self.flux = self.runs.sum(light.flux)
        bright = bright_cells(flux, self.error)
        known = (bright, flux[bright], self.runs.sums(light.moment, bright), np.array([*rest.shape, rotate]))
        if not same(known, self._known):
            self._known = known
            self._parts = cut(self.cells[bright], flux[bright], self.resolution, rest, rotate)
        return bright, self._parts


class ClusteredSky:
    """The map in clusters, and what is summed apart from them.

    cells: those with fractions; points: small bright places; bright: cells that are cut, parts: what they are cut into;
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
        own = self.cells = read(f"light_clusters/{DIFFUSE}")
        radius = 0.5 * np.sqrt(solid_angles(own, self.tree.resolution))
        self.fractions = Fractions(columns, lighting.normal, radius)
        self.runs = Runs(self.tree, own)
        self._cut = _Cut(self.runs, own, read("light_clusters/error"), self.tree.resolution)
        self.light: LeafLight | None = None
        self._groups: NDArray[np.float64] = np.zeros((0, 3, 64))
        self.points = self.parts = Points(np.zeros((0, 3)), np.zeros((0, 3)))
        self.bright = np.zeros(0, np.int64)
        self._apart: tuple[Points, NDArray[np.float64]] | None = None
        self.changed: int | None = None
        self._given: tuple[NDArray[np.float32], float] | None = None
        self._rest: NDArray[np.float32] | None = None
        self._rows: Rows | None = None
        self._taken = np.zeros(0, np.int64)
        self._splitter: tuple[tuple[int, int, float], Splitter] | None = None
        self._tracer: Tracer | None = None
        self._seen: dict[bytes, NDArray[np.bool_]] = {}

    def resume(self, previous: formats.Store) -> None:
        """Takes up the light of a radiance store that was made from the same clusters."""
        if "light/moment" not in previous:
            raise StoreError(f"{previous.path}: keeps no light of clusters, as --from needs it")
        read: Any = previous.read
        self.light = LeafLight(read("light/flux"), read("light/moment"))
        self.bright = read("light/bright") if "light/bright" in previous else self.bright
        self._groups = self.fractions.by_group(read("light/irradiance"))

    def set_light(self, environment: NDArray[np.float32], rotate: float) -> None:
        if self._given is not None and self._given[0] is environment and self._given[1] == rotate:
            self.changed = 0
            return
        splitter = self._splitter_of(environment.shape[0], environment.shape[1], rotate)
        threads, old, given = self.lighting.threads, self.light, self._given
        if old is None or given is None or given[1] != rotate or given[0].shape != environment.shape:
            self._rows = row_light(environment)
            rest, self.points, taken = split_points(environment, rotate, self._rows)
            new = splitter.light(rest, threads)
        else:
            rows, columns = changes(given[0], environment)
            self._rows = row_light(environment, self._rows, rows)
            rest, self.points, taken = split_points(environment, rotate, self._rows)
            _widen(columns, np.setxor1d(taken, self._taken, assume_unique=True))
            more = splitter.light(rest, threads, columns, self._rest)
            new = LeafLight(old.flux + more.flux, old.moment + more.moment)
        self._given, self._rest, self._taken, self.light = (environment, rotate), rest, taken, new
        was = self.bright
        self.bright, self.parts = self.cut(self._cut)
        if old is not None:
            changed = np.unique(np.flatnonzero(new.moment != old.moment) // 9)
            if len(changed) <= PARTLY * len(new.moment):
                runs = np.union1d(self.runs.of[changed], np.setxor1d(was, self.bright))
                before, after = (
                    _without(LeafLight(*(self.runs.sums(v, runs) for v in light)), np.isin(runs, bright))
                    for light, bright in ((old, was), (new, self.bright))
                )
                self.fractions.change(self._groups, runs, before, after, threads)
                self.changed = len(changed)
                return
        every = LeafLight(*map(self.runs.sum, new))
        self._groups = self.fractions.sum(_without(every, self.bright), threads)
        self.changed = None

    def cut(self, cells: _Cut) -> tuple[NDArray[np.int64], Points]:
        """Bright ones of some cells, and what they are cut into."""
        assert self.light is not None
        return cells.of(self.light, *self.rest)

    @property
    def rest(self) -> tuple[NDArray[np.float32], float]:
        """The map without its points, and the degrees by which it is turned."""
        assert self._rest is not None
        assert self._given is not None
        return self._rest, self._given[1]

    @property
    def irradiance(self) -> NDArray[np.float64]:
        """Irradiance (N, 3) of all but the points and the bright cells."""
        return self.fractions.by_receiver(self._groups)

    def _splitter_of(self, height: int, width: int, rotate: float) -> Splitter:
        """Kept for maps of the same size, turned alike."""
        key = (height, width, rotate)
        if self._splitter is None or self._splitter[0] != key:
            self._splitter = (key, Splitter(self.tree, *key))
        return self._splitter[1]

    def lit(self) -> NDArray[np.float32]:
        """Irradiance (N, 3) of all."""
        points = both(self.points, self.parts)
        if not len(points.flux):
            return self.fractions.rounded(self._groups, None)
        if self._apart is None or not same(self._apart[0], points):
            normal = self.lighting.normal
            self._apart = (points, point_irradiance(self.seen(points), points, normal, self.lighting.threads))
        return self.fractions.rounded(self._groups, self._apart[1])

    def seen(self, points: Points) -> NDArray[np.bool_]:
        """Who sees the points, (K, N)."""
        found = np.zeros((len(points.direction), len(self.lighting)), bool)
        for row, direction in zip(found, points.direction, strict=True):
            row[:] = self.sees(direction)
        return found

    def visible(self, points: Points) -> NDArray[np.float32]:
        """Visible part of the clusters that the points lie in, (K, N): enough for what highlights make of it."""
        runs = self.runs.of[leaves_at(self.tree, points.direction)]
        found = np.empty((len(runs), len(self.lighting)), np.float32)
        for row, run in zip(found, runs.tolist(), strict=True):
            np.multiply(self.fractions.of(run), np.float32(1.0 / 255.0), out=row)
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
                    geometry = self.lighting.geometry
                    self._tracer = Tracer(geometry.positions, geometry.faces, self.lighting.threads)
                tracer = self._tracer
                origins = tracer.offset(self.lighting.position[doubtful], self.lighting.normal[doubtful])
                seen[doubtful] = ~tracer.occluded(origins, np.tile(light, (len(doubtful), 1)))
            self._seen[key] = seen
            while len(self._seen) > max(KEPT, ROOM // max(len(seen), 1)):
                del self._seen[next(iter(self._seen))]
        return self._seen[key]


class _BakedLobes:
    """Specular light of the view that the clusters were made for."""

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
        cells = read(f"light_clusters/{LOBE}")
        self.runs = Runs(tree, cells)
        self._cut = _Cut(self.runs, cells, read("light_clusters/lobe_error"), tree.resolution)
        self._of: LeafLight | None = None
        self._parts = Points(np.zeros((0, 3)), np.zeros((0, 3)))
        self._apart: tuple[Points, NDArray[np.float64]] | None = None
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

    def shine(
        self, sky: ClusteredSky, coats: _Coats, view: NDArray[np.float32], colour: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """(N, 3), of a colour (N, 3). Raises InputError for another view, or other lobes than were baked in."""
        lighting = self.lighting
        if self._good is None or self._good[0] is not coats or self._good[1] is not view:
            self._check(coats, view)
            self._good = (coats, view)
        assert sky.light is not None
        if self._of is not sky.light:
            bright, self._parts = sky.cut(self._cut)
            flux = self._cut.flux.copy()
            flux[bright] = 0.0
            old = np.zeros_like(flux) if self._flux is None else self._flux
            changed = np.flatnonzero((flux != old).any(axis=1))
            if len(changed) > PARTLY * len(old):
                changed, old = np.arange(len(old)), np.zeros_like(old)
                self._even = self.lobes.dark()
            self.lobes.add(self._even, changed, flux[changed] - old[changed], lighting.threads)
            self._of, self._flux = sky.light, flux
        points = both(sky.points, self._parts)
        if not len(points.flux):
            return self.lobes.put(self._even, None, self.rows, colour)
        if self._apart is None or not same(self._apart[0], points):
            more = point_lobes(
                np.concatenate([sky.seen(sky.points), sky.visible(self._parts)]),
                points,
                lighting.normal,
                self.view,
                self.rows,
                coats.material,
                self.table,
                lighting.threads,
            )
            self._apart = (points, more)
        return self.lobes.put(self._even, self._apart[1], self.rows, colour)


def same(one: Sequence[NDArray[Any]], other: Sequence[NDArray[Any]]) -> bool:
    return len(one) == len(other) and all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def _without(light: LeafLight, cells: NDArray[np.bool_] | NDArray[np.int64]) -> LeafLight:
    """Light of cells but for some of them."""
    if not len(cells):
        return light
    flux, moment = light.flux.copy(), light.moment.copy()
    flux[cells] = 0.0
    moment[cells] = 0.0
    return LeafLight(flux, moment)


def changes(old: NDArray[np.float32], new: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The rows (k,) in which two maps (H, W, 3) differ, and per column the range of rows that do, (W, 2), half open;
    empty where none do."""
    unlike, columns = np.zeros(len(old), bool), np.zeros((old.shape[1], 2), np.int64)
    _changes(np.ascontiguousarray(old), np.ascontiguousarray(new), unlike, columns)
    return np.flatnonzero(unlike), columns


def _widen(columns: NDArray[np.int64], pixels: NDArray[np.int64]) -> None:
    """Takes flat indices of a map's pixels into the ranges of rows (W, 2) of its columns."""
    for row, column in zip(*(k.tolist() for k in np.divmod(pixels, len(columns))), strict=True):
        first, last = columns[column]
        columns[column] = (row, row + 1) if first == last else (min(first, row), max(last, row + 1))


@njit(cache=True, nogil=True, error_model="numpy")
def _changes(old, new, unlike, columns):  # type: ignore[no-untyped-def]
    width = old.shape[1]
    for i in range(old.shape[0]):
        one, other = old[i].reshape(3 * width), new[i].reshape(3 * width)
        differ = 0
        for k in range(3 * width):  # without a branch: most rows are alike
            differ |= one[k] != other[k]
        if not differ:
            continue
        unlike[i] = True
        for j in range(width):
            if old[i, j, 0] != new[i, j, 0] or old[i, j, 1] != new[i, j, 1] or old[i, j, 2] != new[i, j, 2]:
                if columns[j, 1] == 0:
                    columns[j, 0] = i
                columns[j, 1] = i + 1
