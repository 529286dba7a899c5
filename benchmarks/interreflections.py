"""Interreflections against path tracing: scenes in which light bounces, edited after the simulation, by layer.

Errors are relative RMS over the whole picture, shadow edges and outlines included. The path tracer's noise is not
counted: with two independent references A and B, the mean of (ours - A)(ours - B) is free of it.
"""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.bounce_scenes import MAKERS, write
from benchmarks.processes import run_tool
from benchmarks.report import Report, Row, Table
from benchmarks.scenes import Setting

BOUNCES = 2
LAYERS = ("", "direct", "specular", "one_bounce", "two_bounce")
LIMIT = {False: 3.0, True: 6.0}  # %, diffuse and glossy scenes
FLIP_LIMIT = 0.05
REPEATS = 3
MOST = 4  # interreflections of the table over their number
RECEIVERS = {
    "vertices": (),
    "pixels": ("--receivers", "pixels:main"),
    "pixels, 2 x 2": ("--receivers", "pixels:main", "--pixel-grid", "2"),
}
Picture = dict[str, NDArray[np.float32]]


def read(path: Path, layers: tuple[str, ...] = LAYERS) -> Picture:
    """RGB of the beauty ("") and of the layers."""
    from relightcli.adapters.images import read_image

    image = read_image(path)
    at = {name: image.pixels[..., k] for k, name in enumerate(image.names)}
    return {name: np.stack([at[f"{name}.{c}" if name else c] for c in "RGB"], axis=-1) for name in layers}


