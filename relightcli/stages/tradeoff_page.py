"""The files of a sweep's report: plots, tables as CSV, and one page that holds everything in itself."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.files import write_atomic
from relightcli.adapters.html import Picture, Section, Table, data_uri, page, png_data_uri
from relightcli.adapters.plots import Curve, bars, scatter
from relightcli.core.display import to_display
from relightcli.stages.diff_report import auto_exposure
from relightcli.stages.tradeoff_result import Result, ahead
from relightcli.stages.tradeoff_tables import HEADER, points_csv, rows, traced_csv

WIDEST = 320  # pixels of a picture in the page
_AXIS_NAMES = {
    "seconds": "seconds to make the store",
    "frame_seconds": "seconds of a further frame",
    "bytes": "MB of the store",
}


@dataclass(frozen=True)
class Shown:
    """A picture of the page, (H, W, 3) scene-linear, and what is said below it."""

    pixels: NDArray[np.float32]
    caption: str


def write_report(
    folder: Path, result: Result, reference: Shown, pictures: Sequence[Shown], command: Sequence[str]
) -> list[str]:
    """Writes everything; returns the files' names, the page first. pictures: of the points of `result.on_front`."""
    plots = _plots(result)
    files = {f"{name}.{suffix}": data for name, plot in plots.items() for suffix, data in plot.items()}
    files["points.csv"] = points_csv(result).encode()
    files["path-tracing.csv"] = traced_csv(result).encode()
    files["index.html"] = _page(result, plots, reference, pictures, command).encode()
    for name, data in files.items():  # the page last: where it is, the rest is too
        write_atomic(folder / name, data)
    return ["index.html", *(name for name in files if name != "index.html")]


def _plots(result: Result) -> dict[str, dict[str, bytes]]:
    """A plot per axis, and the error budget of the points on the fronts."""
    fronts = result.fronts()
    # An error below its own noise is shown at the noise: nothing is known below, and the axis is logarithmic.
    errors = [100 * max(p.error.error, p.error.noise, 1e-9) for p in result.points]
    level = (f"tolerance, {100 * result.tolerance:g} %", 100 * result.tolerance)
    traced = Curve(
        "path tracing, a picture", [t.seconds for t in result.traced], [100 * t.error for t in result.traced]
    )
    plots = {}
    for axis, name in _AXIS_NAMES.items():
        scale = 1e-6 if axis == "bytes" else 1.0
        costs = [max(p.cost(axis) * scale, 1e-9) for p in result.points]
        curve = None if axis == "bytes" else traced
        title = f"Error against {name}"
        file = f"error-{axis.replace('_', '-')}"
        plots[file] = scatter(title, name, "relative RMS error, %", costs, errors, fronts[axis], curve, level)
    kept = result.on_front()
    layers = list(dict.fromkeys(n for k in kept for n in result.points[k].error.share))
    plots["budget"] = bars(
        "Error of each layer, points of the fronts",
        "relative to the picture, %",
        [f"#{k + 1}" for k in kept],
        {n: [100 * result.points[k].error.share.get(n, 0.0) for k in kept] for n in layers},
        x_name="point",
    )
    return plots


