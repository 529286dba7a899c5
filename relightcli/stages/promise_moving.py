"""`precompute --tolerance` where objects may be moved: fields that keep it, and the error with objects in other places.

Fields are simulated from coarse to fine until pictures of moved objects, every effect together, are near enough to path
tracing; the others are dropped. The check at the end moves the objects elsewhere. Characters are away meanwhile: how
they are lit is known once they can be posed (`promise_pose`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.plan import pilot
from relightcli.plan.pilot import NOTHING, Share
from relightcli.scene.model import Geometry, Scene
from relightcli.scene.moving import apply_moves, move_geometry
from relightcli.stages.fields import FieldSettings, describe, find_movers, put_fields
from relightcli.stages.measured_error import (
    GAIN,
    MORE,
    Draft,
    Judge,
    Sky,
    check_skies,
    check_views,
    edit_of,
    vertex_strips,
)
from relightcli.stages.moving import MovingStore
from relightcli.stages.precompute_config import Config

# From coarse to fine: what replaces the defaults.
RUNGS: tuple[dict[str, Any], ...] = (
    {"shells": 8, "resolution": 8, "proxies": 4, "tolerance": 0.03},
    {},
    {"order": 5, "tolerance": 0.005},
)
CHOSEN = 0.6  # of the tolerance: what pictures that settings are chosen by may be off by; places differ more than views
FAR = 0.8  # of its radius, that an object is moved
AZIMUTHS = 8  # that are tried for a way that is free
POINTS = 256  # of an object, which the way has to be free for
MOST_MOVED = 4  # objects that are moved
# Where moves begin to look for their way, in azimuths: those that settings are chosen by, and that of the check.
TRIAL, CHECK = (0.0, 3.3), 5.6


def rungs(asked: FieldSettings) -> list[FieldSettings]:
    """Settings to choose from, from coarse to fine. What is asked for other than the default stays."""
    default = FieldSettings()
    out: list[FieldSettings] = []
    for rung in RUNGS:
        made = replace(asked, **{k: v for k, v in rung.items() if getattr(asked, k) == getattr(default, k)})
        if made not in out:
            out.append(made)
    return out


def choose_fields(
    config: Config,
    promise: float,
    scene: Scene,
    source: Geometry,
    starts: tuple[int, ...],
    writer: formats.Writer,
    away: tuple[int, ...] = (),
) -> None:
    """Puts the coarsest fields that keep the tolerance into the store; where none do, the coarsest that are as good as
    any. What was tried is kept with the store, so that a run goes on where it stopped. away: objects that pictures are
    made without."""
    source = _without(source, away)
    told: list[dict[str, Any]] = list(writer.attrs.get("fields_tried", []))
    ladder = rungs(config.fields)
    places = [free_moves(scene, source, turn) for turn in TRIAL]
    cameras = list(scene.cameras.values())[: pilot.MOST_VIEWS] or check_views(scene, source, None)
    skies = {name: sky.radiance for name, sky in pilot.skies(False)}
    for number, settings in enumerate(ladder):
        if number >= len(told):
            _put(config, scene, settings, number, starts, writer)
            lighting = _open(writer, config.workers, away)
            found = moved_error(lighting, scene, source, places, cameras[:1], skies, CHOSEN * promise)
            told.append({**settings.as_json(), "share": found.share, "where": found.where})
            writer.set_attrs({"fields_tried": told})
        shares = [row["share"] for row in told]
        if shares[-1] <= CHOSEN * promise or (number and shares[-1] > (1.0 - GAIN) * shares[-2]):
            break
    best = max(CHOSEN * promise, (1.0 + GAIN) * min(shares))
    chosen = next(k for k, share in enumerate(shares) if share <= best)
    _put(config, scene, ladder[chosen], chosen, starts, writer)
    fields = len(find_movers(scene, ladder[chosen], config.subdivide, config.seed).fields)
    for number in range(len(told)):
        if number != chosen:
            for k in range(fields):
                writer.drop(f"fields/{number * fields + k}")
            for k in range(len(scene.lights)):
                writer.drop(f"sources/{number * len(scene.lights) + k}")


def _put(
    config: Config, scene: Scene, settings: FieldSettings, number: int, starts: tuple[int, ...], writer: formats.Writer
) -> None:
    """The fields of rung `number`, and where the store's objects find theirs."""
    moving = find_movers(scene, settings, config.subdivide, config.seed)
    moving = moving.renumbered(number * len(moving.fields))
    first = number * len(scene.lights)
    about = describe(moving, scene, starts, first)
    writer.set_attrs({"fields": {**about, "settings": settings.as_json()}})
    put_fields(writer, moving, scene, settings, config.workers, config.quiet, config.scheduler, first)


