"""Specular light of clustered stores for many views: light of the factors of BRDFs, made once for every map.

written by cluster    models of the families in the scene, without lobes of their own
a new map             light of the factors from the clusters (`core.shade.factor_sum`), prefiltered skies
a new view, other     broad lobes as one product per receiver with the view factors, narrow ones from a few
materials             directions (`core.shade.sampled_lobes`); highlights of the map's points, for which rays have
                      told who sees them, and of the brightest texels [Sun 2007, Eq. 3-4]
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.core.brdf.direct_model import FAMILIES, light_factors
from relightcli.core.brdf.models import SPECULAR, MaterialTable, widen
from relightcli.core.lights import quadtree
from relightcli.core.lights.environment import latlong_to_cube, splat
from relightcli.core.lights.leaf_light import LeafLight, Splitter
from relightcli.core.lights.points import Points, both
from relightcli.core.lights.quadtree import Cell
from relightcli.core.shade.bright import Bright, split_bright
from relightcli.core.shade.factor_sum import factor_light
from relightcli.core.shade.sampled_lobes import make_skies
from relightcli.core.shade.seen_points import point_irradiance, point_lobes
from relightcli.stages.brdf_data import broad_model
from relightcli.stages.family import BROAD, Family, families_of, put_family
from relightcli.stages.light_cluster_job import as_cell
from relightcli.stages.lighting import LightingStore

if TYPE_CHECKING:
    from relightcli.stages.clustered import ClusteredSky

PLACE = "light_factors"
GROUPS = 8  # along a face: groups of clusters for which a factor is looked up once


def put_factors(writer: formats.Writer, lighting: LightingStore) -> None:
    """Writes what `LightFactors` reads."""
    for name, receivers in families_of(lighting).items():
        put_family(writer, PLACE, name, broad_model(name, BROAD[0]), receivers)


def shining(lighting: LightingStore) -> int:
    """How many receivers have factors."""
    return sum(len(receivers) for receivers in families_of(lighting).values())


class LightFactors:
    """The families of an open store of clustered lights, and their light."""

    def __init__(self, lighting: LightingStore, sky: ClusteredSky) -> None:
        self.lighting, self.sky = lighting, sky
        store = lighting.store
        self.families = [Family(lighting, PLACE, name) for name in FAMILIES if f"{PLACE}/{name}/receiver" in store]
        self.tables = [light_factors(family.model).table[..., :-1] for family in self.families]
        self.parts = _Parts(sky) if self.families else None
        self._lit: LeafLight | None = None
        self._given: MaterialTable | None = None
        self._wide: MaterialTable
        self.bright: Bright
        self._known: NDArray[np.bool_]

    def specular(
        self,
        table: MaterialTable,
        material: NDArray[np.int32],
        view: NDArray[np.float32],
        active: NDArray[np.bool_] | None,
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Specular exit radiance (N, 3) under the light of the sky, towards view (N, 3), of `active` receivers (N,), 0
        of others; and which receivers have one from here, (N,). material (N,): row of the table."""
        if self._lit is not self.sky.light:
            self._set_light()
            self._lit = self.sky.light
        if self._given is not table:
            self._given, self._wide = table, widen(table, 0.5 * np.pi / self.lighting.resolution)
            self._known = np.zeros(len(self.lighting), bool)
            for family in self.families:
                self._known[family.receiver] = table.model[material[family.receiver]] == family.code
        out, threads = np.zeros((len(self.lighting), 3), np.float32), self.lighting.threads
        for family in self.families:
            out[family.receiver] = family.specular(table, self._wide, self.bright, view, active, threads)
        points = self.sky.points
        if len(points.flux) and self.families:
            rows = np.flatnonzero(self._known if active is None else self._known & active)
            colour = table.parameters[:, SPECULAR : SPECULAR + 3]
            rows = rows[np.any(colour[material[rows]], axis=1)]
            shine = point_lobes(
                self.sky.seen(points), points, self.lighting.normal, view, rows, material, self._wide, threads
            )
            out[rows] += (shine * colour[material[rows]]).astype(np.float32)
        return out, self._known

    def _set_light(self) -> None:
        """Light of the factors from what is neither a point nor one of the brightest texels; and skies of that."""
        if self.parts is None:
            return
        sky, lighting, threads = self.sky, self.lighting, self.lighting.threads
        rest, rotate = sky.rest
        cells, self.bright = split_bright(splat(latlong_to_cube(rest, lighting.resolution, rotate)))
        taken = Points(self.bright.direction, -self.bright.flux)
        points = both(sky.parts, taken)
        seen = np.zeros((len(points.flux), len(lighting)), bool)
        seen[: len(sky.parts.flux)] = sky.seen(sky.parts)
        for family in self.families:
            seen[len(sky.parts.flux) :, family.receiver] = _open_texels(family.bits, self.bright.texel)
        even = (sky.irradiance + point_irradiance(seen, points, lighting.normal, threads)) / np.pi
        parts, light, skies = self.parts, self.parts.light(sky), make_skies(cells, threads)
        for family, table in zip(self.families, self.tables, strict=True):
            assert family.narrow is not None
            family.narrow.skies = skies
            family.incident[:, :-1] = factor_light(
                sky.fractions, family.receiver, light, parts.cell, parts.radius, parts.start, seen, points, table,
                threads,
            )  # fmt: skip
            family.incident[:, -1] = even[family.receiver]


