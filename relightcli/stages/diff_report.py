"""The self-contained HTML page of a comparison."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.html import Picture, Section, Table, page, png_data_uri
from relightcli.core.display import to_display
from relightcli.core.measure.heatmap import heatmap
from relightcli.stages.diff import heatmap_range
from relightcli.stages.diff_pictures import Pair, load_pair
from relightcli.stages.diff_result import Comparison, DiffResult

_SHOWN = 4  # frames of a sequence whose pictures go into the page, the worst ones
_LONGEST = 400  # characters of a header value


ErrorMap = Callable[[str], NDArray[np.float64]]


def report(result: DiffResult, pairs: dict[str, tuple[Path, Path]], error_map: ErrorMap) -> str:
    """The page as text: verdict, table of all values, and for pictures A, B, the heat map and both headers.

    pairs: the picture files by comparison name; empty for stores. error_map: the first metric per pixel, by name.
    """
    verdict = "Within tolerance." if result.passed else "Beyond tolerance."
    sections = [_summary(result)]
    metric = result.settings.metrics[0]
    by_badness = sorted(result.comparisons, key=lambda item: _badness(item, metric), reverse=True)
    shown = by_badness[:_SHOWN] if pairs else []
    sections += [_pictures(item, pairs[item.name], error_map(item.name), metric) for item in shown]
    intro = f"{verdict} A, the test: {result.a}. B, the reference: {result.b}."
    return page("relightcli diff", intro + "".join(f"\n\n{note}" for note in result.notes), sections)


def auto_exposure(reference: NDArray[np.float32]) -> float:
    """Stops, in halves, that bring the reference's 98th percentile of lit pixels near 0.8. 0 if nothing is lit."""
    brightness = reference.mean(axis=2)
    lit = brightness[np.isfinite(brightness) & (brightness > 0)]
    if lit.size == 0:
        return 0.0
    return round(2 * math.log2(0.8 / float(np.quantile(lit, 0.98)))) / 2


def _badness(item: Comparison, metric: str) -> float:
    if not item.values:
        return math.inf
    return -item.values[metric] if metric == "psnr" else item.values[metric]


def _summary(result: DiffResult) -> Section:
    metrics = result.settings.metrics
    header = ["", *metrics, *(f"% beyond {metric} {result.settings.threshold(metric):g}" for metric in metrics), ""]
    rows: list[list[str | int | float]] = []
    for item in result.comparisons:
        values = [item.values.get(metric, math.nan) for metric in metrics]
        percent = [item.percent.get(metric, math.nan) for metric in metrics]
        rows.append([item.name, *values, *percent, " ".join(item.reasons) or "passed"])
        for part, measured in item.parts.items():
            text = ", ".join(f"{metric} {value:.4g}" for metric, value in measured.items())
            rows.append([f"{item.name}: {part}", *[""] * (2 * len(metrics)), text])
    return Section("Values", tables=[Table(header, rows)])


def _pictures(item: Comparison, files: tuple[Path, Path], error: NDArray[np.float64], metric: str) -> Section:
    pair = load_pair(*files)
    largest = heatmap_range(error, metric)
    exposure = 0.0 if pair.display else auto_exposure(pair.colour_b)
    shown = f"{exposure:+g} stops" if exposure else "as it is"
    scale = "rmse" if metric == "psnr" else metric
    pictures = [
        Picture(png_data_uri(_rgb(pair.colour_a, exposure)), f"A: {files[0]}, {shown}"),
        Picture(png_data_uri(_rgb(pair.colour_b, exposure)), f"B: {files[1]}, {shown}"),
        Picture(png_data_uri(heatmap(error, largest)), f"{scale} per pixel, black 0 to pale yellow {largest:.3g}"),
    ]
    return Section(item.name, " ".join(item.notes), pictures, [_headers(pair)])


def _rgb(colour: NDArray[np.float32], exposure: float) -> NDArray[np.uint8]:
    """Three channels to show: RGB, or the first channel as grey."""
    return to_display(colour if colour.shape[2] == 3 else np.repeat(colour[..., :1], 3, axis=2), exposure)


def _headers(pair: Pair) -> Table:
    keys = sorted(set(pair.a.metadata) | set(pair.b.metadata))
    rows = [[key, _short(pair.a.metadata.get(key, "")), _short(pair.b.metadata.get(key, ""))] for key in keys]
    height, width = pair.colour_b.shape[:2]
    rows.insert(0, ["channels", ", ".join(pair.a.names), ", ".join(pair.b.names)])
    return Table([f"{width}x{height}", "A", "B"], rows)


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= _LONGEST else text[:_LONGEST] + "..."
