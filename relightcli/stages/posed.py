"""A pose store made ready to light: skinned objects in any pose, everything else as in the transfer store it came from.

A posed object is lit by the sky directly, shadowed by its own body as the model of its visibility has it (and by its
surroundings, if training saw them). It casts no shadow on others, and no light: `--reference` does both. Objects that
are not posed stand in their rest pose and are lit from their visibility bits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.core.brdf.models import PHONG, SHININESS, SPECULAR
from relightcli.core.brdf.separable import POLAR
from relightcli.core.lights.environment import SkyCube
from relightcli.core.pose.clip import Clip
from relightcli.core.pose.linear_model import distance
from relightcli.core.pose.phong_operator import phong_factors
from relightcli.core.pose.rig import Rig, pose_features, posed
from relightcli.core.pose.shading import Synthesis, incident, lighting, shade, synthesis
from relightcli.core.shade.low_order import response, shade_low_order
from relightcli.core.sphere import sh
from relightcli.core.transport.transfer import local_rotations
from relightcli.errors import InputError, StoreError
from relightcli.scene.model import Material
from relightcli.scene.posing import resolve_poses
from relightcli.stages.lighting import LightingStore, Radiance, _Coats
from relightcli.stages.rig_store import read_rigs

F32 = NDArray[np.float32]
DIFFUSE = 1.0  # the exponent by which phong's kernel is lambert's


class PosedObject:
    """One skinned object: its model, which receivers are its vertices', and the pose it is in."""

    def __init__(self, store: PoseStore, number: str, about: dict[str, Any], rig: Rig) -> None:
        read: Any = store.store.read
        group = f"pose/{number}"
        self.name, self.weight, self.gap = str(about["object"]), str(about["weight"]), float(about["gap"])
        self.rig, self.transform = rig, store.scene.objects[self.name].transform
        self.features: NDArray[np.float64] = read(f"{group}/features")
        self.mean: NDArray[np.float64] = read(f"{group}/model/pose_mean")
        self.directions: NDArray[np.float64] = read(f"{group}/model/pose_direction")
        self.model: Synthesis = synthesis(
            read(f"{group}/model/intercept"),
            read(f"{group}/model/slope_scale")[:, :, 0],
            read(f"{group}/model/slope"),
            read(f"{group}/model/centre"),
            str(about["axes"]),
            int(about["order"]),
        )
        self.vertices = np.flatnonzero(store.geometry.vertex_object == int(number))
        front, back = store.receiver_of_vertex()
        front, back = front[self.vertices], back[self.vertices]
        self.front = np.flatnonzero(front >= 0)  # vertices of the rig, and their receivers
        self.front_receiver = front[self.front]
        self.back = np.flatnonzero(back >= 0)
        self.back_receiver = back[self.back]

    def at(self, clip: Clip, seconds: float) -> PosedState:
        """Where the object is at that moment of a clip."""
        position, normal, tangent = posed(self.rig, self.transform, clip, seconds)
        frames = np.stack([tangent, np.cross(normal, tangent), normal], 1).astype(np.float32)
        features = pose_features(self.rig, clip, seconds)
        scores = (features - self.mean) @ self.directions
        return PosedState(position, normal, frames, scores, distance(self.features, features))


@dataclass(frozen=True)
class PosedState:
    """position, normal (V, 3) float64 and frames (V, 3, 3) float32 in the world; scores (K,); distance from the
    training frames (`linear_model.distance`)."""

    position: NDArray[np.float64]
    normal: NDArray[np.float64]
    frames: F32
    scores: NDArray[np.float64]
    distance: float