def _open_texels(bits: NDArray[np.uint8], texel: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of n receivers see some texels (K,): (K, n)."""
    words = bits.reshape(len(bits), -1)
    found: NDArray[np.bool_] = (words[:, texel >> 3] >> (texel & 7).astype(np.uint8)) & 1 == 1
    return np.ascontiguousarray(found.T)


class _Parts:
    """The cells with fractions, the large ones in parts, in groups that are GROUPS to a face's side or one cell.

    cell (e,): the cell of each part; radius (e,): half its side; start (p + 1,): first part of each group.
    """

    def __init__(self, sky: ClusteredSky) -> None:
        resolution = sky.tree.resolution
        grid = _grid(resolution)
        parts = quadtree.overlay([as_cell(c) for c in sky.cells.tolist()], grid, resolution)
        self.tree = quadtree.build_tree(parts, resolution)
        self.cell = np.repeat(
            np.arange(len(sky.cells)),
            np.diff(quadtree.first_leaves(self.tree, sky.cells), append=len(parts)),
        )
        first = quadtree.first_leaves(self.tree, np.array(grid, np.int32))
        self.start = np.append(first, len(parts))
        self.radius = 0.5 * np.sqrt(quadtree.solid_angles(self.tree.cell, resolution))
        self._splitter: tuple[tuple[int, int, float], Splitter] | None = None

    def light(self, sky: ClusteredSky) -> LeafLight:
        """What the parts hold of the sky's light, without that of bright cells."""
        assert sky.light is not None
        if len(self.tree.cell) == len(sky.tree.cell):  # the same cells
            found = LeafLight(sky.light.flux.copy(), sky.light.moment.copy())
        else:
            rest, rotate = sky.rest
            key = (*rest.shape[:2], rotate)
            if self._splitter is None or self._splitter[0] != key:
                self._splitter = (key, Splitter(self.tree, *key))
            found = self._splitter[1].light(rest, sky.lighting.threads)
        apart = np.isin(self.cell, sky.bright)
        found.flux[apart] = 0.0
        found.moment[apart] = 0.0
        return found


def _grid(resolution: int) -> list[Cell]:
    """GROUPS x GROUPS cells of every face, or single lights, in the order of trees."""
    cells, side = quadtree.roots(resolution), 1
    while side < GROUPS:
        cells = [part for cell in cells for part in (quadtree.children(cell) or [cell])]
        side *= 2
    return cells
