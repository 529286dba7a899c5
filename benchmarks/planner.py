"""What planning costs and what it saves: precompute as it is planned against all effects, scene by scene.

Seconds are of all processes together, the program's start not included: they hang less on what else the machine does
than those of the clock. Faces stay whole, so that both runs have the same receivers.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.bounce_scenes import BounceScene
from benchmarks.processes import run_tool
from benchmarks.promise_scenes import ball, box, fixed, lamp, matte, mirror, pillars, write_scene
from benchmarks.report import Report, Row, Table
from benchmarks.scenes import Setting
from relightcli.scene.shapes import rounded

SAVES = 2.0  # times the seconds, where an effect is skipped
PILOT, LEAST = 0.03, 2.0  # of the run's seconds, or so many
CELLS, SIZE = 40, (320, 240)


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
    pilots: list[tuple[float, str]] = []
    for make in makers:
        scene = make(cells)
        found = {effects: _run(setting.work / scene.name, scene, effects) for effects in ("auto", "all")}
        auto, whole = found["auto"], found["all"]
        ratio = whole["cpu_seconds"] / auto["cpu_seconds"]
        skipped = [name for name in ("shadows", "one-bounce", "two-bounce") if name not in auto["effects"]]
        if skipped:
            saved.append((ratio, scene.name))
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
        work = f"seconds of all effects over those planned, least of {len(saved)} scenes with one to skip ({name})"
        report.rows.append(Row(work, ratio, "x", target=f">= {SAVES:g}", met=ratio >= SAVES))
    most, name = max(pilots)
    work = f"pilot, in units of {LEAST:g} s or {100 * PILOT:g} % of the run, whichever is more ({name})"
    report.rows.append(Row(work, most, "", target="<= 1", met=most <= 1.0))
    columns = ("scene", "receivers", "skipped", "all, CPU s", "planned, CPU s", "ratio", "pilot, CPU s", "pilot, s")
    report.tables.append(Table("planning, scene by scene", (*columns, "all, MB", "planned, MB"), tuple(rows)))
    return report


def _run(folder: Path, scene: BounceScene, effects: str) -> dict[str, Any]:
    """One store's costs."""
    import relight_formats as formats

    path = folder / "scene.toml"
    if not path.exists():
        path = write_scene(scene, folder, SIZE)
        path.write_text(path.read_text() + "\n[accuracy]\ntolerance = 0.1\n")
    store = folder / f"{effects}.zarr"
    told = run_tool("precompute", path, "-o", store, "--effects", effects, "--no-subdivide")[1]
    opened = formats.open_store(store)
    costs = {key: told[key] for key in ("seconds", "cpu_seconds", "bytes", "receivers")}
    return {**costs, "effects": opened.settings["effects"], "steps": opened.summary["steps"]}
