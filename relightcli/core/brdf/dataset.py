"""Sets of isotropic BRDFs as tensors over the disc grid. [Sun 2007, sec. 3.2, 4.2]

    F(h, o, i) = f(h, w_o, w_i),   sr^-1

is the specular part of entry h for specular colour 1: without cosine, without diffuse term. Since dA = cos(theta) dw,
sums over o and i with the weight dA^2 are the integrals of f ... cos cos dw dw (`relightcli.core.brdf.disc`).

Where a lobe is wide, F is f at the cells' centres. Where it is narrower than the cells, F is the mean of f over both
cells in the measure dA dA, by 16 view directions times 512 of the lobe's own importance samples: so a lobe keeps its
energy however narrow it is (at N = 32 roughness 0.005 has a standard deviation of 1/9 of a cell at normal incidence,
and ever less towards grazing). The same mean tames 1/(cos cos) at grazing angles: dA cancels one of the cosines, the
lobe's own width the other, and the mean is finite where values are not; no centre is closer to the horizon than
cos = 0.077 (N = 32). A lobe counts as narrow at w_o when its standard deviation on the disc,

    2 cos(theta_o) sigma_h,   sigma_h = m / sqrt(2) (Beckmann), 1 / sqrt(s) (Blinn-Phong),

is below 1.5 cells, where the mean's peak is 7 % lower than the centre's. F is made to obey the symmetries that f has:
those of the square, from one octant of w_o, and F(h, o, i) = F(h, i, o), by averaging.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.disc import RESOLUTION, DiscGrid, disc_grid, spread, sub_directions
from relightcli.core.brdf.models import (
    BLINN_PHONG,
    ROUGHNESS,
    SHININESS,
    MaterialTable,
    lobes,
    lobes_and_density,
    pack_materials,
)
from relightcli.core.brdf.sampling import sample_direction
from relightcli.errors import InputError

# Below this many cells of standard deviation a lobe is averaged over its cells.
_RESOLVED = 1.5
# Importance samples of a lobe: rings of equal energy, and azimuths.
_RINGS, _AZIMUTHS = 16, 32

BLINN_PHONG_EXPONENTS = tuple(range(1, 201))


@dataclass(frozen=True, eq=False)
class BrdfSet:
    """values (H, n, n) float64 sr^-1, [entry, view cell, light cell]; parameters (H, d) float64, what the entries are
    named by: exponent (d = 1), or f0 and roughness (d = 2), or nothing (d = 0)."""

    grid: DiscGrid
    values: NDArray[np.float64]
    parameters: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.values)


def blinn_phong_set(exponents: Iterable[float] = BLINN_PHONG_EXPONENTS, resolution: int = RESOLUTION) -> BrdfSet:
    """Blinn-Phong lobes of the given exponents, 0 to 1e12; by default the paper's 1, 2, ..., 200. [Sun 2007, sec. 4.2]

    Raises InputError for an empty list or an exponent out of range.
    """
    found = np.array([float(s) for s in exponents])
    if not (len(found) and np.isfinite(found).all() and found.min() >= 0.0 and found.max() <= 1e12):
        raise InputError(f"exponents are {_some(found)}; expected one or more numbers from 0 to 1e12.")
    materials = [_white("blinn-phong", shininess=s) for s in found]
    return _model_set(materials, found[:, None], resolution)


def cook_torrance_set(points: Iterable[tuple[float, float]], resolution: int = RESOLUTION) -> BrdfSet:
    """Cook-Torrance lobes of the given (f0, roughness); f0 0 to 1, roughness (Beckmann m) above 0.

    Raises InputError for an empty list or a value out of range.
    """
    found = np.array([(float(f0), float(m)) for f0, m in points]).reshape(-1, 2)
    f0, m = found.T
    if not (len(found) and np.isfinite(found).all() and f0.min() >= 0.0 and f0.max() <= 1.0 and m.min() > 0.0):
        raise InputError(
            f"(f0, roughness) are {_some(found)}; expected one or more, f0 from 0 to 1, roughness above 0."
        )
    materials = [_white("cook-torrance", f0=a, roughness=b) for a, b in found]
    return _model_set(materials, found, resolution)


def table_set(values: NDArray[np.floating[Any]], resolution: int = RESOLUTION) -> BrdfSet:
    """A table of the user's: (H, n, n) sr^-1, at the centres of `disc_grid(resolution)`, or means over its cells.

    Raises InputError for another shape, or values that are negative or not finite.
    """
    grid = disc_grid(resolution)
    table = np.asarray(values, np.float64)
    if table.ndim != 3 or len(table) == 0 or table.shape[1:] != (len(grid), len(grid)):
        raise InputError(
            f"BRDF table has shape {table.shape}; expected (entries, {len(grid)}, {len(grid)}) for a disc resolution "
            f"of {resolution}."
        )
    if not (np.isfinite(table).all() and table.min() >= 0.0):
        raise InputError("BRDF table has values that are negative or not finite; expected reflectances in 1/sr.")
    return BrdfSet(grid, table, np.zeros((len(table), 0)))


def _white(model: str, **values: float) -> SimpleNamespace:
    colours = {"diffuse": (0.0, 0.0, 0.0), "specular": (1.0, 1.0, 1.0), "transmittance": (0.0, 0.0, 0.0)}
    return SimpleNamespace(model=model, **colours, **({"f0": 1.0, "roughness": 1.0, "shininess": 1.0} | values))


def _some(found: NDArray[np.float64]) -> str:
    return np.array2string(found, threshold=8, precision=4, separator=", ")


def _model_set(materials: list[SimpleNamespace], parameters: NDArray[np.float64], resolution: int) -> BrdfSet:
    grid = disc_grid(resolution)
    table: MaterialTable = pack_materials(materials)
    rows = np.zeros((len(materials), len(grid.octant), len(grid)))
    _fill(
        table.model, table.parameters, grid.direction, grid.octant, sub_directions(grid, grid.octant), grid.lookup, rows
    )
    values = spread(grid, rows)
    for entry in values:
        entry += entry.T.copy()
        entry *= 0.5
    return BrdfSet(grid, values, parameters)


@njit(cache=True, error_model="numpy")
def _fill(model: Any, parameters: Any, direction: Any, octant: Any, views: Any, lookup: Any, rows: Any) -> None:
    """rows[h, k, i] for the octant's view cells k."""
    normal = (0.0, 0.0, 1.0)
    cells = len(direction)
    for h in range(len(model)):
        row = parameters[h]
        sigma = 1.0 / math.sqrt(row[SHININESS]) if model[h] == BLINN_PHONG else row[ROUGHNESS] / math.sqrt(2.0)
        for k in range(len(octant)):
            o = octant[k]
            view = (direction[o, 0], direction[o, 1], direction[o, 2])
            if 2.0 * view[2] * sigma < _RESOLVED * 2.0 / len(lookup):
                _average(model[h], row, views[k], lookup, math.pi / cells, rows[h, k])
                continue
            for i in range(cells):
                light = (direction[i, 0], direction[i, 1], direction[i, 2])
                _, s, _ = lobes(model[h], row, normal, light, view)
                rows[h, k, i] = s / light[2]


