"""One family of materials for direct light: lobes, and light factors shared by all settings. [Sun 2007, sec. 3.2, 4.1]

    f(w_o, w_i) ~ f_s + sum over k of W(w_o, k) U_i(w_i, k) + W(w_o, K) / pi,   W = U_o (D x_h u_h)    [Sun 2007, Eq. 2]

f_s are the lobes of `specular_lobes`; U_h, U_o, U_i, D a Tucker decomposition, over a set of settings, of f_r = f - f_s
less its mean over w_i. With squared error over the whole set, the few settings with high and narrow lobes would decide:
so every entry counts in units of its own norm |f_h|, the root of the sum of f^2 dA dA, and U_h is scaled back.

A deviation from the paper: the view factor W(w_o, K) of the diffuse light factor makes the directional albedo

    A(w_o) = integral of f cos(theta_i) dw_i

exact for every view. Least squares with few factors loses energy, and cells average A over views where it is steep. Put
right, at no cost at run time, the error under an overcast sky falls from 0.41 to 0.20 (roughness 0.2, f0 = 0.8).
Lobes and W are scaled by A over its mean over the view's cell, and W(w_o, K) is what is then missing.

Between the entries all of this is interpolated linearly (`navigation`). The default set of Cook-Torrance is a grid of
roughness and of f0 in {0, 1}: Schlick's term F = F_0 + f0 (1 - F_0), F_0 = (1 - v.h)^5, is linear in f0, so that two
values of f0 are all values, and only roughness is interpolated, over its logarithm. Below roughness 0.01 all lobes are
narrower than the cells and hardly differ. The default set of Blinn-Phong has exponents from 0 to 1e6; interpolation is
over the exponent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from relightcli.core.brdf.albedo import directional_albedo, lobe_share
from relightcli.core.brdf.dataset import BrdfSet, blinn_phong_set, cook_torrance_set
from relightcli.core.brdf.disc import RESOLUTION, DiscGrid, bilinear, disc_grid
from relightcli.core.brdf.measured import fits
from relightcli.core.brdf.navigation import Mix, exponent_mix, fresnel_roughness_mix
from relightcli.core.brdf.specular_lobes import LOBES, fit_lobes, lobes_on_grid
from relightcli.core.compress.tucker import hooi, hosvd, mode_product
from relightcli.errors import InputError

FAMILIES = ("cook-torrance", "blinn-phong")
# n_h, n_o, n_i. The paper has 4 (Cook-Torrance) or 3 (Blinn-Phong), 8, 8. [Sun 2007, sec. 4.3] Only n_i counts at run
# time, because a material's W is made when it is set; twice the other two take a tenth to two fifths off the error.
RANKS = {"cook-torrance": (8, 16, 8), "blinn-phong": (6, 16, 8)}
# A lobe wider than the paper's, in place of the narrowest broad term, which few light factors cannot follow.
DEGREES, BROAD = (*LOBES, 38.0), (1.0, 5.0)
# Changes whenever the same arguments give another model.
VERSION = 2
ROUGHNESSES = (1e-4, *np.geomspace(0.01, 1.0, 22).tolist(), 2.0, 10.0)
EXPONENTS = (0.0, *np.geomspace(1.0, 2048.0, 20).tolist(), 6e3, 2e4, 1e5, 1e6)
# Samples of lobe energies and albedo over cos(theta_o), from 0 to 1.
POLAR = 64
# Side of a material's view table.
VIEW_SIDE = 48
# What the tensor is cut down to before it is factorised; all that counts is in there.
_SPAN = (16, 64, 64)


@dataclass(frozen=True, eq=False)
class DirectModel:
    """parameters (H, d) float64: exponent (d = 1), or f0 and roughness (d = 2), of the entries; reflectance (H, n_h),
    view (n, n_o), light (n, n_i), core (n_h, n_o, n_i) float64: U_h, U_o, U_i, D over the n cells of
    `disc_grid(resolution)`; degrees (L,), radius (R,), energy (H, R, L) float64 as in `SpecularLobes`; importance
    (n_i,) float64 as in `LightFactors`; albedo (H, POLAR) float64: A at cos(theta_o) = k / (POLAR - 1); cell_albedo
    (H, n) float64: its mean over view cells; error (H,) float64: |f - f^| / |f| of every entry, lobes on both sides;
    tables: of the entries that `setting` has met.
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
    albedo: NDArray[np.float64]
    cell_albedo: NDArray[np.float64]
    error: NDArray[np.float64]
    tables: dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]] = field(default_factory=dict, repr=False)

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
    "albedo": ("entry", "cosine"),
    "cell_albedo": ("entry", "cell"),
    "error": ("entry",),
}


