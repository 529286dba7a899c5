"""Stage precompute: scene file in, transfer store out. What every receiver sees of the sky, block by block."""

from __future__ import annotations

import math
import time
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli import __version__
from relightcli.adapters.files import need_output
from relightcli.adapters.rays import Tracer
from relightcli.core.transport import visibility
from relightcli.core.transport.hits import trace_hits
from relightcli.core.transport.receivers import Receivers
from relightcli.core.transport.shading import shading_scene
from relightcli.core.transport.tessellation import tessellate
from relightcli.errors import InputError
from relightcli.plan import effects, pilot
from relightcli.run import blocks as run
from relightcli.scene.build import build_geometry, scene_to_json
from relightcli.scene.model import Geometry, Scene
from relightcli.scene.parse import load_scene
from relightcli.stages.fields import (
    FieldSettings,
    Moving,
    add_points,
    describe,
    find_movers,
    place,
    predict,
    put_fields,
    without,
)
from relightcli.stages.inputs import scene_inputs
from relightcli.stages.pose_job import check_pose_options, choose_frames, simulate_poses
from relightcli.stages.promise import keep_promise, try_resolutions
from relightcli.stages.receiver_setup import (
    MOST_PIXEL_GRID,
    PixelReceivers,
    check_receivers,
    make_receivers,
    on_vertices,
    put_geometry,
    put_receivers,
    put_vertex_colours,
    surfaces_of,
    unburied,
    with_vertices,
)
from relightcli.stages.rig_store import put_rigs
from relightcli.stages.visibility_job import VisibilityJob, block_size, create_outputs

KIND = "transfer"
MOVING = ("fields", "pose")  # effects
BASES = ("visibility", "haar", "sh", "dense")
RESOLUTION = 64  # texels along a face of the light's cube, unless asked for or chosen
PILOT_GROUPS = 24  # groups of receivers that a dry run traces
MOST_BOUNCES = 64
BOUNCE_RESOLUTIONS = (8, 16, 32)
WRONG_BITS = 1e-3  # share of wrong bits above which the user is told


@dataclass(frozen=True)
class Config:
    """Everything that `precompute` needs to know. `basis` beyond visibility is stored in addition to it."""

    scene: Path
    output: Path
    light_resolution: int | None = None  # 64, or what `tolerance` takes
    refine: int = 4
    effects: str = "auto"
    receivers: str = "vertices"
    pixel_grid: int = 1
    subdivide: bool = True
    basis: str = "visibility"
    coefficients: int = 128
    tolerance: float | None = None
    allow_miss: bool = False
    sh_order: int = 6
    bounces: int | None = None
    bounce_resolution: int | None = None
    pose_frames: str = "spread:200"
    pose_order: int = 4
    pose_directions: int = 1024
    pose_surroundings: bool = False
    field_shells: int = 16
    field_resolution: int | None = None
    field_proxies: int = 8
    field_order: int = 4
    field_spacing: str = "geometric"
    field_library: Path | None = None
    seed: int = 0
    workers: int = 1
    overwrite: bool = False
    allow_outside: bool = False
    dry_run: bool = False
    quiet: bool = False

    @property
    def fields(self) -> FieldSettings:
        """What fields are to be like."""
        return FieldSettings(
            self.field_shells,
            self.field_resolution,
            self.field_proxies,
            self.field_order,
            self.field_spacing,
            self.field_library,
        )


