"""One family of materials for direct light: lobes, and light factors shared by all settings. [Sun 2007, sec. 3.2, 4.1]

    f(w_o, w_i) ~ f_s + sum over k of W(w_o, k) U_i(w_i, k),   W = U_o (D x_h u_h)               [Sun 2007, Eq. 2-3]

f_s are the lobes of `specular_lobes`; U_h, U_o, U_i, D a Tucker decomposition of f_r = f - f_s over a set of settings.
With squared error over the whole set, the few settings with high and narrow lobes would decide: so every entry of the
set counts in units of its own norm |f_h|, the root of the sum of f^2 dA dA, and U_h is scaled back.

Between the entries, lobes and u_h are interpolated linearly (`navigation`). The default set of Cook-Torrance is a grid
of roughness and of f0 in {0, 1}: Schlick's term F = F_0 + f0 (1 - F_0), F_0 = (1 - v.h)^5, is linear in f0, so that two
values of f0 are all values, and only roughness is interpolated, over its logarithm. Below the least roughness of the
grid but one, all lobes are narrower than the cells and hardly differ. The default set of Blinn-Phong has exponents
from 0 to 1e6; interpolation is over the exponent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from relightcli.core.brdf.dataset import BrdfSet, blinn_phong_set, cook_torrance_set
from relightcli.core.brdf.disc import RESOLUTION, DiscGrid, disc_grid
from relightcli.core.brdf.measured import fits
from relightcli.core.brdf.navigation import Mix, exponent_mix, fresnel_roughness_mix
from relightcli.core.brdf.specular_lobes import LOBES, fit_lobes, lobes_on_grid
from relightcli.core.compress.tucker import hooi, mode_product
from relightcli.errors import InputError

FAMILIES = ("cook-torrance", "blinn-phong")
# n_h, n_o, n_i. [Sun 2007, sec. 4.3]
RANKS = {"cook-torrance": (4, 8, 8), "blinn-phong": (3, 8, 8)}
ROUGHNESSES = (1e-4, *np.geomspace(0.01, 1.0, 22).tolist(), 2.0, 10.0)
EXPONENTS = (0.0, *np.geomspace(1.0, 2048.0, 20).tolist(), 6e3, 2e4, 1e5, 1e6)
# Samples of lobe energies over cos(theta_o).
POLAR = 64


@dataclass(frozen=True, eq=False)
class DirectModel:
    """parameters (H, d) float64: exponent (d = 1), or f0 and roughness (d = 2), of the entries; reflectance (H, n_h),
    view (n, n_o), light (n, n_i), core (n_h, n_o, n_i) float64: U_h, U_o, U_i, D over the n cells of
    `disc_grid(resolution)`; degrees (L,), radius (R,), energy (H, R, L) float64 as in `SpecularLobes`; importance
    (n_i,) float64 as in `LightFactors`; error (H,) float64: |f - f^| / |f| of every entry, lobes on both sides.
    """

    family: str
    resolution: int
    parameters: NDArray[np.float64]
    reflectance: NDArray[np.float64]
    view: NDArray[np.float64]
    light: NDArray[np.float64]
    core: NDArray[np.float64]
    degrees: NDArray[np.float64]
    radius: NDArray[np.float64]
    energy: NDArray[np.float64]
    importance: NDArray[np.float64]
    error: NDArray[np.float64]

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """All arrays by name; with `family` and `resolution` they make the model again (`from_arrays`)."""
        return {name: getattr(self, name) for name in ARRAYS}


# Dimension names of the arrays.
ARRAYS: dict[str, tuple[str, ...]] = {
    "parameters": ("entry", "parameter"),
    "reflectance": ("entry", "reflectance_rank"),
    "view": ("cell", "view_rank"),
    "light": ("cell", "light_rank"),
    "core": ("reflectance_rank", "view_rank", "light_rank"),
    "degrees": ("lobe",),
    "radius": ("radius",),
    "energy": ("entry", "radius", "lobe"),
    "importance": ("light_rank",),
    "error": ("entry",),
}


class LightFactors(NamedTuple):
    """table (D, D, K+1) float32, sr^-1: light factors over the D x D grid of the disc [column of x, row of y], cells
    beyond the rim filled with the nearest one; the last is 1/pi. importance (K+1,) float32: g, the root mean square of
    the view factors that belong to them, over settings whose BRDF has the norm 1, as the diffuse 1/pi has."""

    table: NDArray[np.float32]
    importance: NDArray[np.float32]


class MaterialSetting(NamedTuple):
    """One material at run time. view_table (D, D, K) float32: W over the grid [column of x, row of y], cells beyond the
    rim filled with the nearest; energy (POLAR, L) float32: a of the lobes at cos(theta_o) = k / (POLAR - 1); outside:
    the values are beyond the set, and the nearest ones were taken."""

    view_table: NDArray[np.float32]
    energy: NDArray[np.float32]
    outside: bool


def from_arrays(family: str, resolution: int, arrays: Mapping[str, NDArray[Any]]) -> DirectModel:
    """The model whose `arrays` these are."""
    return DirectModel(family, resolution, *(np.asarray(arrays[name], np.float64) for name in ARRAYS))


def default_points(family: str) -> NDArray[np.float64]:
    """Entries of the default set: (H, 1) exponents, or (H, 2) of f0 and roughness."""
    if family == "blinn-phong":
        return np.array(EXPONENTS)[:, None]
    return np.array([(f0, m) for m in ROUGHNESSES for f0 in (0.0, 1.0)])


def measured_points() -> NDArray[np.float64]:
    """f0 and roughness (86, 2) of the measured materials."""
    return np.array([(fit.f0, fit.roughness) for fit in fits()])


def build_direct_model(
    family: str,
    points: NDArray[np.float64] | None = None,
    ranks: tuple[int, int, int] | None = None,
    degrees: Sequence[float] = LOBES,
    resolution: int = RESOLUTION,
    weighted: bool = True,
) -> DirectModel:
    """Samples, splits and factorises a set: 86 MB of memory for every 16 entries at 32 x 32 cells.

    points: entries as of `default_points`, which is the default; ranks: n_h, n_o, n_i, cut down to what the set has,
    and n_o, n_i moved up by one where a pair would be cut; degrees: of the lobes; weighted: entries in units of their
    norm, else all errors count alike. Raises InputError for an unknown family or values out of range.
    """
    if family not in FAMILIES:
        raise InputError(f"BRDF family is {family!r}; expected one of {', '.join(FAMILIES)}.")
    found = default_points(family) if points is None else np.asarray(points, np.float64)
    if family == "blinn-phong":
        brdfs = blinn_phong_set(found.reshape(-1), resolution)
    else:
        brdfs = cook_torrance_set([(f0, m) for f0, m in found], resolution)
    return _factorise(family, brdfs, ranks or RANKS[family], degrees, weighted)


def _factorise(
    family: str, brdfs: BrdfSet, ranks: tuple[int, int, int], degrees: Sequence[float], weighted: bool
) -> DirectModel:
    grid, lobes = brdfs.grid, fit_lobes(brdfs, degrees)
    norm = np.sqrt(np.einsum("hoi,hoi->h", brdfs.values, brdfs.values)) * grid.area
    norm[norm == 0.0] = 1.0
    unit = norm if weighted else np.full(len(norm), math.sqrt(float((norm**2).mean())))
    remainder = brdfs.values - lobes_on_grid(grid, lobes)
    remainder /= unit[:, None, None]
    tucker = hooi(remainder.astype(np.float32), ranks, paired=(1, 2))
    u_h, u_o, u_i = tucker.factors
    assert u_h is not None
    assert u_o is not None
    assert u_i is not None
    # |X - X^|^2 entry by entry, with X projected on U_o and U_i: what is left out, and what differs within.
    within = mode_product(mode_product(remainder, u_i.T, 2), u_o.T, 1)
    near = mode_product(tucker.core, u_h, 0)
    left = np.einsum("hoi,hoi->h", remainder, remainder) - (within**2).sum((1, 2)) + ((within - near) ** 2).sum((1, 2))
    error = np.sqrt(np.maximum(left, 0.0)) * grid.area * unit / norm
    # The mean over entries and views (dA / pi) of W^2, U_h and U_o being orthonormal.
    importance = np.sqrt((tucker.core**2).sum((0, 1)) * grid.area / (math.pi * len(norm)))
    return DirectModel(
        family,
        grid.resolution,
        brdfs.parameters,
        u_h * unit[:, None],
        u_o,
        u_i,
        tucker.core,
        np.array(degrees, np.float64),
        lobes.radius,
        lobes.energy,
        importance,
        error,
    )


def light_factors(model: DirectModel) -> LightFactors:
    """U_i and 1/pi over the disc, for `transport.direct_tensor`."""
    grid = disc_grid(model.resolution)
    diffuse = np.full((len(grid), 1), 1.0 / math.pi)
    table = _dense(grid, np.concatenate([model.light, diffuse], axis=1))
    return LightFactors(table, np.append(model.importance, 1.0).astype(np.float32))


def mix(model: DirectModel, *values: float) -> Mix:
    """Weights of the entries for (f0, roughness) or (shininess)."""
    if len(values) != model.parameters.shape[1]:
        raise InputError(
            f"{model.family} takes {model.parameters.shape[1]} values, (f0, roughness) or (shininess); found {values}."
        )
    if model.family == "blinn-phong":
        return exponent_mix(model.parameters[:, 0], values[0])
    f0, roughness = values
    if not _is_grid(model.parameters):
        return fresnel_roughness_mix(model.parameters, f0, roughness)
    # Rows alternate between f0 = 0 and f0 = 1.
    along = exponent_mix(np.log(model.parameters[::2, 1]), math.log(roughness))
    return Mix(np.outer(along.weights, (1.0 - f0, f0)).reshape(-1), along.outside)


def _is_grid(points: NDArray[np.float64]) -> bool:
    low, high = points[::2], points[1::2]
    if len(low) != len(high) or low[:, 0].any() or (high[:, 0] != 1.0).any():
        return False
    return bool((low[:, 1] == high[:, 1]).all())


def setting(model: DirectModel, *values: float) -> MaterialSetting:
    """Run-time table of one material: setting(model, f0, roughness) or setting(model, shininess). [Sun 2007, Eq. 3]"""
    found = mix(model, *values)
    grid = disc_grid(model.resolution)
    view = model.view @ np.tensordot(found.weights @ model.reflectance, model.core, 1)
    energy = np.tensordot(found.weights, model.energy, 1)
    sine = np.sqrt(1.0 - np.linspace(0.0, 1.0, POLAR) ** 2)
    polar = (
        np.stack([np.interp(sine, model.radius, a) for a in energy.T], 1) if energy.shape[1] else np.zeros((POLAR, 0))
    )
    return MaterialSetting(_dense(grid, view), polar.astype(np.float32), found.outside)


def _dense(grid: DiscGrid, cells: NDArray[np.float64]) -> NDArray[np.float32]:
    return np.ascontiguousarray(cells[grid.lookup], np.float32)