class LightFactors(NamedTuple):
    """table (D, D, K+1) float32, sr^-1: light factors over the D x D grid of the disc [column of x, row of y], cells
    beyond the rim filled from their neighbours; the last is 1/pi. importance (K+1,) float32: g, the root mean square of
    the view factors that belong to them, over settings whose BRDF has the norm 1, as the diffuse 1/pi has."""

    table: NDArray[np.float32]
    importance: NDArray[np.float32]


class MaterialSetting(NamedTuple):
    """One material at run time, for specular colour 1.

    view_table (S, S, K+1) float32: W at the points p = (x, y) / sqrt(1 + z) of a grid of S x S nodes over [-1, 1]^2,
    [row of x, column of y]; nodes beyond the disc have what is at its rim. Equal areas, and smooth in z at the rim.
    energy (POLAR, L) float32: a of the lobes at cos(theta_o) = k / (POLAR - 1). outside: the values are beyond the
    set, and the nearest ones were taken."""

    view_table: NDArray[np.float32]
    energy: NDArray[np.float32]
    outside: bool


def from_arrays(family: str, resolution: int, arrays: Mapping[str, NDArray[Any]]) -> DirectModel:
    """The model whose `arrays` these are."""
    known: Any = {name: np.asarray(arrays[name], np.float64) for name in ARRAYS}
    return DirectModel(family, resolution, **known)


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
    degrees: Sequence[float] = DEGREES,
    resolution: int = RESOLUTION,
    weighted: bool = True,
) -> DirectModel:
    """Samples, splits and factorises a set. Takes about 0.2 GB of memory for every 16 entries at 32 x 32 cells.

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
    grid, lobes = brdfs.grid, fit_lobes(brdfs, degrees, BROAD)
    norm = np.sqrt(np.einsum("hoi,hoi->h", brdfs.values, brdfs.values)) * grid.area
    norm[norm == 0.0] = 1.0
    unit = norm if weighted else np.full(len(norm), math.sqrt(float((norm**2).mean())))
    cell_albedo = brdfs.values.sum(2) * grid.area
    remainder = brdfs.values  # from here on
    remainder -= lobes_on_grid(grid, lobes)
    remainder -= remainder.mean(2, keepdims=True)
    remainder /= unit[:, None, None]
    # In two steps: the sweeps are then over a small tensor.
    span = hosvd(remainder.astype(np.float32), tuple(max(a, b) for a, b in zip(ranks, _SPAN, strict=True)), (1, 2))
    tucker = hooi(span.core, ranks, paired=(1, 2))
    u_h, u_o, u_i = (_product(a, b) for a, b in zip(span.factors, tucker.factors, strict=True))
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
        directional_albedo(family, brdfs.parameters, np.linspace(0.0, 1.0, POLAR)),
        cell_albedo,
        error,
    )


def _product(a: NDArray[np.float64] | None, b: NDArray[np.float64] | None) -> NDArray[np.float64]:
    assert a is not None
    assert b is not None
    return a @ b


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
    table = np.zeros((VIEW_SIDE * VIEW_SIDE, model.light.shape[1] + 1))
    energy = np.zeros((POLAR, len(model.degrees)))
    for entry in np.flatnonzero(found.weights).tolist():
        if entry not in model.tables:
            model.tables[entry] = _entry(model, entry)
        of_table, of_energy = model.tables[entry]
        table += found.weights[entry] * of_table
        energy += found.weights[entry] * of_energy
    table = table.reshape(VIEW_SIDE, VIEW_SIDE, -1)
    return MaterialSetting(table.astype(np.float32), energy.astype(np.float32), found.outside)


class _Nodes(NamedTuple):
    """Where a view table is made. cosine (m,) of its nodes; to_node (m, n) sparse: bilinear from cells; sine (POLAR,);
    to_ring (R, n) sparse: means of the cells at one theta_o; radius (R,), sin(theta_o) of theirs."""

    cosine: NDArray[np.float64]
    to_node: Any
    sine: NDArray[np.float64]
    to_ring: Any
    radius: NDArray[np.float64]


@lru_cache(maxsize=4)
def _nodes(resolution: int) -> _Nodes:
    grid = disc_grid(resolution)
    axis = np.linspace(-1.0, 1.0, VIEW_SIDE)
    p = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    radius2 = (p**2).sum(1)
    p /= np.sqrt(np.maximum(radius2, 1.0))[:, None]
    z = np.maximum(1.0 - radius2, 0.0)
    index, part = bilinear(grid, p * np.sqrt(1.0 + z)[:, None])
    to_node = csr_array((part.reshape(-1), index.reshape(-1), 4 * np.arange(len(p) + 1)), (len(p), len(grid)))
    rings, of_cell = np.unique(np.rint((grid.position**2).sum(1) * resolution**2), return_inverse=True)
    weight = 1.0 / np.bincount(of_cell)[of_cell]
    to_ring = csr_array((weight, (of_cell, np.arange(len(grid)))), (len(rings), len(grid)))
    sine = np.sqrt(1.0 - np.linspace(0.0, 1.0, POLAR) ** 2)
    return _Nodes(z, to_node, sine, to_ring, np.sqrt(rings) / resolution)


@lru_cache(maxsize=32)
def _share(degrees: float) -> NDArray[np.float64]:
    return lobe_share(degrees, np.linspace(0.0, 1.0, POLAR))


def _entry(model: DirectModel, entry: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """W (m, K+1) at the nodes of a view table, and lobe energies (POLAR, L), of one entry: with its albedo."""
    nodes = _nodes(model.resolution)
    cosine = np.linspace(0.0, 1.0, POLAR)
    albedo, cell_albedo = model.albedo[entry], model.cell_albedo[entry]

    # Lobes: their nodes are rings of cells.
    scale = _ratio(albedo, np.interp(nodes.sine, nodes.radius, nodes.to_ring @ cell_albedo))
    energy = np.zeros((POLAR, len(model.degrees)))
    of_lobes = np.zeros(POLAR)
    for k, degrees in enumerate(model.degrees):
        energy[:, k] = scale * np.interp(nodes.sine, model.radius, model.energy[entry, :, k])
        of_lobes += energy[:, k] * _share(float(degrees))

    # The tensor's part, and the albedo that is missing.
    factors = model.view @ np.tensordot(model.reflectance[entry], model.core, 1)
    exact = np.interp(nodes.cosine, cosine, albedo)
    table = _ratio(exact, nodes.to_node @ cell_albedo)[:, None] * (nodes.to_node @ factors)
    factor_sum = model.light.sum(0) * disc_grid(model.resolution).area
    missing = exact - np.interp(nodes.cosine, cosine, of_lobes) - table @ factor_sum
    return np.concatenate([table, missing[:, None]], axis=1), energy


def _ratio(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.divide(a, b, out=np.ones(len(a)), where=b > 0.0)


def _dense(grid: DiscGrid, cells: NDArray[np.float64]) -> NDArray[np.float32]:
    """Values (n, K) at the cells of the whole square, (D, D, K) float32."""
    axis = 2.0 * (np.arange(grid.resolution) + 0.5) / grid.resolution - 1.0
    square = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1)
    index, part = bilinear(grid, square)
    return np.ascontiguousarray(np.einsum("xyc,xyck->xyk", part, cells[index]), np.float32)
