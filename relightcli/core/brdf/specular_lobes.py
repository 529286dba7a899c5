"""Gaussian lobes about the mirror direction, split off a BRDF set. [Sun 2007, sec. 4.1]

    f = f_s + f_r,   f_s cos(theta_i) = sum over k of a_k(h, theta_o) G_k(angle(w_i, r)),   r the mirror of w_o

G_k = exp(-t^2 / (2 sigma_k^2)) / Z_k with sigma_k = k/3 for k = 0, 7, 14, 21 degrees, and its integral over the sphere
is 1: so a_k is energy, the lobe's reflectance where all of it is above the horizon. G_0 is a delta (the paper
multiplies Gaussians by values, and one of width 0 has no finite value). With k = 0 alone the split is that into mirror
and rest of the patent. [US 7884820]

Expectation maximisation for the weights of components of fixed shape,

    w_q <- w_q sum over j of y_j g_qj / sum over p of w_p g_pj,   y_j = f dA in light cell j,

keeps sum w = sum y: all energy ends up in components. Three broad ones, (r.w)+^n for n = 1, 5, 20, take what is no
lobe. They are not part of f_s and so go back into f_r, which can be negative. Lobes are cut off at the horizon: their
components are scaled to 1 above it for the fit, and a_k back afterwards.

The fit runs for every theta_o of the grid, with the entries' mean over the symmetries of the square.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.dataset import BrdfSet
from relightcli.core.brdf.disc import DiscGrid, cell_of, fold, spread, sub_directions

LOBES = (0.0, 7.0, 14.0, 21.0)
MIRROR = (0.0,)
BROAD_EXPONENTS = (1.0, 5.0, 20.0)

_RINGS, _AZIMUTHS = 16, 32
# EM ends when no weight changes by more than this part of the energy, or after so many rounds. Ten times as many, to a
# hundredth of the change, alter the tensor's error in the fourth digit.
_STILL = 1e-5
_ROUNDS = 500


@dataclass(frozen=True, eq=False)
class SpecularLobes:
    """degrees (K,); radius (R,) float64 rising, sin(theta_o) of the nodes; energy (H, R, K) float64, a_k >= 0."""

    degrees: tuple[float, ...]
    radius: NDArray[np.float64]
    energy: NDArray[np.float64]

    def at(self, weights: NDArray[np.floating[Any]], sine: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """a_k (..., K) of the mix of entries with `weights` (H,) at sin(theta_o) (...): linear between nodes."""
        mixed = np.tensordot(np.asarray(weights, np.float64), self.energy, 1)
        out = np.empty((*np.shape(sine), len(self.degrees)))
        for k in range(len(self.degrees)):
            out[..., k] = np.interp(sine, self.radius, mixed[:, k])
        return out


def normaliser(degrees: float) -> float:
    """Z_k, sr: the integral over the sphere of exp(-t^2 / (2 sigma^2)), sigma = degrees / 3."""
    sigma = math.radians(degrees) / 3.0
    x, w = np.polynomial.legendre.leggauss(64)
    end = min(math.pi, 10.0 * sigma)
    t = 0.5 * end * (x + 1.0)
    return float(np.pi * end * (w * np.exp(-0.5 * (t / sigma) ** 2) * np.sin(t)).sum())


def lobe_columns(grid: DiscGrid, degrees: Sequence[float]) -> NDArray[np.float64]:
    """Integral of each G_k over every light cell, mean over the view cell: (m, K, n) float64 for the octant.

    A row sums to the part of the lobe that is above the horizon.
    """
    views = sub_directions(grid, grid.octant)
    out = np.zeros((len(grid.octant), len(degrees), len(grid)))
    for k, degree in enumerate(degrees):
        if degree == 0.0:
            out[np.arange(len(out)), k, grid.mirror[grid.octant]] = 1.0
            continue
        local, weight = gaussian_samples(degree)
        for row, view in zip(out, views, strict=True):
            inside = view[view[:, 2] > 0.0]
            r = inside * (-1.0, -1.0, 1.0)
            # A frame about r: its second axis is horizontal.
            t = np.stack([-r[:, 1], r[:, 0], np.zeros(len(r))], -1)
            t /= np.sqrt((t**2).sum(1, keepdims=True))
            s = np.cross(t, r)
            lights = local @ np.stack([s, t, r], 1)
            above = lights[..., 2] > 0.0
            share = np.broadcast_to(weight / len(inside), above.shape)[above]
            row[k] = np.bincount(cell_of(grid, lights[above]), share, len(grid))
    return out


def gaussian_samples(degrees: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (s, 3) about the third axis and weights (s,), summing to 1, that integrate G_k."""
    sigma = math.radians(degrees) / 3.0
    # Rings of equal energy of the planar Gaussian, corrected by sin(t)/t.
    t = sigma * np.sqrt(-2.0 * np.log((np.arange(_RINGS) + 0.5) / _RINGS))
    turn = (np.arange(_AZIMUTHS) + 0.6180339887498949 * np.arange(_RINGS)[:, None]) * (2.0 * math.pi / _AZIMUTHS)
    sine = np.broadcast_to(np.sin(t)[:, None], turn.shape)
    cosine = np.broadcast_to(np.cos(t)[:, None], turn.shape)
    weight = np.broadcast_to((np.sin(t) / t)[:, None], turn.shape).ravel()
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], -1).reshape(-1, 3), weight / weight.sum()


