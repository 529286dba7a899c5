"""A BRDF set in factors: lobes, a small tensor for what remains, a basis for transport. [Sun 2007, sec. 3.2, 4.1]

    f(w, w_o, w_i) ~ f_s + sum over i, j, k of D(i, j, k) (w'U_h)(i) U_o(w_o, j) U_i(w_i, k)       [Sun 2007, Eq. 2]

for a mix w of the set's entries (`relightcli.core.brdf.navigation`). f_s are the lobes of
`relightcli.core.brdf.specular_lobes`, the tensor approximates f_r = f - f_s, both as means over cells. Pairs of view
and of light factors are kept whole, so an isotropic set stays isotropic: a rank that would cut one is moved up by one,
and `closed` says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relightcli.core.brdf.basis import SPECULAR_FUNCTIONS, BrdfBasis, brdf_basis
from relightcli.core.brdf.dataset import BrdfSet
from relightcli.core.brdf.disc import DiscGrid, bilinear
from relightcli.core.brdf.specular_lobes import LOBES, SpecularLobes, fit_lobes, lobes_on_grid, normaliser
from relightcli.core.compress.tucker import hooi

# n_h = 4, n_o = n_i = 8. [Sun 2007, sec. 4.3]
RANKS = (4, 8, 8)


@dataclass(frozen=True, eq=False)
class FactorisedBrdf:
    """reflectance (H, n_h), view (n, n_o), light (n, n_i), core (n_h, n_o, n_i): U_h, U_o, U_i, D, float64, over the
    cells of `grid`; parameters (H, d) of the entries; lobes and basis of the set.

    closed: modes (0 h, 1 o, 2 i) whose rank was moved up so that no pair is cut. error: |F - F^|^2 / |F|^2 over all
    entries and cells, lobes included on both sides; since cells have equal areas, this is the ratio of the integrals
    over cos cos dw dw.
    """

    grid: DiscGrid
    parameters: NDArray[np.float64]
    reflectance: NDArray[np.float64]
    view: NDArray[np.float64]
    light: NDArray[np.float64]
    core: NDArray[np.float64]
    lobes: SpecularLobes
    basis: BrdfBasis
    closed: tuple[int, ...]
    error: float


def factorise_dataset(
    brdfs: BrdfSet,
    ranks: tuple[int, int, int] = RANKS,
    degrees: Sequence[float] = LOBES,
    functions: int = SPECULAR_FUNCTIONS,
) -> FactorisedBrdf:
    """ranks: n_h, n_o, n_i, cut down to what the set has; degrees: lobes, `MIRROR` for the mirror alone, () for none;
    functions: specular functions of the basis. Raises NumericalError if the factorisation fails."""
    lobes = fit_lobes(brdfs, degrees)
    remainder = brdfs.values - lobes_on_grid(brdfs.grid, lobes)
    tucker = hooi(remainder, ranks, paired=(1, 2))
    reflectance, view, light = tucker.factors
    assert reflectance is not None
    assert view is not None
    assert light is not None
    norm2 = float((brdfs.values**2).sum())
    error = tucker.error2 / norm2 if norm2 > 0.0 else 0.0
    basis = brdf_basis(brdfs, functions)
    return FactorisedBrdf(
        brdfs.grid, brdfs.parameters, reflectance, view, light, tucker.core, lobes, basis, tucker.closed, error
    )


def remainder_at(
    brdf: FactorisedBrdf,
    weights: NDArray[np.floating[Any]],
    view: NDArray[np.float64],
    light: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The tensor's part f_r (...) sr^-1 of the mix with `weights` (H,), for unit directions (..., 3) that broadcast; 0
    below the surface. It can be negative. View and light factors are interpolated bilinearly on the disc."""
    core = np.tensordot(np.asarray(weights, np.float64) @ brdf.reflectance, brdf.core, 1)
    above = (view[..., 2] > 0.0) & (light[..., 2] > 0.0)
    o, i = _factors(brdf.grid, brdf.view, view), _factors(brdf.grid, brdf.light, light)
    return np.where(above, np.einsum("...j,jk,...k->...", o, core, i), 0.0)


def lobes_at(
    brdf: FactorisedBrdf,
    weights: NDArray[np.floating[Any]],
    view: NDArray[np.float64],
    light: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The lobes' part f_s (...) sr^-1, as `remainder_at`. The lobe of 0 degrees, a delta, is spread evenly over a disc
    of a cell's area about the mirror direction."""
    above = (view[..., 2] > 0.0) & (light[..., 2] > 0.0)
    mirror = view * (-1.0, -1.0, 1.0)
    energy = brdf.lobes.at(weights, np.sqrt((view[..., :2] ** 2).sum(-1)))
    difference = np.sqrt(((light - mirror) ** 2).sum(-1))
    angle = 2.0 * np.arcsin(np.minimum(0.5 * difference, 1.0))
    out = np.zeros(above.shape)
    for k, degrees in enumerate(brdf.lobes.degrees):
        if degrees == 0.0:
            off2 = ((light - mirror)[..., :2] ** 2).sum(-1)
            out += energy[..., k] * np.where(np.pi * off2 <= brdf.grid.area, 1.0 / brdf.grid.area, 0.0)
        else:
            sigma = np.radians(degrees) / 3.0
            gaussian = np.exp(-0.5 * (angle / sigma) ** 2) / normaliser(degrees)
            out += energy[..., k] * np.divide(gaussian, light[..., 2], out=np.zeros(above.shape), where=above)
    return np.where(above, out, 0.0)


def evaluate(
    brdf: FactorisedBrdf,
    weights: NDArray[np.floating[Any]],
    view: NDArray[np.float64],
    light: NDArray[np.float64],
) -> NDArray[np.float64]:
    """f_s + f_r (...) sr^-1: `lobes_at` and `remainder_at`."""
    return lobes_at(brdf, weights, view, light) + remainder_at(brdf, weights, view, light)


def _factors(grid: DiscGrid, factor: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    index, weight = bilinear(grid, directions)
    return np.einsum("...c,...cj->...j", weight, factor[index])
