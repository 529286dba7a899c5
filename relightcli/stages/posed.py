"""A pose store made ready to light: skinned objects in any pose, everything else as in the transfer store it came from.

A posed object is lit by the sky past its own body as the model of its visibility has it, and past everything else as
rays have it; by local lights, as rays have them. It takes light from what stands still, and in interreflections sends
some there (`pose_scene`). With no pose named, all is as in the transfer store, where characters stand at rest and
nothing else knows of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.core.brdf.models import PHONG, SHININESS, SPECULAR
from relightcli.core.lights.environment import SkyCube, splat
from relightcli.core.pose.beside import (
    band_profile,
    lambert_profile,
    shade_beside,
    sky_cells,
)
from relightcli.core.pose.phong_operator import phong_factors
from relightcli.core.pose.seen import seen_bits
from relightcli.core.pose.shading import lighting, shade, visibility
from relightcli.core.shade.gather import Gather
from relightcli.core.shade.glossy import SkyTree, sky_tree, specular_radiance
from relightcli.core.shade.irradiance import irradiance, moment_prefix
from relightcli.core.sphere import sh
from relightcli.core.transport.local_lights import LocalLights
from relightcli.errors import InputError, StoreError
from relightcli.scene.model import Geometry
from relightcli.scene.posing import resolve_poses
from relightcli.stages.lighting import IN_MEMORY, LightingStore, _Coats
from relightcli.stages.pose_scene import SLAB, PosedScene, finer
from relightcli.stages.posed_object import PosedObject, PosedState, Side
from relightcli.stages.rig_store import read_rigs

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
DIFFUSE = 1.0  # the exponent by which phong's kernel is lambert's


class PoseStore(LightingStore):
    """An open pose store, with the interface of `LightingStore`."""

    streams = False  # what is seen depends on the poses, and is kept

    def __init__(self, store: Path | formats.Store, threads: int) -> None:
        super().__init__(store, threads)
        self._rest = (self.geometry, self.position, self.normal)
        self._objects: dict[str, PosedObject] = {}
        self._posed: dict[str, PosedState] = {}
        self._scene: PosedScene | None = None
        self._gather: Gather | None = None
        self._light_bits: U8 | None = None
        self._beside: dict[tuple[str, bool], U8 | None] = {}
        self._hits: NDArray[np.int32] | None = None
        self._apart: frozenset[int] = frozenset()  # objects that characters neither block nor are blocked by here

    def set_poses(self, poses: tuple[str, ...]) -> list[str]:
        """Poses objects, as `--pose` takes them, those not named as they rest; what there is to say about it.

        Raises InputError for unknown objects and clips, and for objects that the store has no model of.
        """
        return self._pose(poses, *self._rest)

    def _pose(
        self, poses: tuple[str, ...], geometry: Geometry, position: NDArray[np.float64], normal: NDArray[np.float32]
    ) -> list[str]:
        """`set_poses`, where all that is not posed has this geometry and these receivers."""
        resolved, notes = resolve_poses(self.scene, geometry, poses)
        self._posed, self._scene, self._gather, self._light_bits, self._beside = {}, None, None, None, {}
        self.geometry, self.position, self.normal = geometry, position, normal
        if not resolved:
            return notes
        positions, normals = geometry.positions.copy(), geometry.normals.copy()
        self.position, self.normal = position.copy(), normal.copy()
        for name, (clip, seconds) in resolved.items():
            item = self._object(name)
            state = self._posed[name] = item.at(clip, seconds)
            positions[item.vertices], normals[item.vertices] = state.position, state.normal
            for side in item.sides:
                self.position[side.receivers] = state.position[side.vertices]
                self.normal[side.receivers] = state.facing(side)[0][side.vertices]
            if state.distance > item.gap:
                notes.append(
                    f"{name} at {clip.name}@{seconds:g}: the pose is {state.distance:.2f} from the nearest training "
                    f"frame (root of the summed squared differences of features), and those are at most "
                    f"{item.gap:.2f} apart"
                )
        self.geometry = replace(geometry, positions=positions, normals=normals)
        if "shadows" in self.store.settings["effects"]:
            numbers = frozenset(geometry.object_names.index(name) for name in resolved)
            self._scene = PosedScene(self, numbers, self._apart)
        return notes

    def _object(self, name: str) -> PosedObject:
        if name not in self._objects:
            models = self.store.attrs.get("pose_models", {})
            found = [(k, about) for k, about in models.items() if about["object"] == name]
            if not found:
                raise InputError(f"--pose: {self.store.path} has no model of {name!r}; it has no clips to learn from")
            try:
                self._objects[name] = PosedObject(self, *found[0], read_rigs(self.store)[name])
            except (KeyError, TypeError) as error:
                raise StoreError(
                    f"{self.store.path}: the model of {name!r} is damaged ({error!r}). Fit it again."
                ) from None
        return self._objects[name]

    def buried(self) -> NDArray[np.bool_]:
        """See `LightingStore.buried`; of posed objects in the pose they are in, if anything blocks anything."""
        buried = super().buried().copy()
        for name in self._posed:
            buried[self._objects[name].receivers] = False
        if self._scene is not None:
            buried[self._scene.of_posed] = self._scene.buried
        return buried

    # -- who sees what

    def stored_blocks(self) -> Iterator[tuple[slice, U8]]:
        """The bits of all receivers as the store has them."""
        return super().blocks()

    def blocks(
        self, first: int = 0, last: int | None = None, needed: NDArray[np.bool_] | None = None
    ) -> Iterator[tuple[slice, U8]]:
        """See `LightingStore.blocks`; past characters where they are posed."""
        for part, bits in super().blocks(first, last, needed):
            yield part, bits if self._scene is None else self._scene.past(part, bits)

    def gather(self, first: int = 0) -> Gather | None:
        """See `LightingStore.gather`; past characters, and to them, where they are posed."""
        if self._scene is None:
            return super().gather(first)
        if self._gather is None:
            scene, self._scene = self._scene, None
            try:
                stored = super().gather(first)
            finally:
                self._scene = scene
            if stored is None:
                return None
            self._gather = scene.gather(stored, self._stored_hits())
        return self._gather

    def _stored_hits(self) -> NDArray[np.int32]:
        if self._hits is not None:
            return self._hits
        hits: Any = self.store.read("bounce/hit")
        if hits.nbytes <= IN_MEMORY:
            self._hits = hits
        return np.asarray(hits)

    def _local_lights(self) -> tuple[U8, LocalLights] | None:
        found = super()._local_lights()
        if found is None or self._scene is None:
            return found
        if self._light_bits is None:
            self._light_bits = self._scene.light_bits(*found, list(self.scene.lights.values()))
        return self._light_bits, found[1]

    def _open_cells(self, item: PosedObject, state: PosedState, side: Side) -> U8 | None:
        """Cells that others leave open to one side of the vertices of a posed object."""
        key = item.name, side.back
        if key not in self._beside:
            found = None
            if self._scene is not None:
                normal = state.facing(side)[0].astype(np.float32)
                found = self._scene.beside(item.name, state.position, normal)
            self._beside[key] = found
        return self._beside[key]

    # -- light

    def _irradiance(self, sky: SkyCube, active: NDArray[np.bool_] | None, basis: str) -> NDArray[np.float32]:
        if not self._posed:
            return super()._irradiance(sky, active, basis)
        still = np.ones(len(self), bool) if active is None else active.copy()
        for name in self._posed:
            still[self._objects[name].receivers] = False
        out = np.zeros((len(self), 3), np.float32)
        if still.any():
            out[:] = super()._irradiance(sky, still, basis)
            if basis != "visibility" and self._scene is not None:
                self._take_off(sky, out)
        for name, state in self._posed.items():
            item = self._objects[name]
            for side in item.sides:
                own = side if active is None else _part(side, active[side.receivers])
                if len(own.vertices):
                    out[own.receivers] = self._diffuse(item, state, own, sky)
        return out

    def _take_off(self, sky: SkyCube, out: F32) -> None:
        """What a basis makes of the stored bits, times the share that is left of the light by the bits themselves."""
        assert self._scene is not None
        rows, before, now = self._scene.changed
        prefix = moment_prefix(splat(sky))
        was, left = (irradiance(bits, self.normal[rows], prefix, self.threads) for bits in (before, now))
        out[rows] *= np.clip(left / np.maximum(was, np.float32(1e-30)), 0.0, 1.0)

    def _diffuse(self, item: PosedObject, state: PosedState, side: Side, sky: SkyCube) -> F32:
        """Irradiance (N, 3) at the vertices of a side."""
        order, model = item.order, side.model
        cosine = item.weight == "cosine"
        frames = state.facing(side)[1]
        normals = np.ascontiguousarray(frames[:, 2])
        kernel = np.full(len(normals), -1, np.int32)
        kernel[side.vertices] = 0
        # A cosine-weighted model is lit by the light itself: kappa_0 = 4 makes l . v / pi of it.
        kappa = np.array([4.0]) if cosine else phong_factors(DIFFUSE, 2 * order - 1)
        cells = self._open_cells(item, state, side)
        if cells is None:
            light = _light(sky, len(kappa), order)
            lights = [lighting(kappa, light, order)]
            e = shade(model, state.scores, frames, normals, kernel, lights, self.threads)
        else:
            seen = visibility(model, state.scores, frames)
            profile = band_profile(kappa) if cosine else lambert_profile()
            e = shade_beside(seen, cells, sky_cells(sky, order), normals, kernel, [profile], self.threads)
        return np.float32(math.pi) * e[side.vertices]

    def _exact_specular(
        self,
        sky: SkyCube,
        environment: NDArray[np.float32],
        rotate: float,
        coats: _Coats,
        view: NDArray[np.float32],
        rows: NDArray[np.int64],
    ) -> NDArray[np.float32]:
        if not self._posed:
            return super()._exact_specular(sky, environment, rotate, coats, view, rows)
        asked = np.zeros(len(self), bool)
        asked[rows] = True
        still = asked.copy()
        for name in self._posed:
            still[self._objects[name].receivers] = False
        out = np.zeros((len(self), 3), np.float32)
        if still.any():
            out = super()._exact_specular(sky, environment, rotate, coats, view, np.flatnonzero(still))
        tree: SkyTree | None = None
        for name, state in self._posed.items():
            item = self._objects[name]
            for side in item.sides:
                wanted = asked[side.receivers]
                phong = coats.table.model[coats.material[side.receivers]] == PHONG
                own = _part(side, wanted & phong)
                if len(own.vertices):
                    out[own.receivers] = self._phong(item, state, own, sky, coats, view)
                own = _part(side, wanted & ~phong)
                if len(own.vertices):
                    tree = tree or sky_tree(splat(sky), environment, rotate)
                    out[own.receivers] = self._lobes(item, state, own, tree, coats, view)
        return out

    def _phong(self, item: PosedObject, state: PosedState, side: Side, sky: SkyCube, coats: _Coats, view: F32) -> F32:
        """Light of phong lobes at the vertices of a side, (N, 3): by the lobe's own kernel, in the bands."""
        _need_plain(item)
        order, (normal, frames) = item.order, state.facing(side)
        material = np.full(len(frames), -1, np.int32)
        material[side.vertices] = coats.material[side.receivers]
        towards = np.zeros((len(frames), 3))
        towards[side.vertices] = view[side.receivers]
        cosine = (normal * towards).sum(1)
        material[cosine <= 0.0] = -1
        mirrored = np.ascontiguousarray(2.0 * cosine[:, None] * normal - towards, np.float32)
        used = np.unique(material[material >= 0])
        place = np.full(len(coats.table.model) + 1, -1, np.int32)
        place[used] = np.arange(len(used))
        bands = 2 * order - 1
        factors = [phong_factors(float(coats.table.parameters[m, SHININESS]), bands) for m in used]
        if not factors:
            return np.zeros((len(side.vertices), 3), np.float32)
        kernel = place[material]
        open_cells = self._open_cells(item, state, side)
        if open_cells is None:
            lights = [lighting(kappa, _light(sky, bands, order), order) for kappa in factors]
            found = shade(side.model, state.scores, frames, mirrored, kernel, lights, self.threads)
        else:
            seen = visibility(side.model, state.scores, frames)
            profiles = [band_profile(kappa) for kappa in factors]
            found = shade_beside(seen, open_cells, sky_cells(sky, order), mirrored, kernel, profiles, self.threads)
        colours = coats.table.parameters[:, SPECULAR : SPECULAR + 3].astype(np.float32)
        return found[side.vertices] * colours[coats.material[side.receivers]]

    def _lobes(self, item: PosedObject, state: PosedState, side: Side, tree: SkyTree, coats: _Coats, view: F32) -> F32:
        """Light of any lobes at the vertices of a side, (N, 3): over the texels that the bands take for seen."""
        _need_plain(item)
        normals, frames = state.facing(side)
        visible, open_cells = visibility(side.model, state.scores, frames), self._open_cells(item, state, side)
        out = np.zeros((len(side.vertices), 3), np.float32)
        for start in range(0, len(out), SLAB):
            part = slice(start, start + SLAB)
            own, rows = side.vertices[part], side.receivers[part]
            normal = normals[own].astype(np.float32)
            bits = seen_bits(visible[own], normal, tree.resolution, self.threads)
            if open_cells is not None:
                bits &= finer(open_cells[own], tree.resolution)
            every, material = np.arange(len(own)), coats.material[rows]
            out[part] = specular_radiance(bits, every, normal, view[rows], material, coats.table, tree, self.threads)
        return out


def _part(side: Side, lit: NDArray[np.bool_]) -> Side:
    """A side with those of its lit vertices (N,) alone."""
    return replace(side, vertices=side.vertices[lit], receivers=side.receivers[lit])


def _need_plain(item: PosedObject) -> None:
    if item.weight == "cosine":
        raise InputError(
            f"{item.name}: its model of cosine-weighted visibility lights lambert materials only; fit with --weight "
            "none"
        )


def _light(sky: SkyCube, bands: int, order: int) -> NDArray[np.float64]:
    """The sky's coefficients, all that a kernel of so many bands and visibility of order n can tell apart."""
    return sh.project_sky(sky.flux, sky.resolution, bands + order - 1)
