"""A scene with posed characters: who blocks whose light, and who sees whom.

Everything here hangs on the poses alone and is made when it is first asked for. Characters are traced as they stand:
the open texels of what stands still against the characters alone, the characters' own receivers against everything
else in cells (`core.pose.beside`). Characters that are not posed stand at rest, there for all others too.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.adapters.rays import Tracer
from relightcli.core.fields.dimmed import may_block
from relightcli.core.pose.beside import CELLS
from relightcli.core.shade.primary import face_normals
from relightcli.core.transport.blockers import Balls, block, bounding_balls
from relightcli.core.transport.buried import find_buried, shortest_edges
from relightcli.core.transport.hits import Surfaces, trace_hits
from relightcli.core.transport.light_visibility import light_bits
from relightcli.core.transport.local_lights import LocalLights
from relightcli.core.transport.visibility import horizon_bits, trace_visibility
from relightcli.scene.model import RectangleLight, SphereLight

if TYPE_CHECKING:
    from relightcli.core.shade.gather import Gather
    from relightcli.stages.posed import PoseStore

U8 = NDArray[np.uint8]
REFINE = 4  # texels along a side of what is probed by one ray, of receivers that are traced anew
SLAB = 1024  # receivers whose bits are unpacked at a time


class PosedScene:
    """What a pose store's receivers see in one pose of its characters.

    posed: objects that have a model and a pose; apart: those that are not there, neither as blockers nor as receivers.
    """

    def __init__(self, store: PoseStore, posed: frozenset[int], apart: frozenset[int]) -> None:
        self.store, geometry = store, store.geometry
        self.geometry = geometry
        skinned = [geometry.object_names.index(name) for name in geometry.rigs]
        there = ~np.isin(geometry.face_object, list(apart))
        self.faces, self.owner = geometry.faces[there], geometry.face_object[there]
        self.own_faces = geometry.faces[np.isin(geometry.face_object, skinned)]
        self.of_posed = np.flatnonzero(np.isin(store.object, list(posed)))
        self.at_rest = np.flatnonzero(np.isin(store.object, [k for k in skinned if k not in posed]))
        self.still = ~np.isin(store.object, [*skinned, *apart])
        self.surroundings = bool(store.store.settings.get("pose_surroundings"))
        self._skinned = skinned
        self._around: tuple[U8, U8] | None = None

    @cached_property
    def balls(self) -> Balls:
        """About the characters."""
        return bounding_balls(self.geometry.positions, self.own_faces)

    @cached_property
    def characters(self) -> Tracer:
        return Tracer(self.geometry.positions, self.own_faces, self.store.threads)

    @cached_property
    def everything(self) -> Tracer:
        return Tracer(self.geometry.positions, self.faces, self.store.threads)

    @cached_property
    def buried(self) -> NDArray[np.bool_]:
        """Which of the posed receivers are inside their own body or another, where skins meet: pictures and rays take
        no light from them."""
        geometry, store, rows = self.geometry, self.store, self.of_posed
        assert store.vertex is not None
        reach = shortest_edges(geometry.positions, self.faces)[store.vertex[rows]]
        normals, two_sided = face_normals(geometry.positions, self.faces), geometry.two_sided[self.owner]
        return find_buried(self.everything, store.position[rows], store.normal[rows], reach, normals, two_sided)

    # -- the sky

    @cached_property
    def changed(self) -> tuple[NDArray[np.int64], U8, U8]:
        """Receivers that see less or other sky than the store has it, rising, their bits there and now. Posed receivers
        are not among them: a model has what they see."""
        store = self.store
        rows, before, after = [], [], []
        for part, bits in store.stored_blocks():
            still = np.flatnonzero(self.still[part])
            if len(still):
                own = still + part.start
                found, now, _ = block(self.characters, self.balls, store.position[own], store.normal[own], bits[still])
                rows.append(own[found])
                before.append(bits[still[found]])
                after.append(now)
            rest = self.at_rest[(self.at_rest >= part.start) & (self.at_rest < part.stop)]
            if len(rest):
                rows.append(rest)
                before.append(bits[rest - part.start])
                after.append(self._trace(self.everything, rest, store.resolution, REFINE))
        number = np.concatenate(rows) if rows else np.zeros(0, np.int64)
        order = np.argsort(number, kind="stable")
        none = np.zeros((0, 6, store.resolution, store.resolution // 8), np.uint8)
        return number[order], np.concatenate([none, *before])[order], np.concatenate([none, *after])[order]

    def past(self, part: slice, bits: U8) -> U8:
        """The bits of a range of receivers as they are now, given those of the store."""
        rows, _, now = self.changed
        out = bits.copy()
        own = (rows >= part.start) & (rows < part.stop)
        out[rows[own] - part.start] = now[own]
        if self._around is not None:
            own = (self.of_posed >= part.start) & (self.of_posed < part.stop)
            out[self.of_posed[own] - part.start] = self._around[1][own]
        return out

    def look_around(self) -> tuple[U8, U8]:
        """What posed receivers see of the sky, a ray for every cell, and the same as finely as the store's bits. From
        then on `past` has these."""
        if self._around is None:
            self._around = self._look_around()
        return self._around

    def _look_around(self) -> tuple[U8, U8]:
        store = self.store
        cells = max(CELLS, int(store.store.settings.get("bounce_resolution", CELLS)))
        coarse = self._trace(self.everything, self.of_posed, cells, 1)
        horizon = horizon_bits(store.normal[self.of_posed], store.resolution)
        return coarse, finer(coarse, store.resolution) & horizon

    def beside(self, name: str, position: NDArray[np.float64], normal: NDArray[np.float32]) -> U8 | None:
        """Cells (N, 6, C, C/8) of points on a posed object that nothing but itself blocks; None where there is nothing
        else. Surroundings that are in the model already do not count."""
        geometry = self.geometry
        others = self.owner != geometry.object_names.index(name)
        if self.surroundings:
            others &= np.isin(self.owner, self._skinned)
        if not others.any():
            return None
        tracer = Tracer(geometry.positions, self.faces[others], self.store.threads)
        return trace_visibility(tracer, position, normal, CELLS, REFINE, 0).bits

    def _trace(self, tracer: Tracer, rows: NDArray[np.int64], resolution: int, refine: int) -> U8:
        store = self.store
        return trace_visibility(tracer, store.position[rows], store.normal[rows], resolution, refine, 0).bits

    # -- interreflections

    def gather(self, stored: Gather, hits: NDArray[np.int32]) -> Gather:
        """Who sees whom, from who does in the store, and the hits (N, 6, C, C) there."""
        from relightcli.core.shade.gather import build_gather, join, replace_rows

        store, cells = self.store, stored.cells
        surfaces = self._surfaces()
        rows, before, after = self.changed
        seen = []
        for start in range(0, len(rows), SLAB):
            part = slice(start, start + SLAB)
            own = rows[part]
            masked, other = _unless_changed(before[part], after[part], cells)
            found = trace_hits(
                self.everything, surfaces, store.position[own], store.normal[own], masked, cells, start, 0
            )[0]
            now = np.where(other, found, hits[own])
            seen.append(build_gather(now, after[part], store.normal[own], store.threads))
        out = replace_rows(stored, rows, join(seen)) if seen else stored
        if not len(self.of_posed):
            return out
        own, normal = self.of_posed, store.normal[self.of_posed]
        coarse, bits = self.look_around()
        found = trace_hits(self.everything, surfaces, store.position[own], normal, coarse, cells, len(rows), 0)[0]
        return replace_rows(out, own, build_gather(found, bits, normal, store.threads))

    def _surfaces(self) -> Surfaces:
        geometry, store = self.geometry, self.store
        front, back = store.receiver_of_vertex()
        two_sided = geometry.two_sided[self.owner]
        return Surfaces(geometry.positions, geometry.normals, self.faces, two_sided, front, back, store.buried())

    # -- local lights

    def light_bits(self, stored: U8, lights: LocalLights, specs: list[SphereLight | RectangleLight]) -> U8:
        """Bits of the lights' points that every receiver sees, from those past what stands still."""
        store, out = self.store, stored.copy()
        near = np.zeros(len(stored), bool)
        balls = self.balls
        for spec in specs:
            center, radius = _ball(spec)
            for x, r in zip(balls.center, balls.radius, strict=True):
                near |= may_block(store.position[: len(stored)], center, radius, x, float(r))
        rows = np.flatnonzero(near & self.still[: len(stored)])
        out[rows] &= light_bits(self.characters, lights, store.position[rows], store.normal[rows])[0]
        rows = np.flatnonzero(np.isin(store.object[: len(stored)], self._skinned))
        out[rows] = light_bits(self.everything, lights, store.position[rows], store.normal[rows])[0]
        return out


