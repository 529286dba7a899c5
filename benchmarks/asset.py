"""Transfer tensors: offline time and size, frames per second by what changes, error against the transfer store."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.processes import run_tool
from benchmarks.report import Report, Row, Table, at_most
from benchmarks.scenes import Setting, two_skies, write_scene

EIGENVECTORS, LIGHTS = (8, 16, 32, 64), (16, 32, 64, 96)
METAL = """\
model = "cook-torrance"
diffuse = [0.3, 0.2, 0.15]
specular = [0.6, 0.5, 0.4]
f0 = 0.7
roughness = 0.3
adjustable = true
"""
FRAMES = {
    "view": (150, "camera = 'main'\n", "camera = 'turned'\n"),
    "materials": (
        60,
        "camera = 'main'\nset = { 'clay.roughness' = 0.2, 'clay.diffuse' = [0.4, 0.2, 0.1] }\n",
        "camera = 'turned'\nset = { 'clay.roughness' = 0.6, 'clay.diffuse' = [0.1, 0.2, 0.4] }\n",
    ),
    "light": (
        25,
        "camera = 'main'\nenv_rotate = 0\nset = { 'clay.roughness' = 0.2 }\n",
        "camera = 'turned'\nenv_rotate = 90\nset = { 'clay.roughness' = 0.6 }\n",
    ),
}
EDIT = ("--set", "clay.roughness=0.4", "--set", "clay.diffuse=0.1,0.3,0.5", "--set", "clay.specular=0.5,0.5,0.5")


def metal_scene(setting: Setting, vertices: int | None = None) -> tuple[Path, str]:
    """The benchmark's scene with its object of one adjustable Cook-Torrance material, and a second camera."""
    source, subject = write_scene(setting, vertices)
    folder = setting.work / f"metal-{vertices or 'main'}"
    shutil.copytree(source.parent, folder, dirs_exist_ok=True)
    scene = folder / "scene.toml"
    scene.chmod(0o644)
    text = scene.read_text()
    start = text.index("[materials.clay]\n") + len("[materials.clay]\n")
    end = text.index("\n\n", start)
    camera = "\n[cameras.turned]\neye = [-1.6, 1.9, 3.2]\ntarget = [-0.1, 0.55, 0]\nfov = 36\nsize = [640, 480]\n"
    scene.write_text(text[:start] + METAL + text[end + 1 :] + camera)
    return scene, subject


def offline(scene: Path, folder: Path, options: Sequence[str]) -> tuple[float, int, list[tuple[str, float, int]], dict]:
    """Runs the three stages: seconds in all, largest peak, (stage, seconds, bytes) and what factorize said."""
    transfer, clusters, asset = (folder / f"{name}.zarr" for name in ("transfer", "clusters", "asset"))
    rows, seconds, peak = [], 0.0, 0
    said = {}
    for stage, arguments in (
        ("precompute", ("precompute", scene, "-o", transfer, "--bounces", "2", *options)),
        ("cluster", ("cluster", transfer, "-o", clusters)),
        ("factorize", ("factorize", clusters, "-o", asset)),
    ):
        finished, said = run_tool(*arguments)
        rows.append((stage, finished.seconds, said["bytes"]))
        seconds += finished.seconds
        peak = max(peak, finished.peak_bytes)
    return seconds, peak, rows, said


def frame_rates(setting: Setting, asset: Path, sky: Path) -> list[Row]:
    """Frames of vertex colours per second, by what changes from frame to frame."""
    rows = []
    frames = 5 if setting.quick else 15
    for kind, (target, first, last) in FRAMES.items():
        keys = "".join(f"[[key]]\nframe = {1 + k}\n{(first, last)[k % 2]}" for k in range(frames))
        shots = setting.work / f"{kind}.toml"
        shots.write_text(f"format = 1\nframes = {frames}\n{keys}")
        output = setting.work / f"{kind}.zarr"
        _, said = run_tool("relight", asset, "--env", sky, "--frames", shots, "-o", output, "--overwrite")
        rate = said["rates"][kind]
        changes = {"view": "view", "materials": "view and BRDF", "light": "view, BRDF and light"}[kind]
        rows.append(
            Row(f"vertex colours, new {changes}", rate, "frames/s", "", rate / target, f">= {target}", rate >= target)
        )
    return rows


