"""Whether --tolerance keeps its promise: scenes, skies, views and edits that nothing was chosen by.

Of every scene and tolerance a store is made with --tolerance, or with what its refusal advises (pixels as receivers).
Its pictures are held against path tracing of many bounces, whose noise two independent runs take off
(`core.measure.noise_free`). Every store is predicted first with --dry-run, for seconds and bytes.

Results are kept in build/promise (--quick: nowhere) as they come, and those that are there are not made again:
delete the folder to start anew. `python -m benchmarks.promise --scenes box,matte --tolerances 0.1` measures a part.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import statistics
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import report as reports
from benchmarks.bounce_scenes import BounceScene
from benchmarks.processes import run_tool
from benchmarks.promise_scenes import JUDGE, MAKERS, judging_skies, write_scene
from benchmarks.report import Report, Row, Table
from benchmarks.scenes import Setting

TOLERANCES = (0.1, 0.05, 0.02, 0.01)
KEPT = Path("build/promise")
BOUNCES = 8  # of the references
CELLS, SIZE, SAMPLES = 20, (64, 48), 128  # along a wall; of a picture; a pixel of each of two references
KEEPS, LEAST_MEDIAN = 0.95, 0.25
SECONDS, BYTES = 1.5, 1.2  # factors of what was predicted
KNOBS = ("light_resolution", "bounces", "bounce_resolution", "pixel_grid")
Picture = NDArray[np.float32]


def measure(setting: Setting) -> Report:
    if setting.quick:
        return run(setting.work, [MAKERS[1], MAKERS[2]], TOLERANCES[:2], ("even", "low sun"), 6, (32, 24), 32)
    return run(KEPT, list(MAKERS), TOLERANCES, tuple(judging_skies()), CELLS, SIZE, SAMPLES)


def run(
    folder: Path,
    makers: list[Any],
    tolerances: tuple[float, ...],
    skies: tuple[str, ...],
    cells: int,
    size: tuple[int, int],
    spp: int,
) -> Report:
    """Measures what `folder` does not hold yet; the report is of everything that was asked for."""
    found: list[dict[str, Any]] = []
    report = Report(
        f"scenes in {size[0]}x{size[1]}, references of 2 x {spp} samples a pixel and {BOUNCES} interreflections"
    )
    scenes = [(make.__name__, make(cells)) for make in makers]
    report.skipped += [f"{name}: no test data" for name, scene in scenes if scene is None]
    for tolerance in tolerances:
        for scene in (scene for _, scene in scenes if scene is not None):
            record = folder / scene.name / f"{tolerance:g}.json"
            if not record.exists():
                record.parent.mkdir(parents=True, exist_ok=True)
                record.write_text(json.dumps(_one(record.parent, scene, tolerance, size, spp), indent=1))
            one = json.loads(record.read_text())
            one["errors"] = {name: value for name, value in one["errors"].items() if name in skies}
            found.append(one)
            print(json.dumps(one), flush=True)
    found.sort(key=lambda one: [scene for scene, _ in scenes].index(one["scene"]))
    _judge(report, found)
    return report


def _one(folder: Path, scene: BounceScene, tolerance: float, size: tuple[int, int], spp: int) -> dict[str, Any]:
    """One store and its errors by sky."""
    path = folder / "scene.toml"
    if not path.exists():
        path = write_scene(scene, folder, size)
    store = folder / f"{tolerance:g}.zarr"
    for leftover in (store, store.with_name(store.name + ".partial")):
        shutil.rmtree(leftover, ignore_errors=True)
    # Faces stay whole: cut ones are ten times as many receivers, and half a day for forty stores.
    asked: tuple[str | Path, ...] = ("precompute", path, "-o", store, "--tolerance", str(tolerance), "--no-subdivide")
    receivers, refused, told = "none", "", {}
    for tried in ("vertices", f"pixels:{JUDGE}"):
        if tried == "vertices" and _refused_before(folder, tolerance):
            continue
        asked = (*asked, "--receivers", tried)
        try:
            told = run_tool(*asked)[1]
        except RuntimeError as error:
            if "more than the tolerance" not in str(error):
                raise
            refused = str(error).partition(": ")[2].strip()
            shutil.rmtree(store.with_name(store.name + ".partial"))
        else:
            receivers = tried
            break
    one: dict[str, Any] = {"scene": scene.name, "tolerance": tolerance, "receivers": receivers, "refused": refused}
    one |= {"errors": {}, "predicted": {}, "seconds": 0.0, "bytes": 0}
    if receivers == "none":
        return one
    one |= {key: told[key] for key in ("seconds", "cpu_seconds", "bytes")}
    one["count"] = told["receivers"]
    again = store.with_name("dry.zarr")
    one["predicted"] = run_tool(*asked[:2], "-o", again, *asked[4:], "--dry-run")[1]["predicted"]
    one |= _settings(store)
    for number, (name, sky) in enumerate(judging_skies().items()):
        edit = scene.edit if number % 2 else ()
        one["errors"][name] = _error(folder, store, name, sky, edit, spp)
    shutil.rmtree(store)
    return one


def _refused_before(folder: Path, tolerance: float) -> bool:
    """Whether a larger tolerance was refused at vertices already, so that this one need not be tried there."""
    for other in TOLERANCES:
        record = folder / f"{other:g}.json"
        if other > tolerance and record.exists() and json.loads(record.read_text())["receivers"] != "vertices":
            return True
    return False


def _settings(store: Path) -> dict[str, Any]:
    import relight_formats as formats

    opened = formats.open_store(store)
    kept = {key: opened.settings.get(key) for key in KNOBS}
    return {**kept, "measured": opened.attrs["measured_error"]["share"], "steps": opened.summary.get("steps", {})}


def _error(folder: Path, store: Path, name: str, sky: Picture, edit: tuple[str, ...], spp: int) -> float:
    """Relative RMS of the picture of one sky, of which the references' noise is taken off."""
    from relightcli.adapters.images import write_image
    from relightcli.core.measure.noise_free import power, squared_error
    from relightcli.stages.relight import Config, relight

    map_ = folder / f"{name.replace(' ', '-')}.exr"
    if not map_.exists():
        write_image(map_, sky)
    references = [map_.with_name(f"{map_.stem}-{run}.exr") for run in "ab"]
    common: dict[str, Any] = {"env": str(map_), "camera": JUDGE, "settings": edit, "quiet": True, "workers": 1}
    for seed, reference in enumerate(references):
        if not reference.exists():
            scene = folder / "scene.toml"
            relight(
                Config(
                    store=scene, output=str(reference), reference=True, spp=spp, bounces=BOUNCES, seed=seed, **common
                )
            )
    ours = folder / "ours.exr"
    relight(Config(store=store, output=str(ours), **common))
    x, a, b = (_read(p) for p in (ours, *references))
    return math.sqrt(max(squared_error(x, a, b), 0.0) / power(a, b))


