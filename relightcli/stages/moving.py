"""A store with fields made ready to light: rigid objects and local lights anywhere, what stands as in other stores.

What stands is lit from its visibility bits past what moves; what moves is lit by the sky and by what stands, which rays
from sites on it see, and by the other moving things through their fields (`core.fields`). Light that was reflected
once, twice, ... is passed on between all of them. What an object reflects on itself counts with the light that fell on
it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.meshes import MAX_COORDINATE
from relightcli.adapters.rays import Tracer
from relightcli.core.brdf.models import SPECULAR
from relightcli.core.brdf.separable import POLAR
from relightcli.core.fields.body import cosine_weights
from relightcli.core.fields.chain import EVEN, light_at, put_reflections
from relightcli.core.fields.close import sent
from relightcli.core.fields.dimmed import dim, hidden_by, may_block, passing_mirrored, sky_basis, sky_terms
from relightcli.core.fields.shade import diffuse, diffuse_by_order, never_negative, specular
from relightcli.core.fields.sites import Between
from relightcli.core.fields.standing import (
    CELLS,
    light_from_lobes,
    light_from_sky,
    light_from_surfaces,
    sky_cells,
)
from relightcli.core.lights.environment import SkyCube, splat
from relightcli.core.shade.bounces import Exit
from relightcli.core.shade.gather import Gather
from relightcli.core.shade.lobe_factors import LobeFactors
from relightcli.core.shade.low_order import response, shade_low_order
from relightcli.core.shade.seen_points import point_irradiance, point_lobes
from relightcli.core.transport.light_visibility import light_bits
from relightcli.core.transport.local_lights import LocalLights, pack_lights
from relightcli.core.transport.transfer import local_rotations
from relightcli.scene.model import Geometry, Material
from relightcli.scene.moving import apply_moves, inverse_affine, move_geometry
from relightcli.stages.lighting import LightingStore, Radiance, _Coats
from relightcli.stages.placed import Mover, field_order, light_entity, read_lights, read_movers
from relightcli.stages.placement import Placement, Sites, ball, place
from relightcli.stages.suns import Suns

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
STEPS = ("views", "look_up", "reflections", "light", "suns", "all")
SLAB = 8192  # receivers whose sky terms are made at a time
ALL_ORDERS = 3  # interreflections from which on those of a mover on itself are not told apart in a picture's sum


@dataclass
class _Passed:
    """Light on its way in one picture: at the proxies after the last reflection, (P, 3, N); and, of all reflections so
    far together, that which was reflected again, at the proxies, at the sites from behind (S, 3, N), and what the
    samples send that are read early, and the close points', in rows as `chain.open_rows` has them.

    number of the last reflection; before: the same as it was one earlier, if that is needed; at_points: light at the
    movers' points that were lit, of the last reflections, the last one first."""

    at_proxies: F32
    reflected: F32
    behind: F32
    rows: F32
    number: int = 0
    before: _Passed | None = None
    at_points: tuple[F32, ...] = ()