def _ball(light: SphereLight | RectangleLight) -> tuple[NDArray[np.float64], float]:
    if isinstance(light, SphereLight):
        return np.array(light.center), float(light.radius)
    u, v = np.array(light.edge_u), np.array(light.edge_v)
    return np.array(light.center), 0.5 * float(max(np.linalg.norm(u + v), np.linalg.norm(u - v)))


def _unless_changed(before: U8, after: U8, cells: int) -> tuple[U8, NDArray[np.bool_]]:
    """The bits after, with all texels open in cells where nothing has changed; and the cells (N, 6, C, C) where it
    has."""
    changed = np.zeros((len(after), 6, cells, cells), np.bool_)
    out = after.copy()
    _open_unchanged(before, after, changed, out)
    return out, changed


@njit(cache=True)
def _open_unchanged(before, after, changed, out):  # type: ignore[no-untyped-def]
    resolution, cells = after.shape[2], changed.shape[2]
    side = resolution // cells
    for i in range(len(after)):
        for f in range(6):
            for row in range(resolution):
                for byte in range(resolution // 8):
                    differ = before[i, f, row, byte] ^ after[i, f, row, byte]
                    if differ:
                        for k in range(8):
                            if (differ >> np.uint8(k)) & np.uint8(1):
                                changed[i, f, row // side, (8 * byte + k) // side] = True
            for row in range(resolution):
                for byte in range(resolution // 8):
                    for k in range(8):
                        if not changed[i, f, row // side, (8 * byte + k) // side]:
                            out[i, f, row, byte] |= np.uint8(1) << np.uint8(k)


def finer(bits: U8, resolution: int) -> U8:
    """Bits (N, 6, C, C/8) on a finer cube."""
    times = resolution // bits.shape[2]
    out = []
    for start in range(0, len(bits), SLAB):
        whole = np.unpackbits(bits[start : start + SLAB], axis=3, bitorder="little")
        out.append(np.packbits(np.repeat(np.repeat(whole, times, axis=2), times, axis=3), axis=3, bitorder="little"))
    return np.concatenate(out)
