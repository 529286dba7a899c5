"""Two stores, array by array."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from relightcli.core.measure.errors import pixel_relative_rmse, pixel_rmse
from relightcli.errors import InputError
from relightcli.stages.diff_pictures import measure, percent_beyond
from relightcli.stages.diff_result import Comparison, DiffSettings, judge


def compare_stores(a: Path, b: Path, settings: DiffSettings) -> tuple[list[Comparison], list[str]]:
    """Measure every array of A against that of the reference B, and say which settings differ.

    NaN in the same places of both (a vertex without texture coordinates) is no difference; NaN or infinity anywhere
    else is a failure. Raises InputError if kinds, names or shapes differ; StoreError as opening and reading do.
    """
    from relight_formats import open_store

    if "flip" in settings.metrics:
        raise InputError("flip compares pictures; for stores choose rmse, relrmse or psnr.")
    one, other = open_store(a), open_store(b)
    if one.kind != other.kind:
        raise InputError(f"{a} is a store of kind {one.kind} and {b} of kind {other.kind}; expected the same kind.")
    unmatched = sorted(set(one.names()) ^ set(other.names()))
    if unmatched:
        raise InputError(f"{a} and {b} do not hold the same arrays; only one of them has {', '.join(unmatched[:8])}.")
    comparisons = [_compare(name, one.read(name), other.read(name), settings) for name in other.names()]
    keys = sorted(set(one.settings) | set(other.settings))
    differing = [key for key in keys if one.settings.get(key) != other.settings.get(key)]
    notes = [f"setting {key}: {one.settings.get(key)} against {other.settings.get(key)}." for key in differing]
    return comparisons, notes


def _compare(name: str, a: NDArray[np.generic], b: NDArray[np.generic], settings: DiffSettings) -> Comparison:
    if a.shape != b.shape:
        raise InputError(f"array {name} has the shape {a.shape} in A and {b.shape} in B; expected the same.")
    notes = [f"data types differ: {a.dtype} against {b.dtype}."] if a.dtype != b.dtype else []
    flat_a, flat_b = a.reshape(-1).astype(np.float64), b.reshape(-1).astype(np.float64)
    undefined = np.isnan(flat_a) & np.isnan(flat_b)
    if undefined.any():
        notes.append(f"{int(undefined.sum())} values are NaN in both.")
        flat_a, flat_b = np.where(undefined, 0, flat_a), np.where(undefined, 0, flat_b)
    broken = ~(np.isfinite(flat_a) & np.isfinite(flat_b))
    if broken.any():
        first = tuple(int(i) for i in np.unravel_index(int(np.argmax(broken)), a.shape))
        reason = (
            f"{int(broken.sum())} values are NaN or infinite, the first at {first} ({a[first]} against {b[first]})."
        )
        return Comparison(name, {}, {}, {}, (reason,), tuple(notes))

    largest = float(np.abs(flat_a - flat_b).max(initial=0))
    peak = float(flat_b.max(initial=0))
    values = {m: measure(m, flat_a, flat_b, peak) for m in settings.metrics}
    per_value = {
        m: (pixel_relative_rmse if m == "relrmse" else pixel_rmse)(flat_a[:, None], flat_b[:, None])
        for m in settings.metrics
    }
    percent = {m: percent_beyond(m, per_value[m], settings.threshold(m), peak) for m in settings.metrics}
    reasons = judge(values, percent, settings)
    return Comparison(name, values, percent, {"largest": {"absolute": largest}}, tuple(reasons), tuple(notes))