@njit(cache=True, error_model="numpy")
def _average(model: int, row: Any, views: Any, lookup: Any, area: float, out: Any) -> None:
    """Mean of f over the view cell and every light cell: sum of (f cos / density) over samples, by cell, over dA."""
    normal = (0.0, 0.0, 1.0)
    black = (0.0, 0.0, 0.0)
    n = len(lookup)
    used = 0
    for a in range(len(views)):
        view = (views[a, 0], views[a, 1], views[a, 2])
        if not view[2] > 0.0:
            continue
        used += 1
        for b in range(_RINGS):
            for c in range(_AZIMUTHS):
                # Azimuths turn by the golden ratio from ring to ring, so that no two rings line up.
                turn = (c + 0.6180339887498949 * b) / _AZIMUTHS
                light, above = sample_direction(
                    model, row, black, normal, view, (b + 0.5) / _RINGS, turn - math.floor(turn)
                )
                if not above:
                    continue
                _, s, _, q = lobes_and_density(model, row, normal, light, view)
                if not q > 0.0:
                    continue
                x = min(max(int((light[0] + 1.0) * 0.5 * n), 0), n - 1)
                y = min(max(int((light[1] + 1.0) * 0.5 * n), 0), n - 1)
                out[lookup[x, y]] += s / q
    for i in range(len(out)):
        out[i] /= used * _RINGS * _AZIMUTHS * area