def errors(setting: Setting, folder: Path, skies: dict[str, Path]) -> Table:
    """Relative RMS of the asset's pictures against the transfer store's, whole and by layer, after an edit."""
    from relightcli.adapters.images import read_image
    from relightcli.core.measure.errors import relative_rmse

    rows = []
    for name, sky in skies.items():
        pictures = []
        for store in ("transfer", "asset"):
            out = setting.work / f"{store}.exr"
            run_tool("relight", folder / f"{store}.zarr", "--env", sky, "--layers", *EDIT, "-o", out)
            image = read_image(out)
            pictures.append({k: image.pixels[..., v[:3]] for k, v in image.layers().items() if len(v) >= 3})
        a, b = pictures
        layers = ("", "direct", "specular", "one_bounce", "two_bounce")
        rows.append((name, *(100.0 * relative_rmse(b[layer], a[layer]) for layer in layers)))
    return Table(
        "error of the asset against the transfer store, %",
        ("sky", "picture", "direct", "specular", "one bounce", "two"),
        tuple(rows),
    )


def compression(setting: Setting, clusters: Path) -> Table:
    """Relative RMS of one-bounce tensors over ranks, of a few clusters, by one HOSVD. [Sun 2007, Fig. 9, 10]"""
    from relightcli.core.compress.tucker import hosvd
    from relightcli.stages.lighting import LightingStore
    from relightcli.stages.transfer_setup import TransferSetup

    lighting = LightingStore(clusters, 2)
    setup = TransferSetup(lighting, int(lighting.store.settings["functions"]), 2)
    basis, label = lighting.store.read("light/basis"), lighting.store.read("cluster/label")
    sources = setup.sources(basis)
    picked = np.unique(label)[:: max(1, (int(label.max()) + 1) // (2 if setting.quick else 8))]
    left, norm2 = np.zeros((len(EIGENVECTORS), len(LIGHTS))), 0.0
    for c in picked:
        rows = np.flatnonzero(label == c)[:1500]
        tensor = setup.gather_rows(rows, sources, 4)
        tensor = tensor.reshape(len(rows), -1, tensor.shape[-1])
        found = hosvd(tensor, (EIGENVECTORS[-1], None, LIGHTS[-1]))
        norm2 += found.norm2
        square: NDArray[np.float64] = (found.core**2).sum(1)
        for i, v in enumerate(EIGENVECTORS):
            for j, rank in enumerate(LIGHTS):
                left[i, j] += found.norm2 - float(square[:v, :rank].sum())
    error = np.sqrt(np.maximum(left, 0.0) / norm2)
    table = Table(
        f"one bounce: what compression leaves out, relative RMS, {len(picked)} clusters",
        ("eigenvectors", *(f"light {rank}" for rank in LIGHTS)),
        tuple((v, *map(float, line)) for v, line in zip(EIGENVECTORS, error, strict=True)),
    )
    _plot(setting.work.parent / "asset.png", error)
    return table


def _plot(path: Path, error: NDArray[np.float64]) -> None:
    try:
        import matplotlib
    except ImportError:
        return
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axis = pyplot.subplots(figsize=(5.5, 4.0), layout="constrained")
    for j, rank in enumerate(LIGHTS):
        axis.semilogy(EIGENVECTORS, error[:, j], marker=".", label=f"light {rank}")
    axis.set(xlabel="eigenvectors per cluster", ylabel="relative RMS of one-bounce tensors", xticks=EIGENVECTORS)
    axis.legend()
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


def measure(setting: Setting) -> Report:
    scene, subject = metal_scene(setting)
    folder = scene.parent
    skies = two_skies(setting)
    seconds, peak, stages, said = offline(scene, folder, setting.options)
    report = Report(f"{subject}, one adjustable Cook-Torrance material, {said['receivers']:,} receivers, two bounces")
    report.rows += [
        at_most("all offline stages", seconds, "s", 300),
        at_most("asset", stages[-1][2] / 1e6, "MB", 60),
        at_most("peak memory of a process", peak / 1e9, "GB", 4),
        *frame_rates(setting, folder / "asset.zarr", next(iter(skies.values()))),
    ]
    for name, error in said["errors"].items():
        report.rows.append(Row(f"{name}: left out by compression and rounding", error["total"], "relative RMS"))
        report.rows.append(Row(f"{name}: of the worst cluster", error["worst_cluster"], "relative RMS"))
    report.tables.append(
        Table("stages", ("stage", "s", "MB"), tuple((name, s, size / 1e6) for name, s, size in stages))
    )
    report.tables.append(errors(setting, folder, skies))
    report.tables.append(compression(setting, folder / "clusters.zarr"))
    return report
