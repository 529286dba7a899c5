"""What may be moved, as a store has it, and where it is put for a picture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.brdf.models import MODEL_CODES, SPECULAR, pack_materials
from relightcli.core.fields.albedos import mixed, self_weights, transfer_at
from relightcli.core.fields.body import Body, axes
from relightcli.core.fields.entities import Entity, Surroundings, of_light
from relightcli.core.fields.interpolate import make_grid
from relightcli.core.fields.lobe_functions import function_weights, lobe_functions
from relightcli.core.fields.shade import Receivers
from relightcli.core.fields.sites import Between, between, outlook, spread_out
from relightcli.core.shade.low_order import response
from relightcli.core.sphere.rotation import rotation_matrices
from relightcli.errors import InputError
from relightcli.scene.model import Material, RectangleLight, SphereLight
from relightcli.stages.bodies import body_of
from relightcli.stages.field_store import KeptField, read_field, read_source

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
SITES = 64  # points of an object that look around at what stands
INWARDS = 0.01  # of the way to the centre that they lie within: what stands on a floor does not look from below it
_SLAB = 2048  # points at a time
SIMILAR = 1e-6  # relative, by which a placement may differ from a rotation and a size


@dataclass(frozen=True)
class Mover:
    """One object that may be moved. rows: its receivers; placement (4, 4): from its field's frame to where the scene
    has it; kept: the field, if the material may be changed; any_albedo: whether it holds for all of them; functions: of
    the lobe, that it was simulated for (`core.fields.lobe_functions`), None if it was not; texture (3,): the mean of
    what is multiplied to its diffuse colour; made_for: the material of `body`, `own`, `receivers` and `colour`; sites
    (S, 3) on it in the field's frame, after its proxies; spread: how its points take light from those."""

    name: str
    rows: slice
    placement: F64
    material: str
    kept: KeptField | None
    any_albedo: bool
    functions: F32 | None
    texture: F64
    made_for: Material
    body: Body
    own: Surroundings
    tracer: Tracer
    receivers: Receivers
    colour: F32
    sites: F64
    spread: Between

    @property
    def proxies(self) -> int:
        return 0 if self.own.proxies is None else len(self.own.proxies)

    def dyed(self, material: Material) -> Mover:
        """With another material. Raises InputError for what its field does not hold for."""
        if material == self.made_for:
            return self
        if self.kept is not None and self.functions is not None:
            return self._coated(self.kept, self.functions, material)
        if self.kept is None or replace(material, diffuse=self.made_for.diffuse) != self.made_for:
            raise InputError(
                f"--set {self.material}: is the material of {self.name!r}, which moves: of its fields, only the "
                "diffuse colour of an adjustable lambert material without a coloured texture, and adjustable materials "
                "with a specular lobe, can be changed. Change the scene file and precompute again, or add --reference."
            )
        own = replace(self.own, transfer=transfer_at(self.kept.transfer, material.diffuse))
        receivers = _receivers(self.body, self.kept, material, any_albedo=True)
        return replace(self, made_for=material, own=own, receivers=receivers)

    def _coated(self, kept: KeptField, functions: F32, material: Material) -> Mover:
        """With another material in the place of one with a specular lobe."""
        row = pack_materials([material]).parameters[0]
        lobe = self.body.lobe  # of a material without one: in no colour
        if any(material.specular):
            lobe = response(MODEL_CODES[material.model], row, self.body.order)
        weights = function_weights(functions, lobe, _sent(material, self.texture), row[SPECULAR : SPECULAR + 3])
        return replace(
            self,
            made_for=material,
            body=self.body._replace(lobe=lobe),
            own=replace(self.own, transfer=mixed(kept.transfer, weights)),
            receivers=_dyed(self.receivers, kept.self_by_order, material),
            colour=row[SPECULAR : SPECULAR + 3].astype(np.float32),
        )

    def at(self, matrix: F64) -> Entity:
        """The object placed by (4, 4), a rotation times a positive number and a translation."""
        return Entity(self.own, *similarity(self.name, matrix))


def similarity(name: str, matrix: F64) -> tuple[F64, F64, float]:
    """(rotation, translation, scale) of a placement. Raises InputError for other matrices."""
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    if not scale > 0.0 or np.abs(linear.T @ linear - scale**2 * np.eye(3)).max() > SIMILAR * scale**2:
        raise InputError(
            f"--move {name}: expected a matrix that turns, scales evenly and shifts the object from where the scene "
            "file has it: its fields hold for no other shape. Change the scene file and precompute again, or add "
            "--reference."
        )
    return linear / scale, matrix[:3, 3].copy(), scale


def field_order(store: formats.Store) -> int:
    """Bands of the store's fields: those chosen for a tolerance, else those asked for."""
    return int(store.attrs["fields"].get("settings", store.settings["fields"])["order"])


def read_movers(store: formats.Store, scene_materials: dict[str, Material], objects: dict[str, Any]) -> list[Mover]:
    """Everything that the store has fields of; objects: the scene's, by name."""
    order = field_order(store)
    parts: dict[tuple[int, str, bool, bool, bool], tuple[Any, ...]] = {}
    movers = []
    for name, about in store.attrs["fields"]["objects"].items():
        spec = objects[name]
        kinds = bool(about["any_albedo"]), bool(about.get("by_function"))  # which earlier stores have not
        key = int(about["field"]), str(spec.material), bool(spec.two_sided), *kinds
        if key not in parts:
            parts[key] = _read_object(store, key, scene_materials[spec.material], order)
        rows = slice(int(about["first"]), int(about["first"]) + int(about["count"]))
        movers.append(Mover(name, rows, np.array(about["placement"], np.float64), spec.material, *parts[key]))
    return movers