class MovingStore(LightingStore):
    """An open store with fields, with the interface of `LightingStore`."""

    streams = False  # what is seen depends on the places, and is kept
    _moved: Geometry | None

    def __init__(self, store: Path | formats.Store, threads: int) -> None:
        super().__init__(store, threads)
        movers = read_movers(self.store, self.scene.materials, self.scene.objects)
        self.movers: list[Mover] = sorted(movers, key=lambda mover: mover.rows.start)
        self.order = field_order(self.store)
        self.static = min(mover.rows.start for mover in self.movers)
        self._rest = self.geometry, self.position, self.normal
        self._now = self.scene
        self._sources = read_lights(self.store, self.scene.lights)
        keep = ~np.isin(self.geometry.face_object, [self.geometry.object_names.index(m.name) for m in self.movers])
        self._faces = self.geometry.faces[keep]
        self._standing: F64 = self.geometry.positions
        self._still = Tracer(self._standing, self._faces, self.threads)
        self._placed: Placement | None = None
        # Without a mesh that is seen from pixels there is a receiver for every vertex that anything can see.
        self._sides = self.receiver_of_vertex()
        self._sites = Sites(self.movers)
        self._terms: tuple[F64, F32] | None = None
        self._cells: list[tuple[F64, F64]] = []
        self._suns: Suns | None = None
        self._sunlight: Radiance | None = None
        self._pictures = 0
        self._seconds: dict[str, float] = dict.fromkeys(STEPS, 0.0)
        self._bits_of_lights: dict[tuple[object, ...], NDArray[np.uint8]] = {}
        self._passed: _Passed | None = None
        self._asked_bounces = 0
        self._cosines: F32 | None = None  # of the standing receivers
        self._undimmed: tuple[F64, NDArray[np.bool_], str, F32] | None = None

    def set_moves(self, moves: tuple[str, ...]) -> list[str]:
        """Puts objects and local lights where `--move` says, those not named where the scene file has them.

        Raises InputError for what is not there or does not move, and for objects that change their shape.
        """
        geometry, position, normal = self._rest
        now = apply_moves(self.scene, moves)
        position, normal = position.copy(), normal.copy()
        for mover in self.movers:
            entity = mover.at(self._matrix(mover, now.objects[mover.name].transform))
            turn = entity.rotation
            position[mover.rows] = entity.scale * (mover.body.point @ turn.T) + entity.translation
            normal[mover.rows] = mover.body.normal @ turn.T
            center, radius = ball(entity)
            if np.abs(center).max() + radius > MAX_COORDINATE:
                move_geometry(geometry, self.scene, now)  # which says what is wrong, if it is
        self._now, self.position, self.normal = now, position, normal
        self._moved = self._placed = None
        return []

    @property
    def editable(self) -> set[str]:
        """Adjustable materials whose colours may be changed: of what moves, those that its fields hold for."""
        fixed = {mover.material for mover in self.movers if mover.kept is None}
        return set(self.scene.materials) - fixed

    @property
    def geometry(self) -> Geometry:
        """The mesh where things are now; made when it is asked for."""
        if self._moved is None:
            self._moved = move_geometry(self._rest[0], self.scene, self._now)
        return self._moved

    @geometry.setter
    def geometry(self, value: Geometry) -> None:
        self._moved = value

    def _matrix(self, mover: Mover, transform: F64) -> F64:
        """From the field's frame to the world, after a move to `transform`."""
        stored = self.scene.objects[mover.name].transform
        if np.array_equal(stored, transform):
            return mover.placement
        return transform @ inverse_affine(stored) @ mover.placement

    def costs(self) -> dict[str, Any]:
        """Mean seconds a picture by step; of the last picture, samples that were made, the share of all reads that
        found theirs made, and rays to suns."""
        if self._placed is None:
            return {}
        made = len(self._placed.rows)
        reads = int(np.count_nonzero(self._placed.lookup.weight))
        return {
            "seconds": {name: seconds / max(self._pictures, 1) for name, seconds in self._seconds.items()},
            "samples": made,
            "sample_hits": 1.0 - made / max(reads, made, 1),
            "sun_rays": 0 if self._suns is None else self._suns.rays,
        }

    @contextmanager
    def _step(self, name: str) -> Iterator[None]:
        started = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[name] += time.perf_counter() - started

    def trace_suns(self) -> None:
        """See `LightingStore.trace_suns`."""
        self._suns = Suns(self._still, self.position[: self.static], self.normal[: self.static])

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
        """See `LightingStore.exit_radiance`. Raises InputError where a mover's fields do not hold for its material."""
        for e, mover in enumerate(self.movers):
            self.movers[e] = mover.dyed(materials[mover.material])
            if self._placed is not None:
                self._placed.entities[e] = replace(self._placed.entities[e], own=self.movers[e].own)
        self._asked_bounces = self.bounces if bounces is None else bounces
        started = time.perf_counter()
        parts = super().exit_radiance(environment, rotate, materials, view, active, basis, bounces)
        if not self.apart:
            for part in parts[1:]:
                part.diffuse[self.static :] = 0.0  # of points that others see: they were needed on the way
            self._light_together(parts[0], view)
        self._pictures += 1
        self._seconds["all"] += time.perf_counter() - started
        return parts

    def buried(self) -> NDArray[np.bool_]:
        """See `LightingStore.buried`. What a mover stands on cannot be seen either."""
        return self._where().covered

    # -- where things are

    def _where(self) -> Placement:
        if self._placed is None:
            entities = [m.at(self._matrix(m, self._now.objects[m.name].transform)) for m in self.movers]
            lights = [light_entity(self._sources[k], self.scene.lights[k], v) for k, v in self._now.lights.items()]
            with self._step("views"):
                seen = self._sites.look(entities, self._still, self._standing, self._faces, self._sides)
            with self._step("look_up"):
                self._placed = place(
                    self.movers,
                    lights,
                    entities,
                    self.position,
                    self.normal,
                    super().buried(),
                    self.static,
                    seen[0],
                    self._sites,
                    seen[1],
                    self.order,
                    self.threads,
                )
        return self._placed

    # -- light of the sky and the local lights

    def _sky_terms(self, sky: SkyCube) -> F32:
        """W of the standing receivers (`core.fields.dimmed`)."""
        if self._terms is None or not np.array_equal(self._terms[0], sky.flux):
            basis = sky_basis(splat(sky), self.order)
            terms = np.empty((self.static, 3, self.order**2), np.float32)
            for block, bits in self.blocks(0, self.static):
                for a in range(block.start, block.stop, SLAB):
                    part = slice(a, min(a + SLAB, block.stop))
                    seen = bits[a - block.start : part.stop - block.start]
                    terms[part] = sky_terms(seen, self.normal[part], basis)
            self._terms = sky.flux, terms
        return self._terms[1]

    def _sky_cells(self, sky: SkyCube) -> F64:
        """The cells that sites see the sky through; those of the last two skies are kept."""
        for flux, cells in self._cells:
            if np.array_equal(flux, sky.flux):
                return cells
        made = sky_cells(sky, self.order)
        self._cells = [*self._cells[-1:], (sky.flux, made)]
        return made

    def _irradiance(self, sky: SkyCube, active: NDArray[np.bool_] | None, basis: str) -> NDArray[np.float32]:
        still = np.zeros(len(self), bool)
        still[: self.static] = True if active is None else active[: self.static]
        out = np.zeros((len(self), 3), np.float32)
        if not still.any():
            return out
        if self._undimmed is None or not _same(self._undimmed[:3], (sky.flux, still, basis)):
            self._undimmed = sky.flux, still, basis, super()._irradiance(sky, still, basis)[: self.static]
        whole = self._undimmed[3]
        terms = self._sky_terms(sky)
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
        placed, suns = self._where(), self._suns
        without = environment
        if suns is not None:
            suns.set_sky(environment, rotate)
            without = suns.rest
        found = super()._direct(without, rotate, coats, view, looked_at, active, basis)
        behind = light_from_sky(
            placed.views, self._sky_cells(self._cube(environment, self.resolution, rotate)), self.threads
        )
        rest = behind
        if without is not environment:
            rest = light_from_sky(
                placed.views, self._sky_cells(self._cube(without, self.resolution, rotate)), self.threads
            )
        count = placed.proxies.stop - placed.proxies.start
        nothing = np.zeros((count, 3, self.order**2), np.float32)
        self._passed = _Passed(nothing, nothing.copy(), np.zeros_like(behind), placed.rows.copy())
        self._pass_on(placed, placed.rows, behind, rest, view, found)
        self._sunlight = None
        if suns is not None and len(suns.points.flux):
            with self._step("suns"):
                self._sunlight = self._light_of(suns, coats, view)
            if self.apart:
                self._add_sunlight(found, slice(None))
            else:
                self._add_sunlight(found, slice(0, self.static))
                self._add_sunlight(found, placed.shown)
        return found

    def _light_of(self, suns: Suns, coats: _Coats, view: NDArray[np.float32] | None) -> Radiance:
        """Exit radiance of all receivers in the light of the suns."""
        placed = self._where()
        seen = suns.seen(self.movers, placed.entities, self.position, self.normal, self.threads)
        by_point = np.ascontiguousarray(seen.T)
        e = point_irradiance(by_point, suns.points, self.normal, self.threads).astype(np.float32)
        specular = np.zeros_like(e)
        if view is not None:
            rows = np.flatnonzero(coats.shiny)
            s = point_lobes(by_point, suns.points, self.normal, view, rows, coats.material, coats.table, self.threads)
            colour = coats.table.parameters[:, SPECULAR : SPECULAR + 3].astype(np.float32)
            specular[rows] = s.astype(np.float32) * colour[coats.material[rows]]
        return Radiance(coats.diffuse(e), specular)

    def _add_sunlight(self, out: Radiance, rows: slice | NDArray[np.int64]) -> None:
        if self._sunlight is None:
            return
        out.diffuse[rows] += self._sunlight.diffuse[rows]
        if out.specular is not None and self._sunlight.specular is not None:
            out.specular[rows] += self._sunlight.specular[rows]

    def _at(
        self,
        placed: Placement,
        targets: slice | NDArray[np.int64],
        rows: F32,
        far: F32,
        spread: Between | None = None,
    ) -> F32:
        """Light at targets. See `chain.light_at`."""
        with self._step("light"):
            return light_at(
                placed.lookup.points(targets),
                rows,
                far,
                self.threads,
                placed.share_of(targets),
                spread,
                1.0 / self.order**2,
                np.arange(len(placed.entities)) >= len(self.movers),
            )

    def _pass_on(
        self,
        placed: Placement,
        rows: F32,
        behind: F32,
        rest: F32,
        view: NDArray[np.float32] | None,
        out: Radiance,
    ) -> None:
        """Light at the proxies, of rows and, from behind all, at the sites; and exit radiance of the movers into out:
        of all points where reflections are wanted apart, else of those that close points see. rest: what the points
        get from behind all, which may be less than what is reflected."""
        passed = self._passed
        assert passed is not None
        passed.at_proxies = self._at(placed, placed.proxies, rows, behind[self._sites.on_proxy])
        passed.behind += rest
        spread = self._sites.spread
        if self.apart:
            light = self._at(placed, placed.points, rows, rest, spread=spread)
            chosen = None
        elif len(placed.shown):
            chosen = placed.shown
            own = chosen - self.static
            some = Between(spread.site[own], spread.weight[own])
            light = self._at(placed, own + placed.points.start, rows, rest, spread=some)
        else:
            return
        passed.at_points = (light, *passed.at_points[:2])
        self._light_points(placed, passed.at_points, chosen, view if self.apart else None, out)

    def _light_together(self, out: Radiance, view: NDArray[np.float32] | None) -> None:
        """Exit radiance of the movers' points, of all reflections, into out.

        What an object reflects on itself is a reflection more. Of so many reflections that its share in the last of
        them is nothing (ALL_ORDERS), all of it is taken."""
        placed, passed = self._where(), self._passed
        assert passed is not None
        lights = [self._all_light(placed, passed)]
        if passed.before is not None:
            lights += [self._all_light(placed, passed.before)] * self._asked_bounces
        self._light_points(placed, lights, None, view, out)
        self._add_sunlight(out, slice(self.static, len(self)))

    def _all_light(self, placed: Placement, passed: _Passed) -> F32:
        """Light at all points of the movers, of all reflections so far."""
        with self._step("reflections"):
            put_reflections(
                passed.rows,
                placed.entities,
                placed.lookup,
                self._lights(passed.reflected),
                threads=self.threads,
                wanted=~placed.early,
            )
        return self._at(placed, placed.points, passed.rows, passed.behind, spread=self._sites.spread)

    def _light_points(
        self,
        placed: Placement,
        lights: Sequence[F32],
        chosen: NDArray[np.int64] | None,
        view: NDArray[np.float32] | None,
        out: Radiance,
    ) -> None:
        """Exit radiance of the movers' points, or of the chosen receivers of theirs (rising), into out; lights: at
        them, see `shade.diffuse_by_order`. In a picture of all reflections together, without a light for what the
        object has reflected itself, that counts with the light that fell on it."""
        shine = out.specular
        whole = not self.apart and chosen is None and self._asked_bounces >= ALL_ORDERS
        for mover, entity in zip(self.movers, placed.entities, strict=False):
            receivers, turn = mover.receivers, entity.turn(self.order)
            where: slice | NDArray[np.int64] = mover.rows
            own = slice(mover.rows.start - self.static, mover.rows.stop - self.static)
            if chosen is not None:
                a, b = np.searchsorted(chosen, [mover.rows.start, mover.rows.stop])
                where, own = chosen[a:b], slice(int(a), int(b))
                receivers = receivers.at(where - mover.rows.start)
            parts = [light[own] for light in lights]
            if whole:
                found = diffuse(receivers, parts[0], turn, self.threads)
            else:
                found = diffuse_by_order(receivers, parts, turn, self.threads)
            out.diffuse[where] = never_negative(found)[0]
            if shine is None or chosen is not None:
                continue
            shine[mover.rows] = 0.0
            if mover.body.terms > 1 and view is not None:
                towards = np.ascontiguousarray(view[mover.rows] @ entity.rotation, np.float32)
                lit = specular(receivers, parts[0], turn, towards, mover.body.lobe, mover.colour, self.threads)
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
        out[still] *= passing_mirrored(self._where().passed[still], self.normal[still], view[still])[:, None]
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
                    near |= may_block(self.position[:n], *ball(light), *ball(mover))
            rows = np.flatnonzero(near)
            own = np.isin(self.geometry.face_object, [self.geometry.object_names.index(m.name) for m in self.movers])
            tracer = Tracer(self.geometry.positions, self.geometry.faces[own], self.threads)
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
        if self._cosines is None:
            self._cosines = cosine_weights(self.normal[: self.static], self.order)
        out: F32 = np.maximum((light * self._cosines[:, None, :]).sum(axis=2), 0.0)
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
        centers, radii = (np.array(x) for x in zip(*(ball(e) for e in placed.entities), strict=True))
        hidden = hidden_by(placed.lookup.points(placed.still), placed.rows[:, 0], len(self.movers))
        placed.gather, share = dim(own, self.position, hidden, centers, radii, self.threads)
        if (share < 1.0).any():
            if placed.share is None:
                placed.share = np.ones((len(placed.lookup.place), len(placed.entities)), np.float32)
            placed.share[:n] = share
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
        placed, n, passed = self._where(), self.static, self._passed
        assert passed is not None
        rows = placed.work
        wanted = None if self.apart else placed.early
        passed.number += 1
        if not self.apart and passed.number == self._asked_bounces < ALL_ORDERS:
            kept = passed.reflected.copy(), passed.behind.copy(), passed.rows.copy()
            passed.before = _Passed(passed.at_proxies, *kept)
        lights = self._lights(passed.at_proxies)
        passed.reflected += passed.at_proxies
        with self._step("reflections"):
            put_reflections(rows, placed.entities, placed.lookup, lights, threads=self.threads, wanted=wanted)
        for k, (close, where) in enumerate(zip(placed.close, placed.where, strict=True)):
            if not len(close.target):
                continue
            mover, turn = self.movers[k], placed.entities[k].turn(self.order)
            rows[where, 1:] = sent(close, mover.body, light.diffuse[mover.rows], turn)
        if not self.apart:
            passed.rows[:, 1:] += rows[:, 1:]
        none = np.zeros((3, self.order**2), np.float32)
        arriving = self._at(placed, placed.still, rows, none)
        e[:n] += self._irradiance_of(arriving)
        out = coats.diffuse(e)
        if view is not None:
            self._mirror(coats, view, arriving, specular)
        behind = light_from_surfaces(placed.views, light.diffuse, self.order, placed.covered, self.threads)
        if len(light.lobe):
            normals, material = self.normal, coats.material
            behind += light_from_lobes(placed.views, light, normals, material, factors, self.order, placed.covered)
        self._pass_on(placed, rows, behind, behind, view, Radiance(out, specular))
        return out

    def _lights(self, at_proxies: F32) -> list[F32]:
        """Light at the proxies of every entity; local lights have none."""
        cuts = np.cumsum([mover.proxies for mover in self.movers])
        return [*np.split(at_proxies, cuts)[:-1], *[at_proxies[:0]] * len(self._now.lights)]

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


def _same(one: tuple[Any, ...], two: tuple[Any, ...]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))