def error(ours: NDArray[np.float32], a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """Relative RMS of ours in %, without the noise of the references a and b."""
    x, y, z = (p.astype(np.float64) for p in (ours, a, b))
    if not y.any():
        return 0.0 if not x.any() else float("inf")
    return 100.0 * float(np.sqrt(max(0.0, np.mean((x - y) * (x - z)) / np.mean(y * z))))


def skies(work: Path) -> dict[str, Path]:
    from relightcli.adapters.images import write_image
    from relightcli.core.lights.sky import sky_latlong

    out = {"overcast": work / "overcast.exr", "sun": work / "sun.exr"}
    write_image(out["overcast"], sky_latlong(45.0, overcast=True))
    write_image(out["sun"], sky_latlong(40.0, 150.0))
    return out


def measure(setting: Setting) -> Report:
    from relightcli.adapters.flip import flip_hdr

    size, spp, cells = ((40, 30), 8, 8) if setting.quick else ((160, 120), 256, 24)
    maps = skies(setting.work)
    report = Report(f"{BOUNCES} interreflections, {size[0]}x{size[1]}, references of {2 * spp} samples a pixel")
    table: list[tuple[str | int | float, ...]] = []
    costs: list[tuple[str | int | float, ...]] = []
    for make in MAKERS[:1] if setting.quick else MAKERS:
        scene = make(cells)
        if scene is None:
            report.skipped.append(f"{make.__name__}: no test data")
            continue
        folder = setting.work / make.__name__
        path = write(scene, folder, size)
        stores, made = {}, {}
        for receivers, asked in RECEIVERS.items():
            stores[receivers] = store = folder / f"{len(stores)}.zarr"
            more = (*asked, "--bounces", str(BOUNCES), *setting.options)
            _, made[receivers] = run_tool("precompute", path, "-o", store, *more)
        edit = [word for change in scene.edit for word in ("--set", change)]
        for sky, environment in maps.items():
            common = ("--env", environment, "--layers", *edit)
            references = [folder / f"{sky}-{k}.exr" for k in "ab"]
            for seed, output in enumerate(references):
                more = ("--reference", "--spp", str(spp), "--seed", str(seed))
                run_tool("relight", stores["vertices"], *common, "-o", output, *more)
            a, b = (read(p) for p in references)
            for receivers, store in stores.items():
                output = store.with_name(f"{sky}-{store.stem}.exr")
                run_tool("relight", store, *common, "-o", output)
                ours = read(output)
                found = [error(ours[name], a[name], b[name]) for name in LAYERS]
                flip = float(flip_hdr(ours[""], 0.5 * (a[""] + b[""])).mean())
                means = [float(ours[n].mean() / max((0.5 * (a[n] + b[n])).mean(), 1e-30)) for n in LAYERS[1:]]
                kind = "glossy" if scene.glossy else "diffuse"
                table.append((scene.name, kind, sky, receivers, *found, flip, *means))
                limit = LIMIT[scene.glossy]
                work = f"{scene.name}, {sky}, {receivers}"
                report.rows.append(
                    Row(f"{work}: {scene.about}", found[0], "%", target=f"<= {limit:g} %", met=found[0] <= limit)
                )
                met = flip <= FLIP_LIMIT
                report.rows.append(Row(f"{work}: FLIP", flip, "", target=f"<= {FLIP_LIMIT}", met=met))
        for receivers, store in stores.items():
            told = made[receivers]
            cost = (told["receivers"], told["bytes"] / 1e6, told["seconds"], *_frames(store, maps["sun"]))
            costs.append((scene.name, receivers, *cost))
    columns = ("scene", "kind", "sky", "receivers", "error, %", *(f"{n}, %" for n in LAYERS[1:]), "FLIP")
    report.tables.append(
        Table(
            "error by layer after the edit, and the layers' means relative to the references'",
            (*columns, *(f"mean {n}" for n in LAYERS[1:])),
            tuple(table),
        )
    )
    report.tables.append(
        Table(
            "cost; a frame is a new sky, lit and assembled",
            ("scene", "at", "receivers", "MB", "precompute, s", "s a frame, direct", "s a frame, two bounces"),
            tuple(costs),
        )
    )
    report.tables.append(more_bounces(setting, maps["overcast"], size, spp, cells))
    return report


def more_bounces(setting: Setting, sky: Path, size: tuple[int, int], spp: int, cells: int) -> Table:
    """The first scene over the number of interreflections: error, what the next ones would add, seconds a frame."""
    scene = MAKERS[0](cells)
    assert scene is not None
    folder = setting.work / "more"
    store = folder / "more.zarr"
    path = write(scene, folder, size)
    run_tool("precompute", path, "-o", store, "--bounces", str(MOST), *setting.options)
    edit = [word for change in scene.edit for word in ("--set", change)]
    pictures = {}
    for k in range(MOST + 1):
        common = ("--env", sky, "--bounces", str(k), *edit)
        run_tool("relight", store, *common, "-o", folder / f"{k}.exr")
        found = [folder / f"{k}.exr"]
        for seed in range(2):
            found.append(folder / f"{k}-{seed}.exr")
            run_tool("relight", store, *common, "-o", found[-1], "--reference", "--spp", str(spp), "--seed", str(seed))
        pictures[k] = [read(p, ("",))[""] for p in found]
    rows = []
    for k, (ours, a, b) in pictures.items():
        _, c, d = pictures[MOST]
        rows.append((k, error(ours, a, b), error(ours, c, d), _frames(store, sky, (k,))[0]))
    of = f"error against {MOST}, %"
    return Table(f"{scene.name}: K interreflections", ("K", "error, %", of, "s a frame"), tuple(rows))


def _frames(store: Path, environment: Path, numbers: tuple[int, ...] = (0, BOUNCES)) -> list[float]:
    """Seconds a frame of a turning sky, for some numbers of interreflections."""
    shots = store.parent / "shots.toml"
    shots.write_text(
        f"format = 1\nframes = {REPEATS + 1}\n[[key]]\nframe = 1\nenv = '{environment}'\nenv_rotate = 0\n"
        "[[key]]\nframe = 5\nenv_rotate = 100\n"
    )
    out: list[float] = []
    for bounces in numbers:
        _, told = run_tool(
            "relight", store, "--frames", shots, "-o", store.parent / "f##.exr", "--bounces", str(bounces)
        )
        told_frames: list[Any] = told["frame_seconds"]
        out.append(statistics.median(told_frames[1:]))  # the first reads the store
    return out
