"""Error of the BRDF tensor over its ranks, with and without specular lobes. [Sun 2007, Fig. 5]

    error = sum of (f - f^)^2 dA dA / sum of f^2 dA dA

over all entries of a set, view and light cells: f is the specular part for specular colour 1, dA = cos dw.

The whole grid of ranks comes from one HOSVD to CORE, and HOOI on that core: what it reports is the exact error of the
factors it finds, but they lie in the span of the HOSVD's. A row compares with HOOI on the tensor itself.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Report, Row, Table
from benchmarks.scenes import Setting

N_H = (1, 2, 3, 4, 5, 6)
N_I = (4, 8, 12, 16, 20, 24, 28, 32)
QUICK_N_H, QUICK_N_I = (1, 4, 6), (4, 8, 32)
DEFAULT = (4, 8)
COARSEST, FINEST = (1, 4), (6, 32)
CORE = (16, 64, 64)
UNIT = "of |f|^2"
# The paper's numbers, in a measure that it does not name.
PAPER_FINEST = 0.952465
PAPER_BASIS = {"Cook-Torrance": 6.23e-4, "Blinn-Phong": 1.61e-7}
CONVERGED = 1.25
BANDS = ((0.0, 0.02), (0.02, 0.1), (0.1, 0.3), (0.3, 2.0))  # roughness


@dataclass
class Curves:
    """error[n_h, n_i] and ranks used [n_h, n_i] of one set with one choice of lobes; by_entry: error of every entry at
    some ranks, relative to its own |f|^2."""

    error: dict[tuple[int, int], float] = field(default_factory=dict)
    used: dict[tuple[int, int], int] = field(default_factory=dict)
    by_entry: dict[tuple[int, int], NDArray[np.float64]] = field(default_factory=dict)


def curves(values: NDArray[np.float64], remainder: NDArray[np.float64], ranks: Sequence[tuple[int, int]]) -> Curves:
    """Errors at `ranks` (n_h, n_i), by entry at DEFAULT and FINEST; remainder: values without lobes."""
    from relightcli.core.compress.tucker import hooi, hosvd, mode_product

    norm2 = float((values**2).sum())
    coarse = hosvd(remainder, CORE, paired=(1, 2))
    factors: list[Any] = list(coarse.factors)
    out = Curves()
    for n_h, n_i in ranks:
        found = hooi(coarse.core, (n_h, n_i, n_i), paired=(1, 2))
        out.error[n_h, n_i] = (coarse.error2 + found.error2) / norm2
        out.used[n_h, n_i] = found.core.shape[2]
        if (n_h, n_i) in (DEFAULT, FINEST):
            u_h, u_o, u_i = (big @ small for big, small in zip(factors, found.factors, strict=True))
            projected = mode_product(mode_product(remainder, u_i.T, 2), u_o.T, 1)
            near = mode_product(found.core, u_h, 0)
            left = (remainder**2).sum((1, 2)) - (projected**2).sum((1, 2)) + ((projected - near) ** 2).sum((1, 2))
            out.by_entry[n_h, n_i] = left / (values**2).sum((1, 2))
    return out


def rows_of(name: str, bare: Curves, lobed: Curves, mirror: Curves) -> list[Row]:
    """The paper's claims, with numbers."""
    coarsest = f"{name}: n_h = {COARSEST[0]}, n = {COARSEST[1]}, with lobes"
    against = f"n_h = {FINEST[0]}, n = {FINEST[1]}, without: {bare.error[FINEST]:.3g}"
    ratio = bare.error[FINEST] / lobed.error[COARSEST]
    rows = [Row(coarsest, lobed.error[COARSEST], UNIT, against, ratio, "below it", ratio > 1)]
    ratio = bare.error[FINEST] / lobed.error[DEFAULT]
    default = f"{name}: n_h = {DEFAULT[0]}, n = {DEFAULT[1]}"
    rows.append(Row(f"{default}, with lobes", lobed.error[DEFAULT], UNIT, against, ratio, "below it", ratio > 1))
    rows.append(Row(f"{default}, with the mirror alone", mirror.error[DEFAULT], UNIT))
    rows.append(Row(f"{default}, without", bare.error[DEFAULT], UNIT))
    for n in (DEFAULT[1], FINEST[1]):
        ratio = lobed.error[4, n] / lobed.error[6, n]
        target = f"<= {CONVERGED:g}"
        work = f"{name}: n_h = 4 over n_h = 6, n = {n}, with lobes"
        rows.append(Row(work, ratio, "of its error", "", None, target, ratio <= CONVERGED))
    return rows


def bands(parameters: NDArray[np.float64], bare: Curves, lobed: Curves) -> Table:
    """Cook-Torrance entries by roughness: coarse with lobes, coarse and finest without."""
    default, finest = (f"n_h = {h}, n = {n}" for h, n in (DEFAULT, FINEST))
    title = "Cook-Torrance by roughness, median over entries of the error relative to the entry's own |f|^2"
    columns = (
        "roughness",
        "entries",
        f"{default}, with lobes",
        f"{default}, without",
        f"{finest}, without",
        "entries where the first is below the last",
    )
    rows = []
    for low, high in BANDS:
        here = (parameters[:, 1] >= low) & (parameters[:, 1] < high)
        if here.any():
            coarse, fine = lobed.by_entry[DEFAULT][here], bare.by_entry[FINEST][here]
            medians = [float(np.median(x)) for x in (coarse, bare.by_entry[DEFAULT][here], fine)]
            rows.append((f"{low:g} to {high:g}", int(here.sum()), *medians, int((coarse < fine).sum())))
    return Table(title, columns, tuple(rows))