def _read_object(
    store: formats.Store, key: tuple[int, str, bool, bool, bool], material: Material, order: int
) -> tuple[Any, ...]:
    """The parts of a mover from `kept` on."""
    prefix = f"fields/{key[0]}/"
    read: Any = store.read
    position, face = read(f"{prefix}mesh/position"), read(f"{prefix}mesh/face")
    texture = read(f"{prefix}mesh/texture")
    body = body_of(position, read(f"{prefix}mesh/normal"), face, key[2], texture, material, order)
    kept, any_albedo, by_function = read_field(store, prefix), key[3], key[4]
    mean = np.asarray(texture, np.float64)[body.vertex].mean(axis=0)
    colour = pack_materials([material]).parameters[0, SPECULAR : SPECULAR + 3].astype(np.float32)
    transfer, functions = kept.transfer, None
    if any_albedo:
        transfer = transfer_at(transfer, material.diffuse)
    elif by_function:
        functions = lobe_functions(MODEL_CODES[material.model], order)
        transfer = mixed(transfer, function_weights(functions, body.lobe, _sent(material, mean), colour))
    used = position[np.unique(face)]
    own = Surroundings(
        make_grid(kept.radii, kept.resolution, kept.valid),
        body.center,
        np.stack([used.min(axis=0), used.max(axis=0)]),
        body.radius,
        kept.occlusion,
        transfer,
        None,
        kept.proxies,
    )
    outlooks = outlook(body.point, body.normal, body.radius)
    chosen = spread_out(outlooks, SITES)
    on_surface = body.point[chosen]
    sites = np.concatenate([kept.proxies, on_surface + INWARDS * (body.center - on_surface)])
    return (
        kept if any_albedo or by_function else None,
        any_albedo,
        functions,
        mean,
        material,
        body,
        own,
        Tracer(body.positions, body.faces),
        _receivers(body, kept, material, any_albedo),
        colour,
        sites,
        between(outlooks, outlooks[chosen]),
    )


def _sent(material: Material, texture: F64) -> F64:
    """Diffuse colour (3,) of what is sent beside a texture in grey; texture (3,): its mean."""
    grey = float(texture.mean())
    out: F64 = np.array(material.diffuse) * (texture / grey if grey > 0.0 else 0.0)
    return out


def _receivers(body: Body, kept: KeptField, material: Material, any_albedo: bool) -> Receivers:
    """What the points make of light; their texture acts in the picture."""
    of_white = kept.self_by_order
    if any_albedo:
        weights = self_weights(material.diffuse).astype(np.float32)
        parts = np.split(of_white, [1, 1 + len(weights)], axis=2)
        of_white = np.concatenate([parts[0], parts[1] @ weights, parts[2] @ weights], axis=2)
    to_frame = np.zeros((0, body.order**2, body.order**2, 1), np.float32)
    if kept.self_whole is not None:
        to_frame = np.empty_like(kept.self_whole)
        frames = axes(body.normal)
        for a in range(0, len(to_frame), _SLAB):
            part = slice(a, a + _SLAB)
            turns = rotation_matrices(frames[part], body.order)
            to_frame[part] = np.einsum("pki,pijc->pkjc", turns, kept.self_whole[part])
    none = np.zeros((0, body.order**2, 3), np.float32)
    return _dyed(Receivers(none, to_frame, body.normal), of_white, material)


def _dyed(receivers: Receivers, of_white: F32, material: Material) -> Receivers:
    """With the diffuse colour of a material; of_white (P, N, 1 + 2 C), see `KeptField`."""
    colour, colours = np.array(material.diffuse, np.float32), of_white.shape[2] // 2
    parts = tuple(part * colour for part in np.split(of_white, [1, 1 + colours], axis=2))
    return receivers._replace(to_diffuse=parts[0] + parts[1] + parts[2], by_order=parts)


def read_lights(store: formats.Store, lights: dict[str, SphereLight | RectangleLight]) -> dict[str, Surroundings]:
    """The local lights' fields, by name."""
    about = store.attrs["fields"]["lights"]
    return {name: of_light(read_source(store, f"sources/{about[name]['source']}/")) for name in lights}


def light_entity(own: Surroundings, stored: SphereLight | RectangleLight, now: SphereLight | RectangleLight) -> Entity:
    """A local light where it is now; its field has the axes that the scene file gave it."""
    rotation = np.eye(3)
    if isinstance(stored, RectangleLight) and isinstance(now, RectangleLight):
        rotation = _edges(now) @ np.linalg.inv(_edges(stored))
    return Entity(own, rotation, np.array(now.center, np.float64))


def _edges(light: RectangleLight) -> F64:
    u, v = np.array(light.edge_u), np.array(light.edge_v)
    normal = np.cross(u, v)
    return np.stack([u, v, normal / np.linalg.norm(normal)], axis=1)
