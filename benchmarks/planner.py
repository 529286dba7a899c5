"""What planning costs and what it saves: precompute as it is planned against all effects, scene by scene.

What an effect changes is path-traced: views and skies of `promise_scenes`, of which the plan knows no sky and not the
fourth view, and materials as bright as they may be made. Effects of what moves are planned by structure alone.

Seconds are of all processes together, the program's start not included: they hang less on what else the machine does
than those of the clock. Faces stay whole, so that both runs have the same receivers. All of it took four minutes on two
cores that others used as well.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks import moving_scenes
from benchmarks.bounce_scenes import BounceScene
from benchmarks.pose_rigs import FLOOR, SCENE
from benchmarks.processes import run_tool
from benchmarks.promise_scenes import ball, box, fixed, judging_skies, lamp, matte, mirror, pillars, write_scene
from benchmarks.report import Report, Row, Table, at_most
from benchmarks.scenes import Setting, shared_data
from relightcli.scene.shapes import rounded

SAVES = 2.0  # times the seconds, where an effect is skipped
PILOT, LEAST = 0.03, 2.0  # of the run's seconds, or so many
CELLS, SIZE = 40, (320, 240)
TOLERANCE = 0.1
SMALL, SAMPLES, BOUNCES = (40, 30), 32, 12  # of pictures that show what an effect changes; the plan has at most 8
BOUNCED = {"one-bounce": 1, "two-bounce": 2}


def convex(cells: int) -> BounceScene:
    mesh = rounded((1.0, 1.0, 1.0), power=2, subdivisions=6 if cells >= CELLS else 4)
    return replace(ball(cells), objects={"ball": (mesh, "ball")})


def dark(cells: int) -> BounceScene:
    black = "diffuse = [0.04, 0.04, 0.05]"
    made = pillars(cells)
    return replace(made, name="dark", edit=(), materials=dict.fromkeys(made.materials, black))


MAKERS = (convex, dark, box, matte, mirror, fixed, lamp, pillars)


def measure(setting: Setting) -> Report:
    makers, cells = ((convex, matte), 6) if setting.quick else (MAKERS, CELLS)
    report = Report(f"{len(makers)} scenes, light at vertices, `--effects all` and `auto` at a tolerance of 10 %")
    rows: list[tuple[str | int | float, ...]] = []
    saved: list[tuple[float, str]] = []
    traced: list[tuple[float, str]] = []
    pilots: list[tuple[float, str]] = []
    left_out: list[tuple[float, str]] = []
    needed: list[tuple[float, str]] = []
    effects: list[tuple[str | int | float, ...]] = []
    for make in makers:
        scene = make(cells)
        found = {effects: _run(setting.work / scene.name, scene, effects) for effects in ("auto", "all")}
        auto, whole = found["auto"], found["all"]
        ratio = whole["cpu_seconds"] / auto["cpu_seconds"]
        skipped = [name for name in ("shadows", "one-bounce", "two-bounce") if name not in auto["effects"]]
        if "one-bounce" in skipped:  # a second interreflection takes no rays of its own
            saved.append((ratio, scene.name))
            traced.append((whole["traced"] / auto["traced"], scene.name))
        shadows, tails = changes(setting.work / scene.name / "scene.toml", 8 if setting.quick else SAMPLES)
        rest = max(tails[auto["bounces"]], 0.0 if "shadows" in auto["effects"] else shadows)
        left_out.append((rest, scene.name))
        told = ("shadows", shadows), *((name, tails[number - 1]) for name, number in BOUNCED.items())
        for name, change in told:
            planned = "simulated" if name in auto["effects"] else "skipped"
            if planned == "simulated":
                needed.append((change, f"{name} of {scene.name}"))
            effects.append((scene.name, name, 100 * change, planned))
        effects.append(
            (scene.name, f"after {auto['bounces']} interreflections", 100 * tails[auto["bounces"]], "skipped")
        )
        pilot = auto["steps"]["planning"]["cpu_seconds"]
        pilots.append((pilot / max(LEAST, PILOT * auto["cpu_seconds"]), scene.name))
        rows.append(
            (
                *(scene.name, auto["receivers"], ", ".join(skipped) or "nothing"),
                *(whole["cpu_seconds"], auto["cpu_seconds"], ratio, pilot, auto["steps"]["planning"]["seconds"]),
                *(whole["bytes"] / 1e6, auto["bytes"] / 1e6),
            )
        )
    if saved:
        ratio, name = min(saved)
        work = f"seconds of all effects over those planned, least of {len(saved)} scenes with rays to skip ({name})"
        report.rows.append(Row(work, ratio, "x", target=f">= {SAVES:g}", met=ratio >= SAVES))
        ratio, name = min(traced)
        work = f"the same of the simulation alone, without what every run takes ({name})"
        report.rows.append(Row(work, ratio, "x", target=f">= {SAVES:g}", met=ratio >= SAVES))
    most, name = max(left_out)
    work = f"what all that is skipped changes, the most of {len(left_out)} scenes ({name})"
    report.rows.append(at_most(work, 100 * most, "%", 100 * TOLERANCE))
    if needed:
        least, name = min(needed)
        report.rows.append(
            Row(f"the same of what is simulated, the least of {len(needed)} effects ({name})", 100 * least, "%")
        )
    right, of, skipped = _moving(setting)
    report.skipped += skipped
    work = "scenes with fields where an object moves and only there, and poses where a character does and only there"
    report.rows.append(Row(work, right, "", target=f">= {of}", met=right == of))
    most, name = max(pilots)
    work = f"pilot, in units of {LEAST:g} s or {100 * PILOT:g} % of the run, whichever is more ({name})"
    report.rows.append(Row(work, most, "", target="<= 1", met=most <= 1.0))
    columns = ("scene", "receivers", "skipped", "all, CPU s", "planned, CPU s", "ratio", "pilot, CPU s", "pilot, s")
    report.tables.append(Table("planning, scene by scene", (*columns, "all, MB", "planned, MB"), tuple(rows)))
    title = "what leaving an effect out changes, at the most of 4 views and 5 skies"
    report.tables.append(Table(title, ("scene", "effect", "relative RMS, %", "planned"), tuple(effects)))
    return report


def changes(path: Path, samples: int) -> tuple[float, list[float]]:
    """Relative RMS by which pictures change at most without shadows, and without the interreflections after k, k = 0 to
    BOUNCES - 1. Two independent runs of the path tracer take their noise off (`plan.pilot`)."""
    import numpy as np

    from relightcli.adapters.rays import Tracer
    from relightcli.core.lights.latlong import make_latlong
    from relightcli.core.transport.path_tracer import trace_rows
    from relightcli.core.transport.shading import shading_scene
    from relightcli.plan.pilot import brightest, share_of
    from relightcli.scene.build import build_geometry
    from relightcli.scene.parse import load_scene

    scene = load_scene(path)
    geometry = build_geometry(scene)
    tracer = Tracer(geometry.positions, geometry.faces)
    lit = shading_scene(geometry, brightest(scene.materials.values()), scene.lights.values())
    shadows, tails = 0.0, [0.0] * BOUNCES
    for camera in (replace(camera, size=SMALL) for camera in scene.cameras.values()):
        for sky in map(make_latlong, judging_skies().values()):

            def trace(seed: int, blocks: bool, bounces: int, camera: Any = camera, sky: Any = sky) -> Any:
                rows = (0, camera.size[1])
                tile = trace_rows(lit, tracer, sky, camera, rows, (0, 1), samples, bounces, seed, blocks=blocks)
                return tile.layers.reshape(bounces + 2, -1, 3)

            runs = [trace(seed, True, BOUNCES) for seed in (500, 501)]
            whole = [run.sum(axis=0) for run in runs]
            for k in range(BOUNCES):
                rest = [run[k + 1 : BOUNCES + 1].sum(axis=0) for run in runs]
                tails[k] = max(tails[k], share_of(*rest, *whole, "").share)
            direct = [run[[0, -1]].sum(axis=0) for run in runs]
            through = [trace(seed, False, 0).sum(axis=0) for seed in (500, 501)]
            lost = [np.subtract(a, b) for a, b in zip(through, direct, strict=True)]
            shadows = max(shadows, share_of(*lost, *direct, "").share)
    return shadows, tails


def _moving(setting: Setting) -> tuple[int, int, list[str]]:
    """Of scenes with a moving object, with a character and with neither, how many are planned as they should be, and
    how many there are; what could not be tried."""
    folder = setting.work / "moving"
    scenes = {"fields": moving_scenes.write(moving_scenes.ball(6, 2), folder / "object", SIZE)}
    scenes["neither"] = write_scene(matte(6), folder / "matte", SIZE)
    data, skipped = shared_data(), []
    rig = None if data is None else data / "skinned" / "CesiumMan.glb"
    if rig is None or not rig.exists():
        skipped.append("a character: no test data")
    else:
        own = folder / "character"
        own.mkdir(parents=True, exist_ok=True)
        shutil.copy(rig, own / "subject.glb")
        shutil.copy(folder / "object" / "floor.obj", own / "floor.obj")
        scenes["pose"] = own / "scene.toml"
        scenes["pose"].write_text(SCENE.format(motion="") + FLOOR)
    right = 0
    for name, path in scenes.items():
        asked = ("precompute", path, "-o", folder / "none.zarr", "--dry-run", "--light-resolution", "16")
        plan = run_tool(*asked, "--no-subdivide")[1]["plan"]
        found = {row["effect"] for row in plan if row["simulate"]} & {"fields", "pose"}
        right += found == ({name} - {"neither"})
    return right, len(scenes), skipped


def _run(folder: Path, scene: BounceScene, effects: str) -> dict[str, Any]:
    """One store's costs."""
    import relight_formats as formats

    path = folder / "scene.toml"
    if not path.exists():
        path = write_scene(scene, folder, SIZE)
        path.write_text(path.read_text() + f"\n[accuracy]\ntolerance = {TOLERANCE}\n")
    store = folder / f"{effects}.zarr"
    told = run_tool("precompute", path, "-o", store, "--effects", effects, "--no-subdivide")[1]
    opened = formats.open_store(store)
    costs = {key: told[key] for key in ("seconds", "cpu_seconds", "bytes", "receivers")}
    settings = {name: opened.settings[name] for name in ("effects", "bounces")}
    traced = sum(block["cpu_seconds"] for block in opened.blocks)
    return {**costs, **settings, "traced": traced, "steps": opened.summary["steps"]}
