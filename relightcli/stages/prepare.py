"""What stage precompute is to simulate: the scene with its faces cut, the plan, and the settings that follow."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.rays import Tracer
from relightcli.core.transport.receivers import Receivers
from relightcli.core.transport.shading import shading_scene
from relightcli.core.transport.smooth_cuts import cut_for_shading
from relightcli.core.transport.tessellation import tessellate
from relightcli.errors import InputError
from relightcli.plan import effects, pilot
from relightcli.run.accounting import Account
from relightcli.scene.build import build_geometry
from relightcli.scene.model import Geometry, Material, Scene
from relightcli.scene.parse import load_scene
from relightcli.stages.fields import Moving, add_points, find_movers, place, without
from relightcli.stages.inputs import named_files, stamps
from relightcli.stages.measured_error import Judge
from relightcli.stages.precompute_config import RESOLUTION, Config, check_bounces, check_config
from relightcli.stages.promise import UNDECIDED, Decided, Tried, choose, direct_keeps, try_settings
from relightcli.stages.promise_moving import rungs
from relightcli.stages.receiver_setup import (
    PixelReceivers,
    check_receivers,
    make_receivers,
    on_vertices,
    unburied,
    with_vertices,
)


@dataclass(frozen=True)
class Prepared:
    """A scene and what of it is simulated.

    source: the meshes as the scene file has them; uncut: with faces cut that are too large to carry shadows; geometry:
    the same, and with the meshes of what moves put in. both: objects whose back is lit too, (O,).
    """

    config: Config
    scene: Scene
    source: Geometry
    uncut: Geometry
    geometry: Geometry
    both: NDArray[np.bool_]
    plan: list[effects.Decision]
    bounces: int
    bounce_cells: int  # along a face of the cube of interreflections; 0: none
    moving: Moving | None
    promise: float | None  # the error to keep
    resolution: int = RESOLUTION
    tried: tuple[Tried, ...] = ()  # settings, each with its error
    read: dict[Path, tuple[int, int, int]] = field(default_factory=dict)  # `stamps` of the scene's files before that
    decided: Decided = UNDECIDED  # `faces` where the tolerance decides about those too large to carry shadows

    @property
    def simulated(self) -> list[str]:
        """Names of the effects."""
        return [d.effect for d in self.plan if d.simulate]

    @property
    def shadows(self) -> bool:
        return "shadows" in self.simulated

    @property
    def checked(self) -> bool:
        """Whether the error is measured here: of characters it is where they can be posed, by fit-pose."""
        return self.promise is not None and "pose" not in self.simulated

    @property
    def finer_helps(self) -> bool:
        """Whether a finer resolution of light could bring the error down, as far as was tried."""
        return not self.tried or self.resolution == self.tried[-1].resolution

    @property
    def trial_share(self) -> float | None:
        """What direct light errs by with these settings in the trial; None where they were not tried."""
        of_chosen = (t for t in self.tried if (t.resolution, t.grid) == (self.resolution, self.config.grid))
        return next((t.error.share for t in of_chosen), None)

    @property
    def posed(self) -> tuple[int, ...]:
        """Objects that will stand otherwise when pictures are made: they block nothing for the receivers of others."""
        if "pose" not in self.simulated:
            return ()
        rigs = self.geometry.rigs
        return tuple(self.geometry.object_names.index(name) for name, rig in rigs.items() if rig.clips)

    def plan_rows(self) -> list[dict[str, Any]]:
        """The plan as it is stored; what was not measured is left out."""
        return [_row(decision) for decision in self.plan]

    def tried_rows(self) -> list[dict[str, Any]]:
        """What was tried, as it is stored."""
        grids = self.config.receivers != "vertices"
        return [
            {"light_resolution": t.resolution, "share": t.error.share, "where": t.error.where}
            | ({"pixel_grid": t.grid} if grids else {})
            for t in self.tried
        ]

    def receivers(self) -> tuple[Receivers | PixelReceivers, NDArray[np.bool_] | None, tuple[int, ...]]:
        """The receivers; which of them are buried, (N,), where there are any on vertices; and the first receiver of
        what stays, then of everything that moves.

        Pixels look at the `source`: they are the same, and lit the same, with and without interreflections.
        """
        config, scene, geometry, both = self.config, self.scene, self.geometry, self.both
        move_aside = self.shadows
        if self.moving is not None:
            still = without(self.moving, geometry)
            vertices, buried = on_vertices(still, both), np.zeros(0, bool)
            if move_aside and len(vertices):
                vertices, buried = unburied(still, vertices, self.posed)
            vertices, starts = add_points(self.moving, self.uncut, geometry, vertices)
            return vertices, np.concatenate([buried, np.zeros(len(vertices) - len(buried), bool)]), starts
        seen = geometry if config.receivers == "vertices" else self.source
        bounces = bool(self.bounce_cells)
        asked = make_receivers(config.receivers, scene, seen, both, config.grid, fine=bounces)
        if isinstance(asked, PixelReceivers) and not bounces:
            return asked, None, (0,)
        vertices = on_vertices(geometry, both) if isinstance(asked, PixelReceivers) else asked
        buried = np.zeros(len(vertices), bool)
        if move_aside:
            vertices, buried = unburied(geometry, vertices, self.posed)
        if isinstance(asked, PixelReceivers):
            return with_vertices(asked, vertices), np.concatenate([np.zeros(len(asked), bool), buried]), (0,)
        return vertices, buried, (0,)


def prepare(config: Config, account: Account, decided: Decided = UNDECIDED) -> Prepared:
    """Reads the scene and decides. decided: by earlier attempts. Raises InputError where settings do not go with the
    scene."""
    check_config(config)
    asked = effects.parse_effects(config.effects)
    wanted = effects.bounces_asked(asked, config.bounces)
    promise = config.tolerance if config.basis == "visibility" else None
    read = stamps([config.scene.absolute()])
    with account.step("reading"):
        scene = load_scene(config.scene, allow_outside=config.allow_outside)
        if promise is not None:
            scene = replace(scene, tolerance=promise)
        read |= stamps(named_files(scene) - read.keys())
        source = build_geometry(scene)
    motions: dict[str, str] = {o.name: o.motion for o in scene.objects.values()}
    both = _both_sides(scene, source)
    check_receivers(config.receivers, scene, source)
    if wanted:
        check_bounces(config)
    fields = effects.decide_fields(asked, motions, len(scene.lights))
    pose = effects.decide_pose(asked, {name: len(rig.clips) for name, rig in source.rigs.items()}, config.receivers)
    with account.step("planning"):
        plan, bounces = effects.decide(
            asked,
            source.positions,
            source.faces,
            bool(both.any()),
            _lobes(scene),
            wanted,
            scene.tolerance,
            lambda: _Pilot(scene, source),
            fields.simulate or (asked is None and pose.simulate),
        )
    if bounces:
        check_bounces(config)
    plan += [pose, fields]
    simulated = [d.effect for d in plan if d.simulate]
    shadows = "shadows" in simulated
    bounce_cells = 0
    if "one-bounce" in simulated:
        coarse = (config.light_resolution or RESOLUTION) % 16
        textured = any(scene.materials[o.material].diffuse_texture is not None for o in scene.objects.values())
        planned = 8 if coarse else effects.bounce_cells(plan, scene.tolerance, textured, promise is not None)
        bounce_cells = config.bounce_resolution or planned
    with account.step("reading"):
        moving = _moving(config, scene, promise) if fields.simulate else None
        uncut = source
        if config.subdivide and (config.receivers == "vertices" or bounce_cells):
            uncut = _subdivided(scene, source, moving, shadows)
        geometry = uncut if moving is None else place(moving, uncut)
    prepared = Prepared(
        config,
        scene,
        source,
        uncut,
        geometry,
        both,
        plan,
        bounces,
        bounce_cells,
        moving,
        promise,
        config.light_resolution or RESOLUTION,
        read=read,
        decided=replace(decided, faces=None),
    )
    on_pixels = config.receivers != "vertices"
    may_stay = promise is not None and not on_pixels and moving is None and prepared.checked and uncut is not source
    settled = config.light_resolution is not None and (config.pixel_grid is not None or not on_pixels)
    if promise is None or (settled and not may_stay):
        return prepared
    judge = Judge(scene, source, Tracer(source.positions, source.faces))

    def tried_with(own: Prepared) -> Prepared:
        def receivers_of(grid: int) -> tuple[Receivers | PixelReceivers, NDArray[np.bool_] | None]:
            asked = config if grid == config.grid else replace(config, pixel_grid=grid)
            return replace(own, config=asked).receivers()[:2]

        most = decided.direct(promise)
        with account.step("resolution"):
            tried = try_settings(config, judge, own.geometry, receivers_of, most)
        chosen = choose(tried, most)
        changed = replace(config, pixel_grid=chosen.grid) if on_pixels else config
        return replace(own, config=changed, resolution=chosen.resolution, tried=tuple(tried))

    if not may_stay:
        return tried_with(prepared)
    if decided.faces != "cut":
        kept = replace(decided, faces="whole")
        whole = tried_with(replace(prepared, uncut=source, geometry=source, decided=kept))
        if decided.faces == "whole" or direct_keeps(whole.tried, decided.direct(promise)):
            return whole
    return tried_with(replace(prepared, decided=replace(decided, faces="cut")))


class _Pilot:
    """See `plan.effects.Pilot`."""

    def __init__(self, scene: Scene, geometry: Geometry) -> None:
        self.scene = shading_scene(geometry, pilot.brightest(scene.materials.values()), scene.lights.values())
        self.tracer = Tracer(geometry.positions, geometry.faces)
        self.views = pilot.views(list(scene.cameras.values()), geometry.positions, geometry.faces)

    def tails(self, allowed: float) -> list[pilot.Share]:
        return pilot.tails(self.scene, self.tracer, self.views, allowed)

    def shadows(self) -> pilot.Share:
        return pilot.shadows(self.scene, self.tracer, self.views)


def _row(decision: effects.Decision) -> dict[str, Any]:
    """A row of the plan as it is stored; what was not measured is left out."""
    row = {"effect": decision.effect, "simulate": decision.simulate, "evidence": decision.evidence}
    measured = {"share": decision.share, "bound": decision.bound, "rest": decision.rest}
    return row | {key: value for key, value in measured.items() if value is not None and math.isfinite(value)}


def _moving(config: Config, scene: Scene, promise: float | None) -> Moving:
    """What may be moved. Raises InputError where receivers or settings do not go with it."""
    config.fields.check()
    if config.receivers != "vertices":
        raise InputError("--receivers: objects that move carry their light at vertices; expected vertices")
    first = config.fields if promise is None else rungs(config.fields)[0]
    return find_movers(scene, first, config.subdivide, config.seed)


def _subdivided(scene: Scene, geometry: Geometry, moving: Moving | None, shadows: bool) -> Geometry:
    movers = () if moving is None else tuple(geometry.object_names.index(m.mesh.name) for m in moving.movers)
    finer, materials, what = geometry, list(scene.materials.values()), "the light on them"
    eyes = np.array([camera.eye for camera in scene.cameras.values()]).reshape(-1, 3)
    lights = np.array([light.center for light in scene.lights.values()]).reshape(-1, 3)
    if shadows:  # faces get small enough for most lobes, but not for the light of a lamp close by
        finer, what = tessellate(geometry, movers), "shadows"
        materials, eyes = [Material("")] * len(materials), eyes[:0]
    if len(lights) or not shadows:
        finer = cut_for_shading(finer, materials, eyes, lights, movers)
    more = len(finer.positions) - len(geometry.positions)
    if more == 0:
        return geometry
    note = f"faces too large to carry {what} were cut: {more} more vertices (--no-subdivide keeps them whole)"
    return replace(finer, notes=(*geometry.notes, note))


def _both_sides(scene: Scene, geometry: Geometry) -> NDArray[np.bool_]:
    """Objects whose back is lit too: two-sided ones, and membranes that let light through."""
    materials = list(scene.materials.values())
    translucent = np.array([materials[m].model == "translucent" for m in geometry.material], bool)
    both: NDArray[np.bool_] = geometry.two_sided | translucent
    return both


def _lobes(scene: Scene) -> bool:
    """Whether any object's material has a specular lobe, or may be given one when a picture is made."""
    used = [scene.materials[o.material] for o in scene.objects.values()]
    return any(m.model not in ("lambert", "translucent") or m.adjustable for m in used)
