"""Moved objects by their fields against path tracing of the same places, by layer, and as the fields get finer.

Errors are relative RMS over the whole picture, shadow edges and outlines included; the references' noise is not counted
(`interreflections.error`). In one scene the materials of all movers are changed as well. Under a small sun errors are
those of soft and of traced shadows.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.interreflections import Picture, error
from benchmarks.moving_scenes import MAKERS, MovingScene, ball, bar, room, write
from benchmarks.processes import cores
from benchmarks.report import Report, Row, Table, at_most
from benchmarks.scenes import Setting

BOUNCES = 1
WHOLE, TWICE, FLIP = 8.0, 15.0, 0.08
LAYERS = ("", "direct", "one_bounce")
BASE = {"field_shells": 8, "field_resolution": 8, "field_proxies": 8, "field_order": 4}
FROM = {"field_shells": 6, "field_resolution": 6, "field_proxies": 4, "field_order": 4}  # where the curves meet
# Each in a scene that it counts in: bands where blocks and walls hide each other, spheres and proxies next to a lamp.
CURVE: tuple[tuple[Callable[[int, int], MovingScene], str, tuple[int, ...]], ...] = (
    (room, "field_order", (4, 6, 8)),
    (bar, "field_shells", (3, 6, 12)),
    (bar, "field_proxies", (1, 4, 16)),
)


def measure(setting: Setting) -> Report:
    from relightcli.adapters.flip import flip_hdr

    size, spp = ((40, 30), 8) if setting.quick else ((96, 72), 128)
    cells, detail = (8, 2) if setting.quick else (20, 3)
    report = Report(
        f"moved objects, {BOUNCES} interreflection, {size[0]}x{size[1]}, references of {2 * spp} samples a pixel; "
        + ", ".join(f"{key.removeprefix('field_')} {value}" for key, value in BASE.items())
    )
    table: list[tuple[str | int | float, ...]] = []
    for make in MAKERS[:1] if setting.quick else MAKERS:
        made = make(cells, detail)
        if made is None:
            report.skipped.append(f"{make.__name__}: no test data")
            continue
        path = write(made, setting.work / make.__name__, size)
        sky = _sky(path.parent, made.even)
        store, seconds = _store(path, "store", made.coarse, **BASE)
        worst = dict.fromkeys(LAYERS, 0.0)
        most = 0.0
        for moves in made.places[:1] if setting.quick else made.places:
            edit = made.scene.edit
            ours, milliseconds = _picture(store, sky, moves, settings=edit)
            refs = _references(store, sky, moves, spp, settings=edit)
            errors = {name: error(ours[name], *(r[name] for r in refs)) for name in LAYERS}
            flip = float(flip_hdr(ours[""], 0.5 * (refs[0][""] + refs[1][""])).mean())
            worst = {name: max(worst[name], errors[name]) for name in LAYERS}
            most = max(most, flip)
            table.append((made.scene.name, moves[0], *errors.values(), flip, milliseconds))
        about = made.scene.about
        report.rows += [
            at_most(f"{about}: picture", worst[""], "%", WHOLE),
            at_most(f"{about}: FLIP", most, "", FLIP),
            at_most(f"{about}: reflected twice", worst["one_bounce"], "%", TWICE),
        ]
        table.append((made.scene.name, f"precompute took {seconds:.0f} s", "", "", "", "", ""))
    columns = ("scene", "place", "picture, %", "direct, %", "reflected twice, %", "FLIP", "light, ms")
    report.tables.append(Table("error of every place", columns, tuple(table)))
    curve, falling = _curve(setting, size, spp, cells, detail)
    report.rows += falling
    report.tables.append(curve)
    suns, row = _suns(setting, spp, cells, detail)
    report.rows.append(row)
    report.tables.append(suns)
    return report


def _curve(setting: Setting, size: tuple[int, int], spp: int, cells: int, detail: int) -> tuple[Table, list[Row]]:
    """Errors as each setting of the fields grows, and whether they fall."""
    rows: list[tuple[str | int | float, ...]] = []
    falling: list[Row] = []
    known: dict[tuple[str, tuple[int, ...]], tuple[float, ...]] = {}
    for make, key, values in CURVE[:1] if setting.quick else CURVE:
        made = make(cells, detail)
        path = write(made, setting.work / f"curve-{key}", size)
        sky = _sky(path.parent, made.even)
        refs: list[Picture] = []
        found = {}
        for value in values[:2] if setting.quick else values:
            fields = {**FROM, key: value}
            settings = made.scene.name, tuple(fields.values())
            if settings not in known:
                store, seconds = _store(path, f"{value}", False, **fields)
                refs = refs or _references(store, sky, made.places[0], 4 * spp)
                ours, milliseconds = _picture(store, sky, made.places[0])
                known[settings] = *(error(ours[n], *(r[n] for r in refs)) for n in LAYERS), milliseconds, seconds
                shutil.rmtree(store)
            found[value] = known[settings]
            rows.append((made.scene.about, key.removeprefix("field_"), value, *known[settings]))
        first, last = min(found), max(found)
        for what, k in (("picture", 0), ("reflected twice", 2)):
            if found[first][k] > 0.0:
                work = f"{what}: error at {key.removeprefix('field_')} {last}, of that at {first}"
                falling.append(at_most(work, found[last][k] / found[first][k], "", 1.0))
    columns = ("scene", "knob", "value", "picture, %", "direct, %", "reflected twice, %", "light, ms", "precompute, s")
    about = ", ".join(f"{key.removeprefix('field_')} {value}" for key, value in FROM.items())
    return Table(f"as fields grow; else {about}", columns, tuple(rows)), falling


def _suns(setting: Setting, spp: int, cells: int, detail: int) -> tuple[Table, Row]:
    """Soft and traced shadows of the sun, and the largest error with traced ones."""
    from relightcli.adapters.images import write_image
    from relightcli.core.lights.sky import sky_latlong

    made: MovingScene = ball(cells, detail)
    store = setting.work / ball.__name__ / "store.zarr"  # of the first scene
    sky = store.parent / "sun.exr"
    write_image(sky, sky_latlong(40.0, 150.0))
    rows: list[tuple[str | int | float, ...]] = []
    for moves in made.places[1:2] if setting.quick else made.places[1::2]:
        refs = _references(store, sky, moves, spp)
        for suns in ("soft", "traced"):
            ours, milliseconds = _picture(store, sky, moves, suns=suns)
            rows.append((moves[0], suns, *(error(ours[n], *(r[n] for r in refs)) for n in LAYERS), milliseconds))
    columns = ("place", "--suns", "picture, %", "direct, %", "reflected twice, %", "light, ms")
    worst = max(float(row[2]) for row in rows if row[1] == "traced")
    judged = at_most(f"{made.scene.about} in the sun, its shadows traced: picture", worst, "%", WHOLE)
    return Table("a ball over a plane in the sun", columns, tuple(rows)), judged


def _sky(folder: Path, even: bool) -> Path:
    from relightcli.adapters.images import write_image

    lat, lon = (np.arange(32) + 0.5) / 32 * np.pi, (np.arange(64) + 0.5) / 32 * np.pi
    light = 1 + 0.8 * np.cos(lat)[:, None] + 0.4 * np.sin(lat)[:, None] * np.cos(lon)
    radiance = np.ones((32, 64, 3)) if even else light[..., None] * np.array([1.0, 0.9, 1.1])
    write_image(folder / "sky.exr", radiance.astype(np.float32))
    return folder / "sky.exr"


def _store(path: Path, name: str, subdivide: bool, **fields: Any) -> tuple[Path, float]:
    """Precomputes; the store and the seconds that it took."""
    from relightcli.stages.precompute import precompute
    from relightcli.stages.precompute_config import Config

    started = time.perf_counter()
    store = path.parent / f"{name}.zarr"
    precompute(
        Config(
            scene=path,
            output=store,
            quiet=True,
            workers=cores(),
            subdivide=subdivide,
            light_resolution=32,
            bounces=BOUNCES,
            **fields,
        )
    )
    return store, time.perf_counter() - started


def _picture(store: Path, sky: Path, moves: tuple[str, ...], **more: Any) -> tuple[Picture, float]:
    """The layers of a picture, and the milliseconds that light took the second time."""
    from relightcli.stages.relight import Config, relight

    output = store.parent / "picture.exr"
    config = Config(store=store, output=str(output), env=str(sky), moves=moves, layers=True, quiet=True, **more)
    relight(config)
    again = relight(Config(**{**config.__dict__, "output": str(store.parent / "whole.exr"), "layers": False}))
    return _read(output), 1e3 * again["lighting_seconds"]


def _references(store: Path, sky: Path, moves: tuple[str, ...], spp: int, **more: Any) -> list[Picture]:
    """Two that do not know of each other."""
    from relightcli.stages.relight import Config, relight

    out = []
    for seed in (0, 1):
        output = store.parent / f"reference{seed}.exr"
        relight(
            Config(
                store=store,
                output=str(output),
                env=str(sky),
                moves=moves,
                layers=True,
                reference=True,
                spp=spp,
                seed=seed,
                workers=cores(),
                overwrite=True,
                quiet=True,
                **more,
            )
        )
        out.append(_read(output))
    return out


def _read(path: Path) -> Picture:
    from relightcli.adapters.images import read_image

    image = read_image(path)
    at: dict[str, NDArray[np.float32]] = {name: image.pixels[..., k] for k, name in enumerate(image.names)}
    return {name: np.stack([at[f"{name}.{c}" if name else c] for c in "RGB"], axis=-1) for name in LAYERS}