def _without(geometry: Geometry, away: tuple[int, ...]) -> Geometry:
    """The same without the faces of some objects."""
    there = ~np.isin(geometry.face_object, away)
    return replace(geometry, faces=geometry.faces[there], face_object=geometry.face_object[there])


class _Thinned(Draft):
    """A store without the faces of some objects."""

    def __init__(self, writer: formats.Writer, away: tuple[int, ...]) -> None:
        super().__init__(writer)
        self.there = ~np.isin(writer.read("mesh/face_object"), away)
        self.read = self._read

    def _read(self, name: str) -> NDArray[Any]:
        found = self.writer.read(name)
        return found[self.there] if name in ("mesh/face", "mesh/face_object") else found


def _open(writer: formats.Writer, threads: int, away: tuple[int, ...] = ()) -> MovingStore:
    store = _Thinned(writer, away) if away else Draft(writer)
    lighting = MovingStore(cast("formats.Store", store), threads)
    lighting.apart = False
    return lighting


def check_moved(config: Config, promise: float, scene: Scene, source: Geometry, writer: formats.Writer) -> Share:
    """The error as the scene has its objects and with them elsewhere, in views and under skies that nothing was chosen
    by."""
    places = [(), free_moves(scene, source, CHECK)]
    views = check_views(scene, source, None)
    return moved_error(_open(writer, config.workers), scene, source, places, views, check_skies(), promise)


def moved_error(
    lighting: MovingStore,
    scene: Scene,
    source: Geometry,
    places: list[tuple[str, ...]],
    cameras: list[Any],
    skies: dict[str, Sky],
    most: float,
) -> Share:
    """The largest error over places, views and skies. places: each what `--move` takes."""
    worst = NOTHING
    for moves in places:
        now = apply_moves(scene, moves)
        moved = move_geometry(source, scene, now)
        judge = Judge(now, moved, Tracer(moved.positions, moved.faces))
        lighting.set_moves(moves)
        geometry = lighting.geometry
        tracer = Tracer(geometry.positions, geometry.faces)
        front, back = lighting.receiver_of_vertex()
        strips = [vertex_strips(geometry, tracer, camera, front, back, lighting.buried()) for camera in cameras]
        edit = edit_of(scene.materials, lighting.editable)
        found = judge.error(lighting, strips, skies, lighting.bounces, lighting.bounces + MORE, edit, most)
        where = found.where + (", objects moved" if moves else "")
        if found.bound > worst.bound:
            worst = replace(found, where=where)
    return worst


def free_moves(scene: Scene, source: Geometry, turn: float) -> tuple[str, ...]:
    """Rigid objects shifted sideways, the first way round from `turn` that nothing stands in; as `--move` takes it."""
    out: list[str] = []
    for spec in [o for o in scene.objects.values() if o.motion == "rigid"][:MOST_MOVED]:
        now = apply_moves(scene, out)
        geometry = move_geometry(source, scene, now)
        k = geometry.object_names.index(spec.name)
        own = geometry.face_object == k
        points = geometry.positions[np.unique(geometry.faces[own])]
        far = FAR * 0.5 * float(np.linalg.norm(np.ptp(points, axis=0)))
        some = points[np.unique(np.linspace(0, len(points) - 1, POINTS).astype(int))]
        tracer = Tracer(geometry.positions, geometry.faces[~own])
        for azimuth in 2.0 * math.pi * (np.arange(AZIMUTHS) + turn) / AZIMUTHS:
            way = np.array([math.sin(azimuth), 0.0, math.cos(azimuth)])
            towards = np.tile(way.astype(np.float32), (len(some), 1))
            limit = np.full(len(some), far * tracer.scale, np.float32)
            if not tracer.occluded(tracer.to_local(some), towards, limit).any():
                matrix = spec.transform.copy()
                matrix[:3, 3] += far * way
                out.append(f"{spec.name}=" + ",".join(repr(float(x)) for x in matrix.ravel()))
                break
    return tuple(out)
