"""Compare two pictures, two sequences of pictures, or two stores. A is the test, B the reference."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relightcli.errors import InputError
from relightcli.stages.diff_result import METRICS, DiffResult, DiffSettings

__all__ = ["METRICS", "DiffResult", "DiffSettings", "diff"]

_NAMED = 5  # names shown before "..."


def diff(a: str | Path, b: str | Path, settings: DiffSettings) -> DiffResult:
    """Measure A against the reference B, and write the heat map and the report that `settings` ask for.

    a, b: two picture files; two folders of pictures, matched by file name; two names like `out.####.exr`, matched by
    frame number; or two stores.
    Raises InputError for pairs that do not match in kind, names, sizes or channels, and for pictures that cannot be
    read; StoreError for stores that cannot; OSError where the heat map or the report cannot be written.
    """
    # Not `Path(a)` of a path, which spells a URL otherwise.
    a, b = (path if isinstance(path, Path) else Path(path) for path in (a, b))
    kind = _kind(a)
    if _kind(b) != kind:
        raise InputError(f"{a} is a {kind} and {b} a {_kind(b)}; expected two of a kind.")
    if kind == "store":
        return _diff_stores(a, b, settings)
    return _diff_pictures(kind, a, b, _pairs(a, b) if kind == "sequence" else {a.name: (a, b)}, settings)


def plan(a: str | Path, b: str | Path) -> dict[str, Any]:
    """What `diff` would compare: the kind, and of every pair its name and the bytes to read. Raises as `diff`."""
    a, b = (path if isinstance(path, Path) else Path(path) for path in (a, b))
    kind = _kind(a)
    if _kind(b) != kind:
        raise InputError(f"{a} is a {kind} and {b} a {_kind(b)}; expected two of a kind.")
    if kind == "store":
        from relight_formats import open_store

        items = {a.name: sum(size.stored for path in (a, b) for size in open_store(path).sizes().values())}
    else:
        pairs = _pairs(a, b) if kind == "sequence" else {a.name: (a, b)}
        items = {name: sum(path.stat().st_size for path in pair) for name, pair in pairs.items()}
    return {"command": "diff", "dry_run": True, "kind": kind, "a": str(a), "b": str(b), "items": items, "notes": []}


def _diff_stores(a: Path, b: Path, settings: DiffSettings) -> DiffResult:
    if settings.heatmap is not None:
        raise InputError("--heatmap is for pictures; stores have none.")
    from relightcli.stages.diff_stores import compare_stores

    comparisons, notes = compare_stores(a, b, settings)
    result = DiffResult("store", str(a), str(b), settings, tuple(comparisons), tuple(notes))
    _write_report(result, {}, lambda name: np.zeros((0, 0)))
    return result


def _diff_pictures(
    kind: str, a: Path, b: Path, pairs: dict[str, tuple[Path, Path]], settings: DiffSettings
) -> DiffResult:
    from relightcli.stages.diff_pictures import compare_pictures

    comparisons = []
    last: dict[str, NDArray[np.float64]] = {}  # only one error map is kept; those of a long sequence would fill memory

    def error_map(name: str) -> NDArray[np.float64]:
        if name not in last:
            last.clear()
            last[name] = compare_pictures(name, *pairs[name], settings).error
        return last[name]

    for name, (one, other) in pairs.items():
        difference = compare_pictures(name, one, other, settings)
        comparisons.append(difference.comparison)
        last.clear()
        last[name] = difference.error
    result = DiffResult(kind, str(a), str(b), settings, tuple(comparisons))
    if settings.heatmap is not None:
        from relightcli.adapters.image_output import write_display
        from relightcli.core.measure.heatmap import heatmap

        error = error_map(result.worst().name)
        write_display(settings.heatmap, heatmap(error, heatmap_range(error, settings.metrics[0])))
    _write_report(result, pairs, error_map)
    return result


def _write_report(
    result: DiffResult, pairs: dict[str, tuple[Path, Path]], error_map: Callable[[str], NDArray[np.float64]]
) -> None:
    if result.settings.report is None:
        return
    from relightcli.adapters.files import write_atomic
    from relightcli.stages.diff_report import report

    write_atomic(result.settings.report, report(result, pairs, error_map).encode())


def heatmap_range(error: NDArray[np.float64], metric: str) -> float:
    """The error that is drawn brightest: 1 for FLIP, else what 99.5 % of the finite pixels stay under."""
    finite = error[np.isfinite(error)]
    if metric == "flip" or finite.size == 0:
        return 1.0
    return float(np.quantile(finite, 0.995)) or float(finite.max()) or 1.0


def _kind(path: Path) -> str:
    if "://" in str(path):  # pictures are read from files only
        return "store"
    if "#" in path.name and not path.exists():
        return "sequence"
    if path.is_dir():
        return "store" if (path / "zarr.json").exists() or path.suffix in (".zarr", ".partial") else "sequence"
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; expected a picture, a folder of pictures, or a store.")
    return "image"


def _pairs(a: Path, b: Path) -> dict[str, tuple[Path, Path]]:
    """Matching pictures by name or frame, in order. Raises InputError where one has no counterpart."""
    frames_a, frames_b = _frames(a), _frames(b)
    for path, frames in ((a, frames_a), (b, frames_b)):
        if not frames:
            raise InputError(f"{path}: no pictures found; expected at least one.")
    alone = sorted(set(frames_a) ^ set(frames_b), key=_natural)
    if alone:
        names = ", ".join(alone[:_NAMED]) + (", ..." if len(alone) > _NAMED else "")
        raise InputError(f"{a} and {b} do not hold the same frames; {len(alone)} have no counterpart: {names}.")
    return {name: (frames_a[name], frames_b[name]) for name in sorted(frames_b, key=_natural)}


def _frames(path: Path) -> dict[str, Path]:
    """Pictures of a folder by file name, or of a `name.####.exr` pattern by frame number."""
    if path.is_dir():
        from relightcli.adapters.oiio import picture_suffixes

        known = picture_suffixes()
        return {f.name: f for f in path.iterdir() if f.suffix.lower() in known and not f.name.startswith(".")}
    before, hashes, after = re.fullmatch(r"([^#]*)(#+)([^#]*)", path.name).groups()  # type: ignore[union-attr]
    pattern = re.compile(re.escape(before) + rf"(\d{{{len(hashes)},}})" + re.escape(after))
    if not path.parent.is_dir():
        return {}
    found = ((pattern.fullmatch(file.name), file) for file in path.parent.iterdir())
    return {match[1].zfill(len(hashes)): file for match, file in found if match}


def _natural(name: str) -> tuple[tuple[float, str], ...]:
    """Numbers inside names sort by value: frame 9 before frame 10."""
    return tuple((float(part), "") if part.isdigit() else (math.inf, part) for part in re.split(r"(\d+)", name) if part)