class PoseStore(LightingStore):
    """An open pose store, with the interface of `LightingStore`."""

    def __init__(self, store: Path | formats.Store, threads: int) -> None:
        super().__init__(store, threads)
        self._rest = (self.geometry, self.position, self.normal, self.bounces)
        self._objects: dict[str, PosedObject] = {}
        self._posed: dict[str, PosedState] = {}

    def set_poses(self, poses: tuple[str, ...]) -> list[str]:
        """Poses objects, as `--pose` takes them, those not named as they rest; what there is to say about it.

        Raises InputError for unknown objects and clips, for objects that the store has no model of, and where local
        lights or a fixed camera's pixels would have to follow.
        """
        geometry, position, normal, bounces = self._rest
        resolved, notes = resolve_poses(self.scene, geometry, poses)
        self._posed = {}
        self.geometry, self.position, self.normal = geometry, position, normal
        self.bounces = bounces if not resolved else 0
        if not resolved:
            return notes
        if self.camera_name is not None:
            raise InputError(
                f"--pose: the receivers of {self.store.path} are the pixels of camera {self.camera_name!r}; "
                "precompute with --receivers vertices"
            )
        if self.scene.lights:
            raise InputError(
                f"--pose: {self.store.path} has local lights ({', '.join(self.scene.lights)}), which do not follow "
                "posed objects; use --reference"
            )
        positions, normals = geometry.positions.copy(), geometry.normals.copy()
        self.position, self.normal = position.copy(), normal.copy()
        for name, (clip, seconds) in resolved.items():
            item = self._object(name)
            state = self._posed[name] = item.at(clip, seconds)
            positions[item.vertices], normals[item.vertices] = state.position, state.normal
            self.position[item.front_receiver] = state.position[item.front]
            self.position[item.back_receiver] = state.position[item.back]
            self.normal[item.front_receiver] = state.normal[item.front]
            self.normal[item.back_receiver] = -state.normal[item.back]
            if state.distance > item.gap:
                notes.append(
                    f"{name} at {clip.name}@{seconds:g}: the pose is {state.distance:.2f} from the nearest training "
                    f"frame (root of the summed squared differences of features), and those are at most "
                    f"{item.gap:.2f} apart"
                )
        if bounces:
            notes.append("posed pictures have direct light only")
        self.geometry = replace(geometry, positions=positions, normals=normals)
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
            item = self._objects[name]
            buried[item.front_receiver] = buried[item.back_receiver] = False
        return buried

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
        """See `LightingStore.exit_radiance`. Raises InputError for interreflections about posed objects."""
        if self._posed and bounces:
            raise InputError(f"--bounces {bounces}: posed pictures have direct light only; --reference has them all")
        return super().exit_radiance(environment, rotate, materials, view, active, basis, bounces)

    def _irradiance(self, sky: SkyCube, active: NDArray[np.bool_] | None, basis: str) -> NDArray[np.float32]:
        if not self._posed:
            return super()._irradiance(sky, active, basis)
        still = np.ones(len(self), bool) if active is None else active.copy()
        for name in self._posed:
            still[self._objects[name].front_receiver] = still[self._objects[name].back_receiver] = False
        out = np.zeros((len(self), 3), np.float32)
        if still.any():
            out[:] = super()._irradiance(sky, still, basis)
        for name, state in self._posed.items():
            item = self._objects[name]
            order = item.model.order
            # A cosine-weighted model is lit by the light itself: kappa_0 = 4 makes l . v / pi of it.
            kappa = np.array([4.0]) if item.weight == "cosine" else phong_factors(DIFFUSE, 2 * order - 1)
            light = _light(sky, len(kappa), order)
            normals = np.ascontiguousarray(state.frames[:, 2])
            some = np.zeros(len(normals), np.int32)
            e = shade(
                item.model, state.scores, state.frames, normals, some, [lighting(kappa, light, order)], self.threads
            )
            out[item.front_receiver] = np.float32(math.pi) * e[item.front]
            if len(item.back):  # nothing is known of what the back sees: the whole sky behind it [digest of Eq. 22]
                out[item.back_receiver] = _open(sky, -state.normal[item.back])
        return out

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
            still[self._objects[name].front_receiver] = still[self._objects[name].back_receiver] = False
        out = np.zeros((len(self), 3), np.float32)
        if still.any():
            out = super()._exact_specular(sky, environment, rotate, coats, view, np.flatnonzero(still))
        for name, state in self._posed.items():
            item = self._objects[name]
            wanted = asked[item.front_receiver]
            if wanted.any():
                self._specular_of(item, state, sky, coats, view, item.front[wanted], item.front_receiver[wanted], out)
        return out

    def _specular_of(
        self,
        item: PosedObject,
        state: PosedState,
        sky: SkyCube,
        coats: _Coats,
        view: F32,
        vertices: NDArray[np.int64],
        receivers: NDArray[np.int32],
        out: F32,
    ) -> None:
        """Specular light of a posed object's vertices into the receivers' rows of out: phong by its kernel, other
        models by their response to the light that arrives, cut to the bands of visibility."""
        if item.weight == "cosine":
            raise InputError(
                f"{item.name}: its model of cosine-weighted visibility lights lambert materials only; fit with "
                "--weight none"
            )
        order = item.model.order
        material = np.full(len(state.frames), -1, np.int32)
        material[vertices] = coats.material[receivers]
        towards = np.zeros((len(state.frames), 3))
        towards[vertices] = view[receivers]
        normal = state.normal
        cosine = (normal * towards).sum(1)
        material[cosine <= 0.0] = -1
        mirrored = 2.0 * cosine[:, None] * normal - towards
        colours = coats.table.parameters[:, SPECULAR : SPECULAR + 3].astype(np.float32)
        bands = 2 * order - 1
        light = _light(sky, bands, order)
        found = np.zeros((len(material), 3), np.float32)
        used = np.unique(material[material >= 0])
        phong = [m for m in used if coats.table.model[m] == PHONG]
        if phong:
            place = np.full(len(coats.table.model) + 1, -1, np.int32)
            place[phong] = np.arange(len(phong))
            lights = [
                lighting(phong_factors(float(coats.table.parameters[m, SHININESS]), bands), light, order) for m in phong
            ]
            axis = np.ascontiguousarray(mirrored, np.float32)
            found = shade(item.model, state.scores, state.frames, axis, place[material], lights, self.threads)
        others = [m for m in used if coats.table.model[m] != PHONG]
        if others:
            rows = np.flatnonzero(np.isin(material, others))
            arriving = incident(item.model, state.scores, state.frames, _light(sky, order, order), self.threads)
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
        out[receivers] = found[vertices]


def _light(sky: SkyCube, bands: int, order: int) -> NDArray[np.float64]:
    """The sky's coefficients, all that a kernel of so many bands and visibility of order n can tell apart."""
    return sh.project_sky(sky.flux, sky.resolution, bands + order - 1)


def _open(sky: SkyCube, normals: NDArray[np.float64]) -> F32:
    """Irradiance (N, 3) of surfaces that nothing shadows. [KT2: sum of A_l L_lm y_lm(n)]"""
    order = 9
    factors = math.pi * np.repeat(phong_factors(DIFFUSE, order), 2 * np.arange(order) + 1)
    light = sh.project_sky(sky.flux, sky.resolution, order) * factors[:, None]
    out: F32 = np.maximum(sh.harmonics(normals, order) @ light, 0.0).astype(np.float32)
    return out
