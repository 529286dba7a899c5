"""Two pictures, channel group by channel group."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.images import Image, read_image
from relightcli.core.measure.errors import (
    decibels,
    pixel_relative_rmse,
    pixel_rmse,
    psnr,
    relative_rmse,
    rmse,
)
from relightcli.errors import InputError
from relightcli.stages.diff_result import Comparison, DiffSettings, judge

ALPHA = "A"


@dataclass(frozen=True)
class Pair:
    """Picture A, reference B, and their colour channels in the same order."""

    a: Image
    b: Image
    colour_a: NDArray[np.float32]  # (H, W, C)
    colour_b: NDArray[np.float32]

    @property
    def display(self) -> bool:
        """Both hold display values: white is 1, and FLIP is the LDR one."""
        return self.a.display and self.b.display


@dataclass(frozen=True)
class PictureDifference:
    """A comparison and `error` (H, W): the first metric per pixel (for PSNR the RMSE), NaN where not finite."""

    comparison: Comparison
    error: NDArray[np.float64]


def load_pair(a: Path, b: Path) -> Pair:
    """Read both pictures. Raises InputError if sizes or colour channels differ, or one cannot be read."""
    image_a, image_b = read_image(a), read_image(b)
    size_a, size_b = image_a.pixels.shape[:2], image_b.pixels.shape[:2]
    if size_a != size_b:
        raise InputError(f"{a} is {size_a[1]}x{size_a[0]} pixels and {b} {size_b[1]}x{size_b[0]}; expected one size.")
    names_a, names_b = _colour(image_a), _colour(image_b)
    if [image_a.names[c].lower() for c in names_a] != [image_b.names[c].lower() for c in names_b]:
        raise InputError(
            f"{a} has the channels {', '.join(image_a.names)} and {b} {', '.join(image_b.names)}; expected the same."
        )
    for path, one, other in ((a, image_a, image_b), (b, image_b, image_a)):
        alpha = _parts(one).get(ALPHA)
        if alpha is not None and ALPHA not in _parts(other) and not np.all(one.pixels[..., alpha] == 1):
            raise InputError(
                f"only {path} has an alpha channel; expected both or neither, or one that is 1 everywhere."
            )
    return Pair(image_a, image_b, image_a.pixels[..., names_a], image_b.pixels[..., names_b])


def compare_pictures(name: str, a: Path, b: Path, settings: DiffSettings) -> PictureDifference:
    """Measure A against the reference B.

    The thresholds judge the colour channels; alpha and layers are reported, and must be equal only where no threshold
    was given at all. NaN or infinity in any channel that both have is a failure.
    """
    pair = load_pair(a, b)
    notes = [*pair.a.notes, *pair.b.notes]
    if pair.a.display != pair.b.display:
        notes.append("one picture holds display values, the other scene-linear ones; compared as linear light.")
    parts_a, parts_b = _parts(pair.a), _parts(pair.b)
    notes += [f"{part} is only in {a.name}; not compared." for part in parts_a if part not in parts_b]
    notes += [f"{part} is only in {b.name}; not compared." for part in parts_b if part not in parts_a]

    reasons = [
        line
        for path, image, other in ((a, pair.a, parts_b), (b, pair.b, parts_a))
        if (line := _not_finite(path, image, other))
    ]
    both_finite = np.asarray(np.all(np.isfinite(pair.colour_a) & np.isfinite(pair.colour_b), axis=2))
    if not both_finite.all():
        clean_a, clean_b = (np.where(both_finite[..., None], x, 0) for x in (pair.colour_a, pair.colour_b))
        error = np.where(both_finite, _pixel_errors(settings.metrics[0], clean_a, clean_b, pair.display), np.nan)
        return PictureDifference(Comparison(name, {}, {}, {}, tuple(reasons), tuple(notes)), error)

    maps = {m: _pixel_errors(m, pair.colour_a, pair.colour_b, pair.display) for m in settings.metrics}
    peak = 1.0 if pair.display else max(float(pair.colour_b.max()), 0.0)
    values, percent = {}, {}
    for metric, per_pixel in maps.items():
        values[metric] = (
            float(per_pixel.mean()) if metric == "flip" else measure(metric, pair.colour_a, pair.colour_b, peak)
        )
        percent[metric] = percent_beyond(metric, per_pixel, settings.threshold(metric), peak)
    parts = {}
    for part, channels in parts_a.items():
        if part not in parts_b:
            continue
        one, other = pair.a.pixels[..., channels], pair.b.pixels[..., parts_b[part]]
        if one.shape != other.shape:
            raise InputError(f"layer {part} has {one.shape[2]} channels in {a} and {other.shape[2]} in {b}.")
        if np.isfinite(one).all() and np.isfinite(other).all():
            parts[part] = {m: measure(m, one, other) for m in settings.metrics if m != "flip"} or {
                "rmse": rmse(one, other)
            }
            if settings.exact and not np.array_equal(one, other):
                reasons.append(f"{part} differs; expected no difference, because no --fail was given.")
    reasons += judge(values, percent, settings)
    return PictureDifference(
        Comparison(name, values, percent, parts, tuple(reasons), tuple(notes)), maps[settings.metrics[0]]
    )


def measure(metric: str, a: NDArray[np.floating], b: NDArray[np.floating], peak: float | None = None) -> float:
    """rmse, relrmse or psnr of two arrays of one shape."""
    if metric == "psnr":
        return psnr(a, b, peak)
    return rmse(a, b) if metric == "rmse" else relative_rmse(a, b)


def percent_beyond(metric: str, per_pixel: NDArray[np.float64], threshold: float, peak: float) -> float:
    """Percentage of pixels whose own error is beyond the threshold (for PSNR: whose own PSNR is below it)."""
    if per_pixel.size == 0:
        return 0.0
    beyond = decibels(per_pixel, peak) < threshold if metric == "psnr" else per_pixel > threshold
    return 100.0 * float(np.count_nonzero(beyond)) / per_pixel.size


def _pixel_errors(metric: str, a: NDArray[np.float32], b: NDArray[np.float32], display: bool) -> NDArray[np.float64]:
    """(H, W): what the metric is made of. PSNR shares the RMSE; FLIP is the error map itself."""
    if metric == "relrmse":
        return pixel_relative_rmse(a, b)
    if metric != "flip":
        return pixel_rmse(a, b)
    from relightcli.adapters.flip import flip_hdr, flip_ldr

    if a.shape[2] not in (1, 3):
        raise InputError(f"flip needs R, G, B or one grey channel; found {a.shape[2]} channels.")
    a, b = (np.repeat(x, 3, axis=2) if x.shape[2] == 1 else x for x in (a, b))
    return (flip_ldr if display else flip_hdr)(a, b).astype(np.float64)


def _colour(image: Image) -> list[int]:
    """The channels that the thresholds judge: R, G, B; else those outside layers but alpha; else all."""
    lower = [name.lower() for name in image.names]
    if {"r", "g", "b"} <= set(lower):
        return [lower.index(c) for c in "rgb"]
    own = [c for c in image.layers().get("", []) if lower[c] not in ("a", "alpha")]
    return own or list(range(len(image.names)))


def _parts(image: Image) -> dict[str, list[int]]:
    """Everything else: alpha as "A", other channels by their name, layers by theirs."""
    colour = set(_colour(image))
    parts: dict[str, list[int]] = {}
    for layer, channels in image.layers().items():
        rest = [c for c in channels if c not in colour]
        if layer and rest:
            parts[layer] = rest
        elif not layer:
            parts |= {ALPHA if image.names[c].lower() in ("a", "alpha") else image.names[c]: [c] for c in rest}
    return parts


def _not_finite(path: Path, image: Image, other: Sequence[str] | dict[str, list[int]]) -> str:
    """Where a picture is NaN or infinite in the channels that are compared; empty if nowhere."""
    channels = sorted(_colour(image) + [c for part, own in _parts(image).items() if part in other for c in own])
    broken = ~np.isfinite(image.pixels[..., channels])
    where = broken.any(axis=2)
    if not where.any():
        return ""
    y, x = np.argwhere(where)[0]
    channel = channels[int(np.argmax(broken[y, x]))]
    return (
        f"{path}: {int(where.sum())} pixels are NaN or infinite, the first at x={x}, y={y} "
        f"({image.names[channel]} is {image.pixels[y, x, channel]:g})."
    )
