"""A basis of whole BRDFs for transported light, and its split into view and light factors. [Sun 2007, sec. 3.1, 4.3]

    f(h, w_o, w_i) ~ sum over p of H(h, p) b_p(w_o, w_i),   p = 0 .. P-2 specular, P-1 the diffuse 1/pi

The specular b_p are the leading right singular vectors of F with its samples weighted by the square root of
cos cos dw dw = dA^2; F is not centred, so that f is linear in H with nothing left over. They are orthonormal in that
measure, and the squared error, the sum of |f - f^|^2 dA^2, is the discarded singular energy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relightcli.core.brdf.dataset import BrdfSet
from relightcli.core.brdf.disc import DiscGrid
from relightcli.core.compress.tucker import gram_spectrum, mode_gram, pair_safe_rank

SPECULAR_FUNCTIONS = 4


@dataclass(frozen=True, eq=False)
class BrdfBasis:
    """functions (P, n, n) float64 sr^-1, [p, view cell, light cell], the last one 1/pi; coefficients (H, P-1) float64
    of the set's entries; norm2 and error2: sum of f^2 dA^2 over the set, and of the squared difference."""

    grid: DiscGrid
    functions: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    norm2: float
    error2: float


@dataclass(frozen=True, eq=False)
class SharedSplit:
    """b_p(o, i) ~ sum over k of view[p, k, o] light[k, i] for the specular b_p: view (P-1, K, n), light (K, n) float64.

    norm2 and error2: sums over p and the cells, times dA^2, of b_p^2 and of the squared difference.
    """

    view: NDArray[np.float64]
    light: NDArray[np.float64]
    norm2: float
    error2: float


def brdf_basis(brdfs: BrdfSet, count: int = SPECULAR_FUNCTIONS) -> BrdfBasis:
    """`count` specular functions, or as many as the set has dimensions, and the diffuse one."""
    area = brdfs.grid.area
    values, vectors = gram_spectrum(mode_gram(brdfs.values, 0) * area**2)
    used = vectors[:, :count]
    coefficients = used * np.sqrt(values[:count])
    norm2 = float((brdfs.values**2).sum()) * area**2
    # b = A' u / sigma with A = F dA, over dA again; the zero set keeps one function, which is 0.
    scale = np.divide(1.0, np.sqrt(values[:count]), out=np.zeros(used.shape[1]), where=values[:count] > 0.0)
    specular = np.tensordot(used * scale, brdfs.values, (0, 0))
    diffuse = np.full((1, len(brdfs.grid), len(brdfs.grid)), 1.0 / math.pi)
    error2 = max(0.0, norm2 - float(values[:count].sum()))
    return BrdfBasis(brdfs.grid, np.concatenate([specular, diffuse]), coefficients, norm2, error2)


def shared_split(basis: BrdfBasis, terms: int) -> SharedSplit:
    """One singular value decomposition of all specular functions, stacked along the view cells.

    Light factors are orthonormal in dA. A pair of them is never cut (`pair_safe_rank`), so there can be one more than
    `terms`; there are fewer where the functions have fewer.
    """
    specular, area = basis.functions[:-1], basis.grid.area
    values, vectors = gram_spectrum(mode_gram(specular, 2) * area**2)
    k = pair_safe_rank(values, terms)
    light = vectors[:, :k].T / math.sqrt(area)
    view = np.swapaxes(specular @ light.T * area, 1, 2)
    norm2 = float((specular**2).sum()) * area**2
    return SharedSplit(view, light, norm2, max(0.0, norm2 - float(values[:k].sum())))