def _page(
    result: Result,
    plots: dict[str, dict[str, bytes]],
    reference: Shown,
    pictures: Sequence[Shown],
    command: Sequence[str],
) -> str:
    intro = (
        f"{len(result.points)} points of {result.scene}, seen as {'; '.join(result.views)}. "
        f"Errors are relative RMS of radiance over whole pictures, against path tracing (interreflections: "
        f"{result.bounces}, samples a pixel: {result.spp}), whose noise is taken off; ± is what that noise still "
        f"leaves open. Times are of {result.machine}, {result.workers} workers, and hold there only."
    )
    exposure = auto_exposure(reference.pixels)
    shown = [Picture(_small(s.pixels, exposure), s.caption) for s in (*pictures, reference)]
    sections = [
        Section("What was found", "\n\n".join(result.remarks())),
        Section(
            "What the measurement leaves open", "\n\n".join(result.undecided() or ["Nothing of what is told here."])
        ),
        Section(
            "Error against cost",
            "Numbers are those of the table. Filled points are the front: no other has both less error and less cost. "
            "Crosses: path tracing, at the error of its own variance. Errors below their noise are drawn at the noise.",
            [Picture(data_uri(plot["svg"], "image/svg+xml"), _alt(name)) for name, plot in plots.items()],
        ),
        Section(
            "All points",
            "Seconds are the least of the repeats. Memory is that of the largest process. FLIP counts the noise of the "
            "references too. A dominated point is nowhere "
            "better than the one named, in error, time or bytes.",
            tables=[_points(result), _costs(result), _path_tracing(result)],
        ),
        Section(
            "Error budget",
            "Left: error of a layer relative to the whole picture; right (own): relative to the layer. Each is judged "
            "against the references' layer. Errors of different layers may add up or cancel in the picture.",
            tables=[_budget(result)],
        ),
        Section("Pictures of the fronts", "The last one is path-traced.", shown),
        Section(
            "How to repeat it",
            shlex.join(command),
            tables=[_commands(result)],
        ),
    ]
    return page("relightcli tradeoff", intro, sections)


def _points(result: Result) -> Table:
    """The table of the terminal, its numbers rounded alike."""
    forms = HEADER.values()
    shown = [
        [float(f"{cell:{form}}") if isinstance(cell, float) else cell for cell, form in zip(row, forms, strict=True)]
        for row in rows(result)
    ]
    return Table(list(HEADER), shown)


def _costs(result: Result) -> Table:
    header = (
        "#",
        "worst picture",
        "error %",
        "simulate: repeats, largest less least, s",
        "CPU s",
        "first picture s",
        "frame: largest less least, s",
        "path tracing to this error, s a picture",
        "ahead from pictures",
    )
    tracer = result.tracer()
    lines: list[list[str | int | float]] = []
    for k, p in enumerate(result.points):
        gain = ahead(p, tracer)
        lines.append(
            [
                *(k + 1, p.error.worst_view, 100 * p.error.worst, f"{p.repeats}, {p.seconds_spread:.2f}"),
                *(p.cpu_seconds, p.picture_seconds, p.frame_spread, gain.traced_seconds),
                "never" if gain.pictures is None else gain.pictures,
            ]
        )
    return Table(header, lines)


def _path_tracing(result: Result) -> Table:
    header = ("path tracing, samples a pixel", "error %", "seconds a picture")
    return Table(header, [[t.spp, 100 * t.error, t.seconds] for t in result.traced])


def _budget(result: Result) -> Table:
    layers = list(dict.fromkeys(n for p in result.points for n in p.error.share))
    header = ["#", "point", *(f"{n} %" for n in layers), *(f"own {n} %" for n in layers)]
    lines: list[list[str | int | float]] = []
    for k, p in enumerate(result.points):
        share = [100 * p.error.share[n] for n in layers]
        own = [100 * p.error.own[n] if n in p.error.own else "-" for n in layers]
        lines.append([k + 1, p.label, *share, *own])
    return Table(header, lines)


def _commands(result: Result) -> Table:
    """What a user types to have a point's store, its pictures, and the truth."""
    lines = [(p.label, "; ".join(map(shlex.join, p.commands))) for p in result.points]
    lines += [(f"{name}: picture and truth", "; ".join(map(shlex.join, made))) for name, made in result.looks.items()]
    return Table(("what", "commands"), lines)


def _alt(name: str) -> str:
    words = name.removeprefix("error-").replace("-", "_")
    return "error by layer" if name == "budget" else f"error against {_AXIS_NAMES[words]}"


def _small(pixels: NDArray[np.float32], exposure: float) -> str:
    """A picture of at most WIDEST pixels a side, by averaging whole blocks of light."""
    step = -(-max(pixels.shape[:2]) // WIDEST)
    height, width = (max(1, n // step) for n in pixels.shape[:2])
    cut = pixels[: height * step, : width * step] if step > 1 else pixels
    blocks = cut.reshape(height, cut.shape[0] // height, width, cut.shape[1] // width, 3)
    return png_data_uri(to_display(blocks.mean(axis=(1, 3)), exposure))