def plot(path: Path, found: dict[str, dict[str, Curves]], views: Sequence[int], entries: Sequence[int]) -> None:
    """Error over n, a line for every n_h: solid with lobes, dashed without."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(found), figsize=(5.5 * len(found), 4.5), sharey=True, layout="constrained")
    for axis, (name, by_lobes) in zip(axes, found.items(), strict=True):
        for lobes, style in (("with lobes", "-"), ("without", "--")):
            for k, n_h in enumerate(entries):
                line = [by_lobes[lobes].error[n_h, n] for n in views]
                axis.semilogy(views, line, style, color=f"C{k}", marker=".", label=f"n_h = {n_h}, {lobes}")
        axis.set(title=name, xlabel="n of views and of lights", xticks=views)
    axes[0].set_ylabel("relative squared error, measure cos cos dw dw")
    axes[-1].legend(ncols=2, fontsize="x-small")
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


def measure(setting: Setting) -> Report:
    from relightcli.core.brdf.basis import brdf_basis
    from relightcli.core.brdf.dataset import BLINN_PHONG_EXPONENTS, BrdfSet, blinn_phong_set, cook_torrance_set
    from relightcli.core.brdf.measured import fits
    from relightcli.core.brdf.specular_lobes import LOBES, MIRROR, fit_lobes, lobes_on_grid
    from relightcli.core.compress.tucker import hooi

    resolution = 12 if setting.quick else 32
    entries, views = (QUICK_N_H, QUICK_N_I) if setting.quick else (N_H, N_I)
    ranks = [(n_h, n) for n in views for n_h in entries]
    points = [(fit.f0, fit.roughness) for fit in fits()]
    exponents = BLINN_PHONG_EXPONENTS[::20] if setting.quick else BLINN_PHONG_EXPONENTS
    points = points[::5] if setting.quick else points

    found: dict[str, dict[str, Curves]] = {}
    grid: list[tuple[str | int | float, ...]] = []
    seconds: list[tuple[str | int | float, ...]] = []
    report = Report(
        f"Cook-Torrance: {len(points)} fits to measured materials [Ngan 2005]; "
        f"Blinn-Phong: {len(exponents)} exponents 1 to {exponents[-1]}; disc of {resolution} x {resolution}"
    )
    for name in ("Cook-Torrance", "Blinn-Phong"):
        clock = time.perf_counter()
        brdfs: BrdfSet = (
            cook_torrance_set(points, resolution) if name == "Cook-Torrance" else blinn_phong_set(exponents, resolution)
        )
        times = [time.perf_counter() - clock]
        found[name] = {}
        for lobes, degrees in (("with lobes", LOBES), ("mirror", MIRROR), ("without", ())):
            clock = time.perf_counter()
            remainder = brdfs.values - lobes_on_grid(brdfs.grid, fit_lobes(brdfs, degrees))
            if degrees == LOBES:
                times.append(time.perf_counter() - clock)
                clock = time.perf_counter()
                whole = hooi(remainder, (DEFAULT[0], DEFAULT[1], DEFAULT[1]), paired=(1, 2))
                times.append(time.perf_counter() - clock)
                direct = whole.error2 / float((brdfs.values**2).sum())
            found[name][lobes] = curves(brdfs.values, remainder, ranks)
        del remainder
        of = found[name]
        report.rows += rows_of(name, of["without"], of["with lobes"], of["mirror"])
        ours = of["with lobes"].error[DEFAULT]
        work = f"{name}: the same as n_h = 4, n = 8, with lobes, by HOOI on the whole tensor"
        report.rows.append(Row(work, direct, UNIT, f"on the core: {ours:.6g}", ours / direct))
        basis = brdf_basis(brdfs)
        error = basis.error2 / basis.norm2
        paper = f"the paper's: {PAPER_BASIS[name]:.3g}, measure not named"
        report.rows.append(Row(f"{name}: 4 functions of the transport basis", error, UNIT, paper))
        if name == "Cook-Torrance":
            paper = f"the paper's: {PAPER_FINEST:.3g}, measure not named"
            report.rows.append(Row(f"{name}: n_h = 6, n = 32, without lobes", of["without"].error[FINEST], UNIT, paper))
            report.tables.append(bands(brdfs.parameters, of["without"], of["with lobes"]))
        for lobes in ("with lobes", "without"):
            for n in views:
                used = max(of[lobes].used[n_h, n] for n_h in entries)
                label = f"{n} ({used} with the pair closed)" if used > n else str(n)
                grid.append((name, lobes, label, *(of[lobes].error[n_h, n] for n_h in entries)))
        seconds.append((name, *times))
    report.tables.append(
        Table("relative squared error", ("set", "lobes", "n", *(f"n_h = {n}" for n in entries)), tuple(grid))
    )
    columns = ("set", "sampling the set", "fitting 4 lobes", "HOOI, n_h = 4, n = 8")
    report.tables.append(Table("seconds", columns, tuple(seconds)))
    try:
        plot(setting.work.parent / "brdf.png", found, views, entries)
    except ImportError:
        report.skipped.append("the plot: matplotlib is not installed")
    return report