def precompute(config: Config) -> dict[str, Any]:
    """Runs the stage; returns a summary for the user. Raises the errors of `relightcli.errors` and OSError."""
    started = time.perf_counter()
    _check(config)
    need_output(config.output)
    asked = effects.parse_effects(config.effects)
    wanted = effects.bounces_asked(asked, config.bounces)
    promise = config.tolerance if config.basis == "visibility" else None
    scene = load_scene(config.scene, allow_outside=config.allow_outside)
    motions: dict[str, str] = {o.name: o.motion for o in scene.objects.values()}
    geometry = build_geometry(scene)
    both = _both_sides(scene, geometry)
    check_receivers(config.receivers, scene, geometry)
    if wanted:
        _check_bounces(config)
    clock = time.perf_counter()
    fields = effects.decide_fields(asked, motions, len(scene.lights))
    plan, bounces = effects.decide(
        asked,
        geometry.positions,
        geometry.faces,
        bool(both.any()),
        _lobes(scene),
        wanted,
        scene.tolerance if promise is None else promise,
        lambda: _Pilot(scene, geometry),
        fields.simulate,
    )
    planning = time.perf_counter() - clock
    if bounces:
        _check_bounces(config)
    plan.append(effects.decide_pose(asked, {name: len(rig.clips) for name, rig in geometry.rigs.items()}))
    plan.append(fields)
    simulated = [d.effect for d in plan if d.simulate]
    if promise is not None and any(name in simulated for name in MOVING):
        raise InputError(
            f"--tolerance: {scene.path} has objects that move, and no error is promised for the light about them; "
            "leave it out, or name effects without fields and pose"
        )
    shadows = "shadows" in simulated
    bounce_cells = 0
    if "one-bounce" in simulated:
        coarse = (config.light_resolution or RESOLUTION) % 16
        planned = 8 if coarse else effects.bounce_cells(plan, promise or scene.tolerance)
        bounce_cells = config.bounce_resolution or planned
    source = geometry
    moving = None
    if fields.simulate:
        moving = _moving(config, scene)
    if shadows and config.subdivide and (config.receivers == "vertices" or bounce_cells):
        geometry = _subdivided(geometry, moving)
    uncut = geometry
    if moving is not None:
        geometry = place(moving, geometry)
    tried: list[tuple[int, pilot.Share]] = []
    resolution = config.light_resolution or RESOLUTION
    if config.light_resolution is None and promise is not None and shadows:
        receivers, buried, _ = _receivers(
            config, scene, source, geometry, both, plan, bool(bounce_cells), moving, uncut
        )
        tried = try_resolutions(config, scene, source, geometry, receivers, buried, promise)
        resolution = tried[-1][0]
    if config.dry_run:
        return _dry_run(
            config,
            resolution,
            scene,
            source,
            geometry,
            both,
            plan,
            bounces,
            planning,
            shadows,
            bounce_cells,
            moving,
            uncut,
        )
    settings: dict[str, Any] = {
        "effects": simulated,
        "light_resolution": resolution,
        "refine": config.refine if shadows else 1,
        "receivers": config.receivers,
        "subdivide": config.subdivide,
        "basis": config.basis,
        "seed": config.seed,
        "bounces": bounces,
    }
    if config.pixel_grid != 1:
        settings["pixel_grid"] = config.pixel_grid
    if bounce_cells:
        settings["bounce_resolution"] = bounce_cells
    if moving is not None:
        settings["fields"] = config.fields.as_json()
    if config.basis == "haar":
        settings |= {"coefficients": config.coefficients, "tolerance": config.tolerance}
    if "pose" in simulated:
        settings |= {
            "pose_frames": config.pose_frames,
            "pose_order": config.pose_order,
            "pose_directions": config.pose_directions,
            "pose_surroundings": config.pose_surroundings,
        }
    if config.basis == "sh":
        settings["sh_order"] = config.sh_order
    writer = formats.begin(
        config.output,
        KIND,
        settings=settings,
        inputs=scene_inputs(scene),
        program=f"relightcli {__version__}",
        overwrite=config.overwrite,
    )
    if writer is None:
        return {"store": str(config.output), "status": "up to date", "notes": list(geometry.notes)}
    with writer:
        resumed = bool(writer.done)
        receivers, buried, starts = _receivers(
            config, scene, source, geometry, both, plan, bool(bounce_cells), moving, uncut
        )
        points = receivers.points if isinstance(receivers, PixelReceivers) else receivers
        if moving is not None:
            writer.set_attrs({"fields": describe(moving, scene, starts)})
        writer.set_attrs(
            {
                "scene": scene_to_json(scene, geometry),
                "plan": [_row(d) for d in plan],
                "tried": [{"light_resolution": r, "share": e.share, "where": e.where} for r, e in tried],
                "nothing_blocks": asked is None and not shadows,
            }
        )
        put_geometry(writer, geometry)
        put_rigs(writer, geometry)
        if geometry is not source:
            writer.put("source/face", source.faces, dims=("face", "corner"))
        put_receivers(writer, receivers, buried)
        if bounce_cells and geometry.textures:
            put_vertex_colours(writer, geometry)
        job = VisibilityJob(
            str(writer.partial_path),
            resolution,
            config.refine,
            shadows,
            config.basis,
            config.coefficients,
            config.tolerance or 0.0,
            config.sh_order,
            config.seed,
            tuple(scene.lights.values()),
            bounce_cells,
            int(np.count_nonzero(points.vertex < 0)),
            () if moving is None else tuple(geometry.object_names.index(m.mesh.name) for m in moving.movers),
            starts,
            _posed(geometry, plan),
        )
        create_outputs(writer, job, len(receivers))
        run.run_blocks(
            job,
            run.split("visibility", len(receivers), block_size(resolution)),
            writer,
            workers=config.workers,
            label="visibility",
            quiet=config.quiet,
        )
        run.close_worker()
        if moving is not None:
            put_fields(writer, moving, scene, config.fields, config.workers, config.quiet)
        if "pose" in simulated:
            simulate_poses(
                writer,
                scene,
                geometry,
                config.pose_frames,
                config.pose_order,
                config.pose_directions,
                config.pose_surroundings,
                config.workers,
                config.quiet,
            )
        if promise is not None:
            keep_promise(config, promise, resolution, scene, source, geometry, receivers, buried, writer)
        seconds = time.perf_counter() - started
        writer.commit({"seconds": seconds, "planning_seconds": planning, "resumed": resumed, "workers": config.workers})
    return _summary(config, started, resumed, geometry)


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
    measured = {"share": decision.share, "bound": decision.bound}
    return row | {key: value for key, value in measured.items() if value is not None and math.isfinite(value)}


