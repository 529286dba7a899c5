"""A few BRDF functions for the surfaces that light bounces off: every lobe of a model is nearly a mix of them.

Transfer tensors hold one part per basis function b_p of an adjustable material, so that a change of the material is a
change of coefficients [Sun 2007, sec. 3.3]:

    f cos = diffuse/pi cos + specular sum_p c_p b_p,        b_p = sum_k A_pk(view) B_k(light)

Data are the model's lobes over its whole range, at least WIDTH wide, each scaled to norm 1 so that rough ones count as
much as shiny ones, as cosine transforms over the azimuth (`brdf.separable`). Beside its values every lobe has its
reflectance under even light, weighted by ENERGY: what a bounce gets wrong in shape averages out, what it gets wrong in
energy does not. The b_p are combinations of lobes by a singular value decomposition, uncentred, so that the mix is
linear [digest S3]. The light factors B_k, one set for all p, are singular vectors in the light's polar angle of every
order m: b_p is isotropic by construction. The first of order 0 is constant, which keeps the energy under even light.
Schlick's Fresnel term is linear in f0, which therefore needs its two ends only; the coefficients are interpolated in
the logarithm of roughness or exponent.

WIDTH is about a light cell of the tensors, a face's eighth; at 0.2 the narrowest lobes had twice the error in
reflectance with as many functions.
"""

from __future__ import annotations

import math
from functools import lru_cache
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from relightcli.core.brdf.models import (
    BLINN_PHONG,
    COOK_TORRANCE,
    F0,
    PHONG,
    ROUGHNESS,
    SHININESS,
    pack_materials,
)
from relightcli.core.brdf.separable import POLAR, ROWS, TERMS, harmonics

WIDTH = 0.3  # radians in directions of light
ENERGY = 6.0  # weight of reflectance under even light beside that of the values
FUNCTIONS = 4  # specular basis functions; the diffuse one comes on top
NODES = 32  # lobes of different width in the data
ROUGHEST, BROADEST = 1.25, 0.05  # ends of the range: roughness, exponent


class TransportBasis(NamedTuple):
    """P functions of one model, K = TERMS factors.

    view_factor (P, POLAR, K), light_factor (POLAR, K) float32, as `brdf.separable`'s; node (H,) float64, logarithms of
    the widths, rising; coefficient (H, 2, P) float64, of the lobes with f0 = 0 and 1 (equal without f0); error (H, 2),
    relative norm of what mixing the P functions leaves out of each; left, the part of the norm (relative, of all
    lobes) that the K factors leave out.
    """

    view_factor: NDArray[np.float32]
    light_factor: NDArray[np.float32]
    node: NDArray[np.float64]
    coefficient: NDArray[np.float64]
    error: NDArray[np.float64]
    left: float


@lru_cache(maxsize=8)
def transport_basis(model: int, functions: int = FUNCTIONS) -> TransportBasis:
    """The basis of a model code with a specular lobe (`brdf.models`); `functions` P is cut to the rank of the data."""
    nodes = widths(model, WIDTH, NODES)
    table = pack_materials([white(model, width, f0) for width in nodes for f0 in (0.0, 1.0)])
    spectra, lit, seen = harmonics(model, table.parameters)  # (2 H, M, POLAR view, POLAR light)
    orders = spectra.shape[1]
    half = np.where(np.arange(orders) > 0, math.sqrt(0.5), 1.0)  # cos^2 has the mean 1/2
    data = spectra * (half[:, None, None] * seen[:, None] * lit)
    even = lit / np.linalg.norm(lit)  # light of the same radiance from everywhere
    norm = np.linalg.norm(data.reshape(len(data), -1), axis=1)
    energy = ENERGY * (data[:, 0] @ even)
    both = np.concatenate([data.reshape(len(data), -1), energy], axis=1) / norm[:, None]
    u, size, _ = np.linalg.svd(both, full_matrices=False)
    count = min(functions, int(np.count_nonzero(size > 1e-10 * size[0])))
    coefficient = u[:, :count] * size[:count] * norm[:, None]
    function = np.einsum("hp,hmvl->pmvl", u[:, :count] / size[:count] / norm[:, None], data, optimize=True)
    left = data - np.einsum("hp,pmvl->hmvl", coefficient, function, optimize=True)
    scaled = size[:count, None, None, None] * function
    view = np.zeros((count, POLAR, TERMS))
    light = np.zeros((POLAR, TERMS))
    vectors = [_vectors(scaled[:, m].reshape(-1, POLAR), even if m == 0 else None) for m in range(orders)]
    kept, term = 0.0, 0
    for j, row in enumerate(ROWS):
        for m in range(row):
            b = vectors[m][j]
            along = function[:, m] @ b
            light[:, term] = b / lit
            view[:, :, term] = along / (half[m] * seen)
            kept += float(((size[:count, None] * along) ** 2).sum())
            term += 1
    return TransportBasis(
        np.ascontiguousarray(view, np.float32),
        np.ascontiguousarray(light, np.float32),
        np.log(nodes),
        coefficient.reshape(len(nodes), 2, count),
        (np.linalg.norm(left.reshape(len(data), -1), axis=1) / norm).reshape(len(nodes), 2),
        math.sqrt(max(0.0, 1.0 - kept / float((scaled**2).sum()))),
    )


def _vectors(rows: NDArray[np.float64], first: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Orthonormal rows, the strongest right singular vectors, after `first` if there is one."""
    if first is None:
        return np.asarray(np.linalg.svd(rows, full_matrices=False)[2])
    rest = rows - np.outer(rows @ first, first)
    found = np.linalg.svd(rest, full_matrices=False)[2]
    return np.concatenate([first[None], found])


def mix(basis: TransportBasis, row: NDArray[np.float64], model: int) -> NDArray[np.float64]:
    """Coefficients (P,) of a lobe given by its parameter row, without its colour; beyond the ends those of the end."""
    width = math.log(max(row[ROUGHNESS] if model == COOK_TORRANCE else row[SHININESS], 1e-300))
    f0 = row[F0] if model == COOK_TORRANCE else 0.0
    ends = (1.0 - f0) * basis.coefficient[:, 0] + f0 * basis.coefficient[:, 1]
    return np.array([np.interp(width, basis.node, ends[:, p]) for p in range(ends.shape[1])])


def widths(model: int, narrowest: float, count: int) -> NDArray[np.float64]:
    """Roughness or exponents of a model over its range, rising, the narrowest lobe `narrowest` radians wide."""
    if model == COOK_TORRANCE:
        return np.geomspace(narrowest / math.sqrt(2.0), ROUGHEST, count)
    if model in (BLINN_PHONG, PHONG):
        return np.geomspace(BROADEST, (4.0 if model == BLINN_PHONG else 1.0) / narrowest**2, count)
    raise ValueError(f"model {model} has no specular lobe")


def white(model: int, width: float, f0: float) -> SimpleNamespace:
    """A material of specular colour 1 and no diffuse term."""
    name = {COOK_TORRANCE: "cook-torrance", BLINN_PHONG: "blinn-phong", PHONG: "phong"}[model]
    black = (0.0, 0.0, 0.0)
    return SimpleNamespace(
        model=name,
        diffuse=black,
        specular=(1.0, 1.0, 1.0),
        transmittance=black,
        f0=f0,
        roughness=width,
        shininess=width,
    )
