"""The error of a point's pictures, layer by layer, against two independent path-traced ones and without their noise."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.files import write_atomic
from relightcli.adapters.images import read_image
from relightcli.core.measure.noise_free import difference_noise, power, squared_error, squared_error_noise
from relightcli.errors import InputError, NumericalError, StoreError

BEAUTY = ""
VARIANCE = "variance"
Layers = dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class PictureError:
    """One picture against its references.

    squared   relative squared error of the picture; may be below 0 where it is far below the references' noise
    noise     its standard error, from the references' variance
    flip      mean FLIP against the mean of the references, whose noise counts
    own       layer -> its squared error relative to the layer's own power; layers that are black are left out
    share     layer -> its squared error relative to the picture's power
    """

    squared: float
    noise: float
    flip: float
    own: dict[str, float]
    share: dict[str, float]


@dataclass(frozen=True)
class Truth:
    """Two references of one view."""

    name: str
    a: Layers
    b: Layers

    @property
    def power(self) -> float:
        return power(self.a[BEAUTY], self.b[BEAUTY])


@dataclass(frozen=True)
class PointError:
    """All pictures of a point. Errors are relative RMS: roots of means of squares over the pictures.

    noise     by how much the references' noise may move `error`, one standard error
    worst     the largest error of a picture, and the picture's name
    """

    error: float
    noise: float
    flip: float
    worst: float
    worst_view: str
    own: dict[str, float]
    share: dict[str, float]


def read_layers(path: Path) -> Layers:
    """RGB of every layer by name, "" the picture itself.

    Raises StoreError for a run's picture that is damaged, NumericalError for what is not finite.
    """
    try:
        image = read_image(path)
    except InputError as error:
        raise StoreError(f"{error} Delete {path.parent} and give the same command again.") from None
    at = {name: image.pixels[..., k] for k, name in enumerate(image.names)}
    layers = {}
    for name in image.layers():
        prefix = f"{name}." if name else ""
        layers[name] = np.stack([at[f"{prefix}{c}"] for c in "RGB"], axis=-1)
        if not np.isfinite(layers[name]).all():
            raise NumericalError(f"{path}: the layer {name or 'RGB'} has values that are not finite")
    return layers


def read_truth(name: str, a: Path, b: Path) -> Truth:
    """Raises InputError where there is nothing to be relative to."""
    truth = Truth(name, read_layers(a), read_layers(b))
    if not truth.power > 0:
        raise InputError(f"{name}: the path-traced picture is black; expected some light to measure errors by")
    return truth


def measure(path: Path, truth: Truth, kept: Path) -> PictureError:
    """The error of a picture; read from `kept` where it has been measured before, else kept there."""
    try:
        return PictureError(**json.loads(kept.read_text()))
    except (FileNotFoundError, ValueError, TypeError):
        found = compare(read_layers(path), truth)
    write_atomic(kept, json.dumps(asdict(found)).encode())
    return found


def compare(ours: Layers, truth: Truth) -> PictureError:
    """A layer that only the references have counts as black in ours."""
    from relightcli.adapters.flip import flip_hdr

    a, b = truth.a, truth.b
    whole = truth.power
    own, share = {}, {}
    for name in (n for n in a if n not in (BEAUTY, VARIANCE)):
        mine = ours.get(name, np.zeros_like(a[name]))
        error, light = squared_error(mine, a[name], b[name]), power(a[name], b[name])
        share[name] = error / whole
        if light > 0:
            own[name] = error / light
    noise = squared_error_noise(ours[BEAUTY], a[BEAUTY], b[BEAUTY], a[VARIANCE], b[VARIANCE])
    flip = float(flip_hdr(ours[BEAUTY], 0.5 * (a[BEAUTY] + b[BEAUTY])).mean())
    return PictureError(squared_error(ours[BEAUTY], a[BEAUTY], b[BEAUTY]) / whole, noise / whole, flip, own, share)


def together(names: Sequence[str], pictures: Sequence[PictureError]) -> PointError:
    """The errors of a point's pictures as one; names: of the views."""
    count = len(pictures)
    squared = sum(p.squared for p in pictures) / count
    noise = math.sqrt(sum(p.noise**2 for p in pictures)) / count
    error = _root(squared)
    worst = max(range(count), key=lambda k: pictures[k].squared)
    return PointError(
        error,
        math.sqrt(max(0.0, squared) + noise) - error,
        sum(p.flip for p in pictures) / count,
        _root(pictures[worst].squared),
        names[worst],
        _layers([p.own for p in pictures]),
        _layers([p.share for p in pictures]),
    )


def apart_noise(ours: Sequence[tuple[Path, Path]], truths: Sequence[Truth]) -> float:
    """Standard error of the difference of two points' squared errors; ours: the pictures of both, a pair a view."""
    found = []
    for (p, q), truth in zip(ours, truths, strict=True):
        x, y = read_layers(p)[BEAUTY], read_layers(q)[BEAUTY]
        found.append(difference_noise(x, y, truth.a[VARIANCE], truth.b[VARIANCE]) / truth.power)
    return math.sqrt(sum(v * v for v in found)) / len(found)


def traced_error(variance: Sequence[NDArray[np.float32]], truths: Sequence[Truth]) -> float:
    """Relative RMS noise of path-traced pictures, one a view, from their own variance."""
    found = [float(np.mean(v, dtype=np.float64)) / t.power for v, t in zip(variance, truths, strict=True)]
    return math.sqrt(sum(found) / len(found))


def _layers(pictures: Sequence[dict[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for picture in pictures for name in picture)
    squares = {name: [p[name] for p in pictures if name in p] for name in names}
    return {name: _root(sum(values) / len(values)) for name, values in squares.items()}


def _root(squared: float) -> float:
    return math.sqrt(max(0.0, squared))