def _check(config: Config) -> None:
    resolution = config.light_resolution or RESOLUTION
    if not 16 <= resolution <= 256 or resolution % 8:
        raise InputError(f"--light-resolution: expected a multiple of 8 from 16 to 256; found {resolution}")
    if config.basis == "haar" and resolution & (resolution - 1):
        raise InputError(f"--light-resolution: --basis haar needs 16, 32, 64, 128 or 256; found {resolution}")
    if config.refine not in (1, 2, 4, 8) or config.refine * 4 > resolution:
        raise InputError(
            f"--refine: expected 1, 2, 4 or 8, at most a quarter of --light-resolution; found {config.refine}"
        )
    if config.basis not in BASES:
        raise InputError(f"--basis: expected one of {', '.join(BASES)}; found {config.basis!r}")
    if not 1 <= config.coefficients <= 6 * resolution * resolution:
        raise InputError(f"--coefficients: expected 1 to {6 * resolution * resolution}; found {config.coefficients}")
    if config.tolerance is not None and not 0.0 < config.tolerance < 1.0:
        raise InputError(f"--tolerance: expected more than 0 and less than 1; found {config.tolerance}")
    if not 1 <= config.sh_order <= 16:
        raise InputError(f"--sh-order: expected 1 to 16; found {config.sh_order}")
    if not 1 <= config.pixel_grid <= MOST_PIXEL_GRID:
        raise InputError(f"--pixel-grid: expected 1 to {MOST_PIXEL_GRID}; found {config.pixel_grid}")
    if config.pixel_grid != 1 and config.receivers == "vertices":
        raise InputError("--pixel-grid: needs --receivers pixels:CAMERA")
    check_pose_options(config.pose_frames, config.pose_order, config.pose_directions)
    if config.bounces is not None and not 0 <= config.bounces <= MOST_BOUNCES:
        raise InputError(f"--bounces: expected 0 to {MOST_BOUNCES}; found {config.bounces}")


def _check_bounces(config: Config) -> None:
    cells, resolution = config.bounce_resolution, config.light_resolution or RESOLUTION
    if cells is not None and (cells not in BOUNCE_RESOLUTIONS or resolution % cells):
        raise InputError(
            "--bounce-resolution: expected 8, 16 or 32, and a divisor of --light-resolution "
            f"({resolution}); found {cells}"
        )


def _moving(config: Config, scene: Scene) -> Moving:
    """What may be moved. Raises InputError where receivers or settings do not go with it."""
    config.fields.check()
    if config.receivers != "vertices":
        raise InputError("--receivers: objects that move carry their light at vertices; expected vertices")
    return find_movers(scene, config.fields, config.subdivide, config.seed)