def _read(path: Path) -> Picture:
    from relightcli.adapters.images import read_image

    image = read_image(path)
    return np.stack([image.pixels[..., image.names.index(c)] for c in "RGB"], axis=-1)


def _judge(report: Report, found: list[dict[str, Any]]) -> None:
    """Rows and tables of what was found."""
    kept = [one for one in found if one["errors"]]
    ratios = [e / one["tolerance"] for one in kept for e in one["errors"].values()]
    if ratios:
        under = sum(r <= 1.0 for r in ratios) / len(ratios)
        work = f"share of {len(ratios)} cases under the tolerance"
        report.rows.append(Row(work, 100 * under, "%", target=f">= {100 * KEEPS:g} %", met=under >= KEEPS))
        median = statistics.median(ratios)
        work = "median of error / tolerance"
        report.rows.append(Row(work, median, "", target=f">= {LEAST_MEDIAN}", met=median >= LEAST_MEDIAN))
        # A store does not know its sky: what is kept under a sun is more than kept under an even one.
        median = statistics.median(max(one["errors"].values()) / one["tolerance"] for one in kept)
        report.rows.append(Row("the same, of the worst sky of every store", median, ""))
    # Those of the clock hang on what else the machine does; those of the processors much less.
    for name, what, limit in (
        ("cpu_seconds", "seconds of all processors", SECONDS),
        ("seconds", "seconds of the clock", SECONDS),
        ("bytes", "bytes", BYTES),
    ):
        factors = [one["predicted"][name] / one[name] for one in kept]
        if factors:
            right = sum(1 / limit <= f <= limit for f in factors) / len(factors)
            work = f"share of {len(factors)} stores whose {what} were predicted within {limit}"
            median = statistics.median(factors)
            report.rows.append(Row(work, 100 * right, "%", f"median predicted / real {median:.2f}"))
    told = sum(not one["errors"] for one in found)
    report.rows.append(Row(f"of {len(found)} stores refused as out of reach, pixels included", told, ""))
    names = list(dict.fromkeys(name for one in found for name in one["errors"]))
    rows = []
    for one in found:
        errors = [100 * one["errors"][n] if n in one["errors"] else "" for n in names]
        costs: list[Any] = [""] * 6
        if one["errors"]:
            costs = [
                value for key in ("cpu_seconds", "seconds", "bytes") for value in (one[key], one["predicted"][key])
            ]
            costs[4:] = [size / 1e6 for size in costs[4:]]
        knobs = [str(one.get(k) or "") for k in KNOBS]
        own = 100 * one["measured"] if "measured" in one else ""
        rows.append((one["scene"], 100 * one["tolerance"], one["receivers"], *knobs, own, *errors, *costs))
    columns = ("scene", "tolerance, %", "receivers", "R", "bounces", "cells", "grid", "its own check, %")
    columns = (*columns, *(f"{n}, %" for n in names), "CPU s", "predicted", "s", "predicted", "MB", "predicted")
    report.tables.append(Table("errors by sky, and costs", columns, tuple(rows)))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.promise", description=__doc__)
    parser.add_argument("--scenes", default=",".join(make.__name__ for make in MAKERS))
    parser.add_argument("--tolerances", default=",".join(map(str, TOLERANCES)))
    parser.add_argument("--skies", default=",".join(judging_skies()), help="of those that are measured, to report")
    parser.add_argument("--folder", type=Path, default=KEPT)
    options = parser.parse_args()
    makers = [make for make in MAKERS if make.__name__ in options.scenes.split(",")]
    tolerances = tuple(float(t) for t in options.tolerances.split(","))
    found = run(options.folder, makers, tolerances, tuple(options.skies.split(",")), CELLS, SIZE, SAMPLES)
    print(reports.text("promise", found.to_json()))


if __name__ == "__main__":
    main()
