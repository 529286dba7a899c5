"""Where movable things are in one picture, and what hangs on that alone: who sees which samples of whose field, what
stands as they see it, what they hide of it. What did not move is not made again."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.rays import Tracer
from relightcli.core.fields.chain import open_rows, passing
from relightcli.core.fields.close import Close, add_samples, covered, look_close
from relightcli.core.fields.entities import Entity, Lookup, look_up, turn_together
from relightcli.core.fields.sites import Between
from relightcli.core.fields.standing import Views, look_around, unhidden
from relightcli.core.shade.gather import Gather
from relightcli.stages.placed import Mover

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass
class Placement:
    """Everything that hangs on where things are, and on nothing else.

    Targets, where light is looked up: the standing receivers, then the proxies of all movers, then their points, in the
    order of the receivers: slices `still`, `proxies`, `points`.
    entities: the movers, then the local lights; rows: their samples' (`chain.open_rows`), emitted light included
    close: per mover its close points, where: their rows; early (T,): samples that light is needed of after every
    reflection, not only of all together; work: rows to put reflections into, what passes is in them
    shown, shown_at: the movers' points, as rows of the receivers and of the points, that close points see
    passed (n, N): what all movers let pass to the standing receivers; covered (receivers,): what nothing can see
    views: what stands, from all movers' sites; share (targets, E): of an entity, what standing things do not hide, None
    if they hide nothing; gather of the standing receivers, light_bits of all, once they are needed
    """

    entities: list[Entity]
    lookup: Lookup
    rows: F32
    close: list[Close]
    where: list[slice]
    early: NDArray[np.bool_]
    work: F32
    shown: NDArray[np.int64]
    passed: F32
    covered: NDArray[np.bool_]
    views: Views
    share: F32 | None
    still: slice
    proxies: slice
    points: slice
    gather: Gather | None = None
    light_bits: NDArray[np.uint8] | None = None

    def share_of(self, rows: slice | NDArray[np.int64]) -> F32 | None:
        return None if self.share is None else self.share[rows]


@dataclass
class Sites:
    """The movers' sites one after the other: first (M + 1,) of every mover; spread: how all movers' points take light
    from them; on_proxy: sites that are proxies. Views from them are kept while a mover stays."""

    movers: list[Mover]
    first: NDArray[np.int64] = field(init=False)
    spread: Between = field(init=False)
    on_proxy: NDArray[np.int64] = field(init=False)
    _key: list[bytes] = field(init=False)
    _views: Views | None = None
    _places: F64 | None = None

    def __post_init__(self) -> None:
        self.first = np.concatenate([[0], np.cumsum([len(m.sites) for m in self.movers])]).astype(np.int64)
        site = [self.first[e] + m.proxies + m.spread.site for e, m in enumerate(self.movers)]
        most = max(s.shape[1] for s in site)
        padded = [np.pad(s, ((0, 0), (0, most - s.shape[1])), mode="edge") for s in site]
        weight = [np.pad(m.spread.weight, ((0, 0), (0, most - m.spread.weight.shape[1]))) for m in self.movers]
        self.spread = Between(np.concatenate(padded), np.concatenate(weight))
        self.on_proxy = np.concatenate([self.first[e] + np.arange(m.proxies) for e, m in enumerate(self.movers)])
        self._key = [b""] * len(self.movers)

    def look(
        self,
        entities: list[Entity],
        tracer: Tracer,
        positions: F64,
        faces: NDArray[np.int32],
        sides: tuple[NDArray[np.int32], NDArray[np.int32]],
    ) -> tuple[Views, F64]:
        """What stands, from all sites, and where these are, (S, 3). sides: receiver on each side of every vertex."""
        moved = []
        places = np.empty((int(self.first[-1]), 3)) if self._places is None else self._places.copy()
        for e, (mover, entity) in enumerate(zip(self.movers, entities, strict=False)):
            key = np.concatenate([entity.rotation.ravel(), entity.translation, [entity.scale]]).tobytes()
            if key != self._key[e]:
                self._key[e] = key
                own = np.arange(self.first[e], self.first[e + 1])
                places[own] = in_world(entity, mover.sites)
                moved.append(own)
        if moved:
            rows = np.concatenate(moved)
            found = look_around(tracer, positions, faces, *sides, places[rows])
            if self._views is None:
                self._views = found
            else:
                for old, new in zip(self._views, found, strict=True):
                    old[rows] = new
            self._places = places
        assert self._views is not None
        return self._views, places


def place(
    movers: list[Mover],
    lights: list[Entity],
    entities: list[Entity],
    position: F64,
    normal: F32,
    buried: NDArray[np.bool_],
    static: int,
    views: Views,
    sites: Sites,
    places: F64,
    order: int,
    threads: int,
) -> Placement:
    """Looks everything up; entities of the movers; position, normal of all receivers, `static` standing ones first."""
    entities = entities + lights
    turn_together(entities, order)
    proxies = np.concatenate([np.zeros((0, 3)), *[e.proxies for e in entities]])
    owner = np.concatenate([np.full(m.rows.stop - m.rows.start, e) for e, m in enumerate(movers)])
    of_proxy = np.repeat(np.arange(len(movers)), [m.proxies for m in movers])
    points = np.concatenate([position[:static], proxies, position[static:]])
    skip = np.concatenate([np.full(static, -1), of_proxy, owner]).astype(np.int32)
    still, middle = slice(0, static), slice(static, static + len(proxies))
    last = slice(middle.stop, len(points))
    lookup = look_up(entities, points, skip, threads)
    rows = open_rows(entities, lookup, order, threads=threads)
    close = [look_close(entities[e], e, m.body, m.tracer, points, lookup) for e, m in enumerate(movers)]
    rows, where = add_samples(lookup, rows, close, [entities[e].turn(order) for e in range(len(movers))])
    hidden = buried.copy()
    shown = []
    for mover, entity, found in zip(movers, entities, close, strict=False):
        under = found.target[found.target < static]
        hidden[under[covered(found, normal[under], entity.rotation)]] = True
        seen = np.unique(found.found.point)
        shown.append(mover.rows.start + seen[seen >= 0].astype(np.int64))
    some = np.concatenate(shown)
    early = lookup.points(slice(0, middle.stop)).read(len(rows))
    if len(some):
        early |= lookup.points(last.start + some - static).read(len(rows))
    centers, radii = (np.array(x) for x in zip(*(ball(e) for e in entities), strict=True))
    free = unhidden(views, places, centers, radii, threads)
    share = None
    if (free < 1.0).any():
        share = np.ones((len(points), len(entities)), np.float32)
        share[middle] = free[sites.on_proxy]
        share[last] = sites.spread.blend(free)
    dark = rows.copy()
    dark[:, 1:] = 0.0
    passed = passing(lookup.points(still), dark, threads, 1.0 / order**2)
    return Placement(
        entities, lookup, rows, close, where, early, dark, some, passed, hidden, views, share, still, middle, last
    )


def in_world(entity: Entity, points: F64) -> F64:
    out: F64 = entity.scale * (points @ entity.rotation.T) + entity.translation
    return out


def ball(entity: Entity) -> tuple[F64, float]:
    """Centre and radius of the bounding sphere in the world."""
    return in_world(entity, entity.own.center[None])[0], entity.scale * entity.own.radius