def _subdivided(geometry: Geometry, moving: Moving | None) -> Geometry:
    movers = () if moving is None else tuple(geometry.object_names.index(m.mesh.name) for m in moving.movers)
    finer = tessellate(geometry, movers)
    more = len(finer.positions) - len(geometry.positions)
    if more == 0:
        return geometry
    note = f"faces too large to carry shadows were cut: {more} more vertices (--no-subdivide keeps them whole)"
    return replace(finer, notes=(*geometry.notes, note))


def _receivers(
    config: Config,
    scene: Scene,
    source: Geometry,
    geometry: Geometry,
    both: NDArray[np.bool_],
    plan: list[effects.Decision],
    bounces: bool,
    moving: Moving | None,
    uncut: Geometry,
) -> tuple[Receivers | PixelReceivers, NDArray[np.bool_] | None, tuple[int, ...]]:
    """The receivers; which of them are buried, (N,), where there are any on vertices; and the first receiver of what
    stays, then of everything that moves. uncut: the geometry before the latter's meshes were put in.

    Pixels look at the uncut `source`: they are the same, and lit the same, with and without interreflections.
    """
    shadows = any(d.effect == "shadows" and d.simulate for d in plan)
    if moving is not None:
        still = without(moving, geometry)
        vertices, buried = on_vertices(still, both), np.zeros(0, bool)
        if shadows and not config.dry_run and len(vertices):
            vertices, buried = unburied(still, vertices, _posed(geometry, plan))
        vertices, starts = add_points(moving, uncut, geometry, vertices)
        return vertices, np.concatenate([buried, np.zeros(len(vertices) - len(buried), bool)]), starts
    seen = geometry if config.receivers == "vertices" else source
    asked = make_receivers(config.receivers, scene, seen, both, config.pixel_grid, fine=bounces)
    if isinstance(asked, PixelReceivers) and not bounces:
        return asked, None, (0,)
    vertices = on_vertices(geometry, both) if isinstance(asked, PixelReceivers) else asked
    buried = np.zeros(len(vertices), bool)
    if shadows and not config.dry_run:
        vertices, buried = unburied(geometry, vertices, _posed(geometry, plan))
    if isinstance(asked, PixelReceivers):
        return with_vertices(asked, vertices), np.concatenate([np.zeros(len(asked), bool), buried]), (0,)
    return vertices, buried, (0,)


def _posed(geometry: Geometry, plan: list[effects.Decision]) -> tuple[int, ...]:
    """Objects that will stand otherwise when pictures are made: they block nothing for the receivers of others."""
    if not any(d.effect == "pose" and d.simulate for d in plan):
        return ()
    return tuple(geometry.object_names.index(name) for name, rig in geometry.rigs.items() if rig.clips)


def _both_sides(scene: Scene, geometry: Geometry) -> NDArray[np.bool_]:
    """Objects whose back is lit too: two-sided ones, and membranes that let light through."""
    materials = list(scene.materials.values())
    translucent = np.array([materials[m].model == "translucent" for m in geometry.material], bool)
    both: NDArray[np.bool_] = geometry.two_sided | translucent
    return both


def _lobes(scene: Scene) -> bool:
    """Whether any material has a specular lobe, or may be given one when a picture is made."""
    return any(m.model not in ("lambert", "translucent") or m.adjustable for m in scene.materials.values())


def _summary(config: Config, started: float, resumed: bool, geometry: Geometry) -> dict[str, Any]:
    store = formats.open_store(config.output, KIND)
    total = {
        key: sum(b.get(key, 0.0) for b in store.blocks) for key in ("rays", "checked", "wrong", "inferred", "bits")
    }
    # Share of all bits above the horizon that the check predicts to be wrong; what it found was mended.
    wrong = total["wrong"] / total["checked"] * total["inferred"] / total["bits"] if total["checked"] else 0.0
    notes = list(geometry.notes)
    if wrong > WRONG_BITS:
        notes.append(f"{wrong:.1e} of the visibility bits are wrong: fine structures; --refine 2 or 1 traces more")
    return {
        "store": str(config.output),
        "status": "resumed" if resumed else "written",
        "receivers": int(store.array("receivers/side").shape[0]),
        "rays": int(total["rays"]),
        "wrong_bits": wrong,
        "checked_bits": int(total["checked"]),
        "bytes": sum(size.stored for size in store.sizes().values()),
        "peak_bytes": int(max((b.get("peak_bytes", 0.0) for b in store.blocks), default=0)),
        "seconds": time.perf_counter() - started,
        "notes": notes,
    }


