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
from relightcli.core.brdf.separable import POLAR
from relightcli.core.lights.environment import SkyCube, splat
from relightcli.core.pose.beside import (
    band_profile,
    incident_beside,
    lambert_profile,
    shade_beside,
    sky_cells,
)
from relightcli.core.pose.phong_operator import phong_factors
from relightcli.core.pose.shading import incident, lighting, shade, visibility
from relightcli.core.shade.gather import Gather
from relightcli.core.shade.irradiance import irradiance, moment_prefix
from relightcli.core.shade.low_order import response, shade_low_order
from relightcli.core.sphere import sh
from relightcli.core.transport.local_lights import LocalLights
from relightcli.core.transport.transfer import local_rotations
from relightcli.errors import InputError, StoreError
from relightcli.scene.model import Geometry
from relightcli.scene.posing import resolve_poses
from relightcli.stages.lighting import IN_MEMORY, LightingStore, _Coats
from relightcli.stages.pose_scene import PosedScene
from relightcli.stages.posed_object import PosedObject, PosedState, Side
from relightcli.stages.rig_store import read_rigs

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
DIFFUSE = 1.0  # the exponent by which phong's kernel is lambert's


class PoseStore(LightingStore):
    """An open pose store, with the interface of `LightingStore`."""

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

        Raises InputError for unknown objects and clips, for objects that the store has no model of, and where a fixed
        camera's pixels would have to follow.
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
        if self.camera_name is not None:
            raise InputError(
                f"--pose: the receivers of {self.store.path} are the pixels of camera {self.camera_name!r}; "
                "precompute with --receivers vertices"
            )
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
        """See `LightingStore.buried`. Of posed objects nothing is known to be."""
        buried = super().buried().copy()
        for name in self._posed:
            buried[self._objects[name].receivers] = False
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
                out[side.receivers] = self._diffuse(item, state, side, sky)[side.vertices]
        return out

    def _take_off(self, sky: SkyCube, out: F32) -> None:
        """What a basis makes of the stored bits, times the share that is left of the light by the bits themselves."""
        assert self._scene is not None
        rows, before, now = self._scene.changed
        prefix = moment_prefix(splat(sky))
        was, left = (irradiance(bits, self.normal[rows], prefix, self.threads) for bits in (before, now))
        out[rows] *= np.clip(left / np.maximum(was, np.float32(1e-30)), 0.0, 1.0)

    def _diffuse(self, item: PosedObject, state: PosedState, side: Side, sky: SkyCube) -> F32:
        """Irradiance (V, 3) of one side of a posed object's vertices."""
        order, model = item.order, side.model
        cosine = item.weight == "cosine"
        frames = state.facing(side)[1]
        normals = np.ascontiguousarray(frames[:, 2])
        first = np.zeros(len(normals), np.int32)
        # A cosine-weighted model is lit by the light itself: kappa_0 = 4 makes l . v / pi of it.
        kappa = np.array([4.0]) if cosine else phong_factors(DIFFUSE, 2 * order - 1)
        cells = self._open_cells(item, state, side)
        if cells is None:
            light = _light(sky, len(kappa), order)
            lights = [lighting(kappa, light, order)]
            e = shade(model, state.scores, frames, normals, first, lights, self.threads)
        else:
            seen = visibility(model, state.scores, frames)
            profile = band_profile(kappa) if cosine else lambert_profile()
            e = shade_beside(seen, cells, sky_cells(sky, order), normals, first, [profile], self.threads)
        return np.float32(math.pi) * e

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
        for name, state in self._posed.items():
            item = self._objects[name]
            for side in item.sides:
                wanted = asked[side.receivers]
                if wanted.any():
                    lit = replace(side, vertices=side.vertices[wanted], receivers=side.receivers[wanted])
                    self._specular_of(item, state, lit, sky, coats, view, out)
        return out

    def _specular_of(
        self,
        item: PosedObject,
        state: PosedState,
        side: Side,
        sky: SkyCube,
        coats: _Coats,
        view: F32,
        out: F32,
    ) -> None:
        """Specular light of one side of a posed object's vertices into its receivers' rows of out: phong by its kernel,
        other models by their response to the light that arrives, cut to the bands of visibility."""
        if item.weight == "cosine":
            raise InputError(
                f"{item.name}: its model of cosine-weighted visibility lights lambert materials only; fit with "
                "--weight none"
            )
        order, model = item.order, side.model
        normal, frames = state.facing(side)
        material = np.full(len(frames), -1, np.int32)
        material[side.vertices] = coats.material[side.receivers]
        towards = np.zeros((len(frames), 3))
        towards[side.vertices] = view[side.receivers]
        cosine = (normal * towards).sum(1)
        material[cosine <= 0.0] = -1
        mirrored = 2.0 * cosine[:, None] * normal - towards
        colours = coats.table.parameters[:, SPECULAR : SPECULAR + 3].astype(np.float32)
        bands = 2 * order - 1
        found = np.zeros((len(material), 3), np.float32)
        used = np.unique(material[material >= 0])
        phong = [m for m in used if coats.table.model[m] == PHONG]
        open_cells = self._open_cells(item, state, side)
        seen = None if open_cells is None else visibility(model, state.scores, frames)
        if phong:
            place = np.full(len(coats.table.model) + 1, -1, np.int32)
            place[phong] = np.arange(len(phong))
            factors = [phong_factors(float(coats.table.parameters[m, SHININESS]), bands) for m in phong]
            axis = np.ascontiguousarray(mirrored, np.float32)
            kernel = place[material]
            if seen is None or open_cells is None:
                lights = [lighting(kappa, _light(sky, bands, order), order) for kappa in factors]
                found = shade(model, state.scores, frames, axis, kernel, lights, self.threads)
            else:
                profiles = [band_profile(kappa) for kappa in factors]
                cells = sky_cells(sky, order)
                found = shade_beside(seen, open_cells, cells, axis, kernel, profiles, self.threads)
        others = [m for m in used if coats.table.model[m] != PHONG]
        if others:
            rows = np.flatnonzero(np.isin(material, others))
            if seen is None or open_cells is None:
                arriving = incident(model, state.scores, frames, _light(sky, order, order), self.threads)
            else:
                arriving = incident_beside(seen, open_cells, sky_cells(sky, order), self.threads)
            turned = local_rotations(normal[rows].astype(np.float32), order)
            local = np.ascontiguousarray(np.einsum("nst,nct->ncs", turned, arriving[rows]))
            table = np.zeros((len(coats.table.model), POLAR, order * (order + 1) // 2), np.float32)
            for m in others:
                table[m] = response(int(coats.table.model[m]), coats.table.parameters[m], order)
            both = shade_low_order(
                np.arange(len(rows)),
                local,
                np.zeros((len(rows), 3), np.float32),
                normal[rows].astype(np.float32),
                towards[rows].astype(np.float32),
                table,
                np.ones((len(colours), 3), np.float32),
                material[rows],
                self.threads,
            )
            found[rows] = np.maximum(both[0], 0.0)
        found *= np.where(material[:, None] >= 0, colours[material], np.float32(0.0))
        out[side.receivers] = found[side.vertices]


def _light(sky: SkyCube, bands: int, order: int) -> NDArray[np.float64]:
    """The sky's coefficients, all that a kernel of so many bands and visibility of order n can tell apart."""
    return sh.project_sky(sky.flux, sky.resolution, bands + order - 1)
