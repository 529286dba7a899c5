"""A store with fields made ready to light: rigid objects and local lights anywhere, what stands as in other stores.

What stands is lit from its visibility bits past what moves; what moves is lit by the sky and by what stands, which rays
from sites on it see, and by the other moving things through their fields (`core.fields`). Light that was reflected
once, twice, ... is passed on between all of them. What an object reflects on itself counts with the light that fell on
it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.brdf.models import SPECULAR
from relightcli.core.brdf.separable import POLAR
from relightcli.core.fields.body import clamped_cosine
from relightcli.core.fields.chain import EVEN, light_at, open_rows, passing, put_reflections
from relightcli.core.fields.close import Close, add_samples, covered, look_close, sent
from relightcli.core.fields.dimmed import dim, may_block, sky_basis, sky_terms
from relightcli.core.fields.entities import Entity, Lookup, look_up
from relightcli.core.fields.shade import diffuse, never_negative, specular
from relightcli.core.fields.standing import (
    CELLS,
    Views,
    light_from_lobes,
    light_from_sky,
    light_from_surfaces,
    look_around,
    sky_cells,
    unhidden,
)
from relightcli.core.lights.environment import SkyCube, latlong_to_cube, splat
from relightcli.core.shade.bounces import Exit
from relightcli.core.shade.gather import Gather
from relightcli.core.shade.lobe_factors import LobeFactors
from relightcli.core.shade.low_order import response, shade_low_order
from relightcli.core.sphere import sh
from relightcli.core.transport.light_visibility import light_bits
from relightcli.core.transport.local_lights import LocalLights, pack_lights
from relightcli.core.transport.transfer import local_rotations
from relightcli.errors import InputError
from relightcli.scene.model import Material
from relightcli.scene.moving import apply_moves, inverse_affine, move_geometry
from relightcli.stages.lighting import LightingStore, Radiance, _Coats
from relightcli.stages.placed import Mover, light_entity, read_lights, read_movers

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
SLAB = 8192  # receivers whose sky terms are made at a time


@dataclass
class _Placed:
    """Everything that hangs on where things are, and on nothing else.

    Targets, where light is looked up: the standing receivers, then of every mover its proxies and its points.
    entities: the movers, then the local lights; rows: their samples' (`chain.open_rows`), emitted light included;
    close: per mover its close points, and their rows; targets: slices of every mover's proxies and points;
    passed (n, N): what all movers let pass to the standing receivers; covered (receivers,): what nothing can see;
    views: what stands, from each mover's sites; thinned: the lookup with what stands before an entity taken off its
    weight; gather of the standing receivers, light_bits of all, once they are needed.
    """

    entities: list[Entity]
    points: F64
    lookup: Lookup
    rows: F32
    close: list[tuple[Close, slice]]
    targets: list[tuple[slice, slice]]
    passed: F32
    covered: NDArray[np.bool_]
    views: list[Views]
    thinned: Lookup
    gather: Gather | None = None
    light_bits: NDArray[np.uint8] | None = None


class MovingStore(LightingStore):
    """An open store with fields, with the interface of `LightingStore`."""

    def __init__(self, store: Path | formats.Store, threads: int) -> None:
        super().__init__(store, threads)
        self.movers: list[Mover] = read_movers(self.store, self.scene.materials, self.scene.objects)
        self.order = int(self.store.settings["fields"]["order"])
        self.static = min(mover.rows.start for mover in self.movers)
        self._rest = self.geometry, self.position, self.normal
        self._now = self.scene
        self._sources = read_lights(self.store, self.scene.lights)
        keep = ~np.isin(self.geometry.face_object, [self.geometry.object_names.index(m.name) for m in self.movers])
        self._faces = self.geometry.faces[keep]
        self._still = Tracer(self.geometry.positions, self._faces)
        self._placed: _Placed | None = None
        self._seen_from: dict[tuple[str, bytes], Views] = {}
        self._sky: tuple[NDArray[np.float64], F32, NDArray[np.float64]] | None = None
        self._bits_of_lights: dict[tuple[object, ...], NDArray[np.uint8]] = {}
        self._at_proxies: list[F32] = []

    def set_moves(self, moves: tuple[str, ...]) -> list[str]:
        """Puts objects and local lights where `--move` says, those not named where the scene file has them.

        Raises InputError for what is not there or does not move, and for objects that change their shape.
        """
        geometry, position, normal = self._rest
        now = apply_moves(self.scene, moves)
        moved = move_geometry(geometry, self.scene, now)
        position, normal = position.copy(), normal.copy()
        for mover in self.movers:
            entity = mover.at(self._matrix(mover, now.objects[mover.name].transform))
            turn = entity.rotation
            position[mover.rows] = entity.scale * (mover.body.point @ turn.T) + entity.translation
            normal[mover.rows] = mover.body.normal @ turn.T
        self._now, self.geometry, self.position, self.normal = now, moved, position, normal
        self._placed = None
        return []

    def _matrix(self, mover: Mover, transform: F64) -> F64:
        """From the field's frame to the world, after a move to `transform`."""
        stored = self.scene.objects[mover.name].transform
        if np.array_equal(stored, transform):
            return mover.placement
        return transform @ inverse_affine(stored) @ mover.placement

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
        """See `LightingStore.exit_radiance`. Raises InputError where a mover's material is not its fields'."""
        for mover in self.movers:
            if materials[mover.material] != self.scene.materials[mover.material]:
                raise InputError(
                    f"--set {mover.material}: is the material of {mover.name!r}, which moves: its fields hold for the "
                    "material in the scene file. Change it there and precompute again, or add --reference."
                )
        return super().exit_radiance(environment, rotate, materials, view, active, basis, bounces)

    def buried(self) -> NDArray[np.bool_]:
        """See `LightingStore.buried`. What a mover stands on cannot be seen either."""
        return self._where().covered

    # -- where things are

    def _where(self) -> _Placed:
        if self._placed is None:
            self._placed = self._place()
        return self._placed

    def _place(self) -> _Placed:
        entities = [m.at(self._matrix(m, self._now.objects[m.name].transform)) for m in self.movers]
        entities += [light_entity(self._sources[k], self.scene.lights[k], v) for k, v in self._now.lights.items()]
        points, skip, targets = [self.position[: self.static]], [np.full(self.static, -1)], []
        at = self.static
        for e, mover in enumerate(self.movers):
            own = entities[e].proxies, self.position[mover.rows]
            points += own
            middle, end = at + len(own[0]), at + len(own[0]) + len(own[1])
            skip.append(np.full(end - at, e))
            targets.append((slice(at, middle), slice(middle, end)))
            at = end
        places, without = np.concatenate(points), np.concatenate(skip).astype(np.int32)
        lookup = look_up(entities, places, without, self.threads)
        rows = open_rows(entities, lookup, self.order, threads=self.threads)
        close = []
        hidden = super().buried().copy()
        for e, mover in enumerate(self.movers):
            found = look_close(entities[e], e, mover.body, mover.tracer, places, lookup)
            lookup, rows, where = add_samples(lookup, rows, found, e, entities[e].turn(self.order))
            close.append((found, where))
            under = found.target[found.target < self.static]
            part = covered(found, self.normal[under], entities[e].rotation)
            hidden[under[part]] = True
        views = [self._views_of(mover, entities[e]) for e, mover in enumerate(self.movers)]
        weight = lookup.weight.copy()
        for (proxies, on), mover, entity, seen in zip(targets, self.movers, entities, views, strict=False):
            for other, thing in enumerate(entities):
                if thing is entity:
                    continue
                sites = _in_world(entity, mover.sites)
                share = unhidden(seen, sites, *_ball(thing))
                weight[proxies, other] *= share[: mover.proxies, None]
                weight[on, other] *= mover.spread.blend(share[mover.proxies :, None])
        passed = passing(_part(lookup, slice(0, self.static)), _dark(rows), self.threads)
        return _Placed(
            entities, places, lookup, rows, close, targets, passed, hidden, views, lookup._replace(weight=weight)
        )

    def _views_of(self, mover: Mover, entity: Entity) -> Views:
        """What stands, from the sites of an object; the last place of each is kept."""
        key = mover.name, np.concatenate([entity.rotation.ravel(), entity.translation, [entity.scale]]).tobytes()
        if key not in self._seen_from:
            for old in [k for k in self._seen_from if k[0] == mover.name]:
                del self._seen_from[old]
            # Without a mesh that is seen from pixels there is a receiver for every vertex that anything can see.
            front, back = self.receiver_of_vertex()
            sites = _in_world(entity, mover.sites)
            geometry = self.geometry
            self._seen_from[key] = look_around(self._still, geometry.positions, self._faces, front, back, sites)
        return self._seen_from[key]

    # -- light of the sky and the local lights

    def _sky_terms(self, sky: SkyCube) -> tuple[F32, NDArray[np.float64]]:
        """W of the standing receivers (`core.fields.dimmed`), and the cells that sites see the sky through."""
        if self._sky is None or not np.array_equal(self._sky[0], sky.flux):
            basis = sky_basis(splat(sky), self.order)
            terms = np.empty((self.static, 3, self.order**2), np.float32)
            for block, bits in self.blocks(0, self.static):
                for a in range(block.start, block.stop, SLAB):
                    part = slice(a, min(a + SLAB, block.stop))
                    seen = bits[a - block.start : part.stop - block.start]
                    terms[part] = sky_terms(seen, self.normal[part], basis)
            self._sky = sky.flux, terms, sky_cells(sky, self.order)
        return self._sky[1:]

    def _irradiance(self, sky: SkyCube, active: NDArray[np.bool_] | None, basis: str) -> NDArray[np.float32]:
        still = np.zeros(len(self), bool)
        still[: self.static] = True if active is None else active[: self.static]
        out = np.zeros((len(self), 3), np.float32)
        if not still.any():
            return out
        whole = super()._irradiance(sky, still, basis)[: self.static]
        terms, _ = self._sky_terms(sky)
        hidden = -self._where().passed
        hidden[:, 0] += EVEN
        lost = (terms * hidden[:, None, :]).sum(axis=2)
        out[: self.static] = np.clip(whole - lost, 0.0, whole)
        return out

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
        found = super()._direct(environment, rotate, coats, view, looked_at, active, basis)
        sky = latlong_to_cube(environment, self.resolution, rotate)
        _, cells = self._sky_terms(sky)
        placed = self._where()
        from_sky = [light_from_sky(views, cells) for views in placed.views]
        self._light_movers(placed, placed.rows, from_sky, view, found.diffuse, found.specular)
        return found

    def _light_movers(
        self,
        placed: _Placed,
        rows: F32,
        behind: list[F32],
        view: NDArray[np.float32] | None,
        out: F32,
        shine: F32 | None,
    ) -> None:
        """Exit radiance of the movers into out and shine, and light at their proxies; behind: at each one's sites, what
        comes from behind all other entities."""
        self._at_proxies = []
        for e, (mover, entity) in enumerate(zip(self.movers, placed.entities, strict=False)):
            both = slice(placed.targets[e][0].start, placed.targets[e][1].stop)
            far = np.concatenate([behind[e][: mover.proxies], mover.spread.blend(behind[e][mover.proxies :])])
            light = light_at(_part(placed.thinned, both), rows, far, self.threads)
            self._at_proxies.append(light[: mover.proxies])
            own = np.ascontiguousarray(light[mover.proxies :])
            turn = entity.turn(self.order)
            out[mover.rows] = never_negative(diffuse(mover.receivers, own, turn, self.threads))[0]
            if shine is None:
                continue
            shine[mover.rows] = 0.0
            if mover.body.terms > 1 and view is not None:
                towards = np.ascontiguousarray(view[mover.rows] @ entity.rotation, np.float32)
                lobe = mover.body.lobe
                lit = specular(mover.receivers, own, turn, towards, lobe, mover.colour, self.threads)
                shine[mover.rows] = never_negative(lit)[0]

    def _exact_specular(
        self,
        sky: SkyCube,
        environment: NDArray[np.float32],
        rotate: float,
        coats: _Coats,
        view: NDArray[np.float32],
        rows: NDArray[np.int64],
    ) -> NDArray[np.float32]:
        """What stands mirrors the sky as far as the movers let the mirrored view pass."""
        still = rows[rows < self.static]
        out = super()._exact_specular(sky, environment, rotate, coats, view, still)
        n, v = self.normal[still].astype(np.float64), view[still].astype(np.float64)
        mirrored = 2.0 * (n * v).sum(axis=1, keepdims=True) * n - v
        mirrored /= np.maximum(np.linalg.norm(mirrored, axis=1, keepdims=True), 1e-300)
        passed = (sh.harmonics(mirrored, self.order) * self._where().passed[still]).sum(axis=1)
        out[still] *= np.clip(passed, 0.0, 1.0)[:, None].astype(np.float32)
        return out

    def _local_lights(self) -> tuple[NDArray[np.uint8], LocalLights] | None:
        """See `LightingStore._local_lights`: past what stands and, traced for every placement, what moves. Nothing of
        what moves itself, which sees the lights' fields."""
        if not self._now.lights:
            return None
        placed, n = self._where(), self.static
        lights = pack_lights(self._now.lights.values())
        if placed.light_bits is None:
            still = self._past_what_stands()
            bits = np.zeros((len(self), still.shape[1]), np.uint8)
            bits[:n] = still
            near = np.zeros(n, bool)
            for light in placed.entities[len(self.movers) :]:
                for mover in placed.entities[: len(self.movers)]:
                    near |= may_block(self.position[:n], *_ball(light), *_ball(mover))
            rows = np.flatnonzero(near)
            own = np.isin(self.geometry.face_object, [self.geometry.object_names.index(m.name) for m in self.movers])
            tracer = Tracer(self.geometry.positions, self.geometry.faces[own])
            bits[rows] &= light_bits(tracer, lights, self.position[rows], self.normal[rows])[0]
            placed.light_bits = bits
        return placed.light_bits, lights

    def _past_what_stands(self) -> NDArray[np.uint8]:
        if self._now.lights == self.scene.lights:
            bits: Any = self.store.read("lights/bits")
            return np.asarray(bits[: self.static])
        key = tuple(self._now.lights.values())
        if key not in self._bits_of_lights:
            rows = slice(0, self.static)
            tracer = None if self.store.attrs["nothing_blocks"] else self._still
            found, _ = light_bits(tracer, pack_lights(key), self.position[rows], self.normal[rows])
            self._bits_of_lights = {key: found}
        return self._bits_of_lights[key]

    def _irradiance_of(self, light: F32) -> F32:
        """Irradiance (n, 3) of the standing receivers under light (n, 3, N), past nothing."""
        factors = sh.harmonics(self.normal[: self.static].astype(np.float64), self.order) * clamped_cosine(self.order)
        out: F32 = np.maximum((light * factors[:, None, :].astype(np.float32)).sum(axis=2), 0.0)
        return out

    # -- light that was reflected

    def gather(self, first: int = 0) -> Gather:
        """Who of what stands sees whom, past what moves. See `LightingStore.gather`."""
        placed = self._where()
        if placed.gather is not None:
            return placed.gather
        whole = super().gather(0)
        n = self.static
        if whole is None:
            nothing = np.zeros(0, np.float32)
            start = np.zeros(n + 1, np.int64)
            whole = Gather(CELLS, start, np.zeros(0, np.int32), np.zeros(0, np.int16), nothing, nothing)
        last = int(whole.start[n])
        own = Gather(
            whole.cells,
            whole.start[: n + 1],
            whole.source[:last],
            whole.cell[:last],
            whole.cosine[:last],
            whole.solid_angle[:last],
        )
        if not last:
            placed.gather = own
            return own
        centers, radii = (np.array(x) for x in zip(*(_ball(e) for e in placed.entities), strict=True))
        hidden = np.zeros((n, len(placed.entities), self.order**2), np.float32)
        for e in range(len(self.movers)):
            weight = placed.lookup.weight[:n, e]
            rows = placed.rows[:, 0]
            hidden[:, e, 0] = EVEN * weight.sum(axis=1)
            for k in range(weight.shape[1]):
                hidden[:, e] -= weight[:, k, None] * rows[placed.lookup.place[:n, e, k]]
        placed.gather, share = dim(own, self.position, hidden, centers, radii, self.threads)
        placed.thinned.weight[:n] *= share[:, :, None]
        return placed.gather

    def _reflected(
        self,
        coats: _Coats,
        view: NDArray[np.float32] | None,
        light: Exit,
        factors: LobeFactors,
        e: NDArray[np.float32],
        specular: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """See `LightingStore._reflected`: the movers' light is added, and theirs is made."""
        placed, n = self._where(), self.static
        rows = placed.rows.copy()
        rows[:, 1:] = 0.0
        put_reflections(rows, placed.entities, placed.lookup, self._lights(placed), threads=self.threads)
        for (close, where), mover, entity in zip(placed.close, self.movers, placed.entities, strict=False):
            rows[where, 1:] = sent(close, mover.body, light.diffuse[mover.rows], entity.turn(self.order))
        none = np.zeros((3, self.order**2))
        arriving = light_at(_part(placed.thinned, slice(0, n)), rows, none, self.threads)
        e[:n] += self._irradiance_of(arriving)
        out = coats.diffuse(e)
        if view is not None:
            self._mirror(coats, view, arriving, specular)
        behind = []
        for views in placed.views:
            behind.append(light_from_surfaces(views, light.diffuse, self.order, placed.covered))
            if len(light.lobe):
                normals, material = self.normal, coats.material
                behind[-1] += light_from_lobes(views, light, normals, material, factors, self.order, placed.covered)
        self._light_movers(placed, rows, behind, view, out, specular)
        return out

    def _lights(self, placed: _Placed) -> list[F32]:
        """Light at the proxies of every entity; local lights have none."""
        nothing = np.zeros((0, 3, self.order**2), np.float32)
        return [*self._at_proxies, *[nothing] * (len(placed.entities) - len(self.movers))]

    def _mirror(self, coats: _Coats, view: NDArray[np.float32], arriving: F32, out: F32) -> None:
        """Adds what shiny standing receivers send of the movers' light to out (N, 3)."""
        rows = np.flatnonzero(coats.shiny[: self.static])
        if not len(rows):
            return
        turned = local_rotations(self.normal[rows], self.order)
        local = np.einsum("nst,nct->ncs", turned, arriving[rows]).astype(np.float32)
        table = np.zeros((len(coats.table.model), POLAR, self.order * (self.order + 1) // 2), np.float32)
        for m in np.unique(coats.material[rows]):
            table[m] = response(int(coats.table.model[m]), coats.table.parameters[m], self.order)
        found = shade_low_order(
            np.arange(len(rows)),
            np.ascontiguousarray(local),
            np.zeros((len(rows), 3), np.float32),
            self.normal[rows],
            view[rows],
            table,
            coats.table.parameters[:, SPECULAR : SPECULAR + 3].astype(np.float32),
            coats.material[rows],
            self.threads,
        )[0]
        out[rows] += np.maximum(found, 0.0)


def _in_world(entity: Entity, points: F64) -> F64:
    out: F64 = entity.scale * (points @ entity.rotation.T) + entity.translation
    return out


def _ball(entity: Entity) -> tuple[F64, float]:
    """Centre and radius of the bounding sphere in the world."""
    return _in_world(entity, entity.own.center[None])[0], entity.scale * entity.own.radius


def _part(lookup: Lookup, rows: slice) -> Lookup:
    return lookup._replace(place=lookup.place[rows], weight=lookup.weight[rows], nearest=lookup.nearest[rows])


def _dark(rows: F32) -> F32:
    out = rows.copy()
    out[:, 1:] = 0.0
    return out