def _raw_bytes(geometry: Geometry, points: Receivers) -> int:
    arrays: list[NDArray[Any]] = [
        geometry.positions,
        geometry.normals,
        geometry.uvs,
        geometry.faces,
        points.position,
        points.normal,
    ]
    return sum(a.nbytes for a in [*arrays, *geometry.textures.values()])


def _pose_cost(config: Config, geometry: Geometry, traced: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rays, seconds and bytes of the frames of skinned objects, at the speed of the rays of `traced`."""
    rigs = [rig for rig in geometry.rigs.values() if rig.clips]
    samples = sum(len(choose_frames(rig, config.pose_frames)) * len(rig.position) for rig in rigs)
    rays = samples * config.pose_directions
    seconds = rays * traced[1] / traced[0] if traced[0] else 0.0
    return np.array([rays, seconds, 4.0 * samples * config.pose_order**2])


def _dry_run(
    config: Config,
    resolution: int,
    scene: Scene,
    source: Geometry,
    geometry: Geometry,
    both: NDArray[np.bool_],
    plan: list[effects.Decision],
    bounces: int,
    planning: float,
    shadows: bool,
    bounce_cells: int,
    moving: Moving | None,
    uncut: Geometry,
) -> dict[str, Any]:
    """The plan with its cost, predicted from a pilot of a few hundred receivers, and of samples of fields.

    The bytes are an upper bound: the mesh counts uncompressed, and the pilot's bits compress worse in small groups.
    """
    receivers, _, _ = _receivers(config, scene, source, geometry, both, plan, bool(bounce_cells), moving, uncut)
    points = receivers.points if isinstance(receivers, PixelReceivers) else receivers
    spent = {"shadows": np.zeros(3), "one-bounce": np.zeros(3)}  # rays, seconds, bytes
    if shadows and len(points):
        tracer = Tracer(geometry.positions, geometry.faces)
        surfaces = surfaces_of(geometry, points, np.zeros(len(points), bool)) if bounce_cells else None
        starts = np.linspace(0, max(0, len(points) - visibility.GROUP), PILOT_GROUPS + 1).astype(int)
        pilot_receivers = 0
        for k, start in enumerate(starts):
            rows = slice(start, start + visibility.GROUP)
            clock = time.perf_counter()
            block = visibility.trace_visibility(
                tracer, points.position[rows], points.normal[rows], resolution, config.refine, config.seed
            )
            seen = time.perf_counter()
            hits = None
            if surfaces is not None:
                hits, more = trace_hits(
                    tracer, surfaces, points.position[rows], points.normal[rows], block.bits, bounce_cells, start, 0
                )
            end = time.perf_counter()
            if k:  # the first run pays for compilation
                pilot_receivers += len(block.bits)
                spent["shadows"] += block.rays, seen - clock, len(zlib.compress(block.bits.tobytes(), 1))
                if hits is not None:
                    spent["one-bounce"] += more, end - seen, len(zlib.compress(hits.tobytes(), 1))
        for cost in spent.values():
            cost *= len(points) / pilot_receivers
            cost[1] /= max(1, config.workers)
    if any(d.effect == "pose" and d.simulate for d in plan):
        spent["pose"] = _pose_cost(config, geometry, spent["shadows"])
    if moving is not None:
        spent["fields"] = np.array(predict(moving))
        spent["fields"][1] /= max(1, config.workers)
    rays, seconds, packed = np.sum(list(spent.values()), axis=0)
    rows_of_plan = [_row(d) for d in plan]
    for row in rows_of_plan:
        if row["simulate"] and row["effect"] in spent:
            cost = spent[row["effect"]]
            row["predicted"] = {"rays": int(cost[0]), "seconds": float(cost[1]), "bytes": int(cost[2])}
    return {
        "dry_run": True,
        "store": str(config.output),
        "receivers": len(points),
        "bounces": bounces,
        "light_resolution": resolution,
        "plan": rows_of_plan,
        "planning_seconds": planning,
        "predicted": {"rays": int(rays), "seconds": seconds, "bytes": int(packed) + _raw_bytes(geometry, points)},
        "notes": list(geometry.notes),
    }