def broad_columns(grid: DiscGrid, exponents: Sequence[float] = BROAD_EXPONENTS) -> NDArray[np.float64]:
    """The broad terms (r.w)+^n in every light cell, each row summing to 1: (m, q, n) float64 for the octant."""
    r = grid.direction[grid.octant] * (-1.0, -1.0, 1.0)
    cosine = np.maximum(r @ grid.direction.T, 0.0)
    # dw = dA / cos(theta_i)
    out = cosine[:, None, :] ** np.array(exponents)[:, None] / grid.direction[:, 2]
    return out / out.sum(-1, keepdims=True)


def fit_lobes(
    brdfs: BrdfSet, degrees: Sequence[float] = LOBES, broad: Sequence[float] = BROAD_EXPONENTS
) -> SpecularLobes:
    """Lobe energies of every entry at every theta_o of the grid, by expectation maximisation; `MIRROR` for 0 degrees
    alone, () for no lobes. broad: exponents of the terms that take what is no lobe."""
    grid = brdfs.grid
    radius, ring = np.unique(_square_radius(grid), return_inverse=True)
    energy = np.zeros((len(brdfs), len(radius), len(degrees)))
    if degrees:
        columns = lobe_columns(grid, degrees)
        above = columns.sum(-1)
        components = np.concatenate([columns / above[..., None], broad_columns(grid, broad)], 1)
        found = np.stack(
            [
                expectation_maximisation(fold(grid, entry) * grid.area, components)[:, : len(degrees)] / above
                for entry in brdfs.values
            ]
        )
        # Two orbits of the square can have one radius (1 + 49 = 25 + 25).
        for k in range(len(radius)):
            energy[:, k] = found[:, ring == k].mean(1)
    return SpecularLobes(tuple(degrees), np.sqrt(radius) / grid.resolution, energy)


def _square_radius(grid: DiscGrid) -> NDArray[np.int64]:
    """sin^2(theta_o) N^2 of the octant's cells, whole numbers (m,)."""
    return np.rint((grid.position[grid.octant] ** 2).sum(1) * grid.resolution**2).astype(np.int64)


def lobes_on_grid(grid: DiscGrid, lobes: SpecularLobes) -> NDArray[np.float64]:
    """f_s as means over the cells: (H, n, n) float64, sr^-1."""
    ring = np.searchsorted(lobes.radius, np.sqrt(_square_radius(grid)) / grid.resolution)
    columns = lobe_columns(grid, lobes.degrees) / grid.area
    return spread(grid, np.einsum("hmk,mkn->hmn", lobes.energy[:, ring], columns, optimize=True))


def expectation_maximisation(y: NDArray[np.float64], components: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights (m, q) >= 0 of components (m, q, n), each summing to 1 over n, for data y (m, n) >= 0. [Dempster 1977]

    Their sum is that of y over the cells where any component is above 0.
    """
    weights = np.zeros(components.shape[:2])
    for row in range(len(y)):
        _em_row(y[row], components[row], weights[row])
    return weights


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _em_row(y: Any, g: Any, w: Any) -> None:
    count, cells = g.shape
    energy = y.sum()
    w[:] = energy / count
    model = np.empty(cells)
    for _ in range(_ROUNDS):
        model[:] = 0.0
        for q in range(count):
            for j in range(cells):
                model[j] += w[q] * g[q, j]
        for j in range(cells):
            model[j] = y[j] / model[j] if model[j] > 0.0 else 0.0
        change = 0.0
        for q in range(count):
            factor = 0.0
            for j in range(cells):
                factor += g[q, j] * model[j]
            change = max(change, abs(w[q] * factor - w[q]))
            w[q] *= factor
        if change <= _STILL * energy:
            return
