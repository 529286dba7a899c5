"""The paper's two figures of fitting errors, as curves and bars: cosine weights (Fig. 3), lobes (Fig. 5).

The paper prints curves without numbers. It finds that a fit of plain visibility errs least, that multiplying the cosine
on afterwards errs less than fitting visibility times the cosine, and that two lobes err less than one. What the data
here say of each is a row. Errors are relative to what is fitted: the cosine leaves less to err in, and so the first
two of the paper's curves need not lie as they do there.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Report, Row, Table
from relightcli.adapters.plots import bars, curves
from relightcli.core.pose.pose_model import Settings, cosine_weighted, fit_model, predict

LOBES = (
    ("1 lobe", Settings(lobes=1)),
    ("2 lobes", Settings()),
    ("2 lobes, polar angles", Settings(axes="angles")),
    ("sh", Settings(kind="sh")),
)
Training = tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.int32]]


def per_frame(values: NDArray[np.float32], truth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Relative RMS error (F,) of all vertices in a frame."""
    error = ((values - truth).astype(np.float64) ** 2).sum(axis=(1, 2))
    return np.sqrt(error / np.maximum((truth.astype(np.float64) ** 2).sum(axis=(1, 2)), 1e-300))


def figures(report: Report, folder: Path, rigs: dict[str, Training], threads: int) -> None:
    """Fits all variants to each rig's training data (features, visibility, clip); writes pose-fig3 and pose-fig5."""
    means: dict[str, list[float]] = {name: [] for name, _ in LOBES}
    spreads: dict[str, list[float]] = {name: [] for name, _ in LOBES}
    rows: list[tuple[str | float, ...]] = []
    weights: list[tuple[str | float, ...]] = []
    for k, (rig, (features, seen, clip)) in enumerate(rigs.items()):
        found = {}
        for name, settings in LOBES:
            model, _ = fit_model(features, seen, clip, settings, threads)
            found[name] = predict(model, features, settings.axes)
            errors = per_frame(found[name], seen)
            means[name].append(float(errors.mean()))
            spreads[name].append(float(errors.std()))
            rows.append((rig, name, means[name][-1], spreads[name][-1]))
        weighted, _ = fit_model(features, seen, clip, Settings(weight="cosine"), threads)
        lines = {
            "visibility": per_frame(found["2 lobes"], seen),
            "visibility, then the cosine": per_frame(cosine_weighted(found["2 lobes"]), cosine_weighted(seen)),
            "visibility times the cosine": per_frame(predict(weighted, features), cosine_weighted(seen)),
        }
        weights += [(rig, name, float(line.mean()), float(line.std())) for name, line in lines.items()]
        if k == 0:
            drawn = curves(f"fits by cosine weight: {rig}", "frame", "relative error", lines)
            _write(folder, "pose-fig3", drawn)
        plain, after, fitted = (float(line.mean()) for line in lines.values())
        one, two = means["1 lobe"][-1], means["2 lobes"][-1]
        for work, ratio in (
            ("times the cosine, fitted so over fitted plain", fitted / after),
            ("then the cosine, over plain visibility", after / plain),
            ("one lobe over two", one / two),
        ):
            report.rows.append(Row(f"{rig}: error {work}", ratio, "x", target="> 1 (the paper)", met=ratio > 1.0))
    _write(folder, "pose-fig5", bars("fits of visibility", "relative error", list(rigs), means, spreads))
    columns = ("rig", "fit", "error", "sd")
    report.tables.append(Table("cosine weights, at the training frames (the paper's Fig. 3)", columns, tuple(weights)))
    report.tables.append(Table("lobes and axes, at the training frames (the paper's Fig. 5)", columns, tuple(rows)))


def _write(folder: Path, name: str, files: dict[str, bytes]) -> None:
    for suffix, data in files.items():
        (folder / f"{name}.{suffix}").write_bytes(data)
