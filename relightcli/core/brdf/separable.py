"""A specular lobe as a short sum of products: view factors times light factors, isotropic by construction.

With polar angles about the normal, and phi between the two azimuths, the lobe with its cosine is even in phi:

    s(l, v) = sum_m cos(m phi) S_m(theta_v, theta_l),      S_m = sum_j a_mj(theta_v) b_mj(theta_l)

S_m is the cosine transform over phi; its factors come from a singular value decomposition, in the measure of solid
angle for the light and of solid angle times cosine, the flux, for the view. As cos(m (phi_v - phi_l)) = cos cos +
sin sin, every term of order m > 0 is a pair of functions on either side, and pairs are kept or left out whole: turning
both directions about the normal changes nothing. Terms are kept by size until `tolerance` of the norm is left.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import lobes_and_density

POLAR = 48  # samples of theta, even in p = sqrt(1 - cos theta) from 0 to 1, which goes nearly with theta
AZIMUTHS = 128  # samples of phi from 0 to 360 degrees
MOST_TERMS = 24
MOST_ORDERS = AZIMUTHS // 2


class Separable(NamedTuple):
    """Terms, sorted by order: order (K,) int64; view_factor, light_factor (POLAR, K) float32 at p = (g + 1/2)/POLAR.
    The lobe is the sum over k of view_factor light_factor cos(order phi), sr^-1."""

    order: NDArray[np.int64]
    view_factor: NDArray[np.float32]
    light_factor: NDArray[np.float32]


def polar_cosines() -> NDArray[np.float64]:
    """cos(theta) at the samples of the factors, (POLAR,)."""
    p = (np.arange(POLAR) + 0.5) / POLAR
    return 1.0 - p * p


def separate(model: int, row: NDArray[np.float64], tolerance: float) -> Separable:
    """The specular lobe of a parameter row (`brdf.models`), without its colour, up to `tolerance` of its norm."""
    cosine = polar_cosines()
    values = np.empty((POLAR, POLAR, AZIMUTHS))
    _tabulate(model, row, cosine, values)
    harmonics = np.fft.rfft(values, axis=2).real / AZIMUTHS
    harmonics[:, :, 1:] *= 2.0
    lit = np.sqrt(np.sqrt(1.0 - cosine))  # solid angle goes with p dp
    seen = lit * np.sqrt(cosine)
    terms = []
    norm2 = 0.0
    for m in range(MOST_ORDERS):
        # cos^2 averages to 1/2 over phi, 1 for m = 0
        share = 1.0 if m == 0 else 0.5
        u, size, vt = np.linalg.svd(harmonics[:, :, m] * (seen[:, None] * lit))
        norm2 += share * float(size @ size)
        terms += [(share * s * s, m, s, u[:, j], vt[j]) for j, s in enumerate(size) if s > 0.0]
    terms.sort(key=lambda term: (-term[0], term[1]))
    kept, left = [], norm2
    for term in terms[:MOST_TERMS]:
        if left <= tolerance**2 * norm2:
            break
        kept.append(term)
        left -= term[0]
    kept.sort(key=lambda term: term[1])
    root = [math.sqrt(size) for _, _, size, _, _ in kept]
    shape = (POLAR, len(kept))
    view = np.array([r * u / seen for r, (_, _, _, u, _) in zip(root, kept, strict=True)]).T.reshape(shape)
    light = np.array([r * v / lit for r, (_, _, _, _, v) in zip(root, kept, strict=True)]).T.reshape(shape)
    order = np.array([m for _, m, _, _, _ in kept], np.int64)
    return Separable(order, np.ascontiguousarray(view, np.float32), np.ascontiguousarray(light, np.float32))


@njit(cache=True, error_model="numpy")
def _tabulate(model: int, row: Any, cosine: Any, values: Any) -> None:
    n = (0.0, 0.0, 1.0)
    azimuths = values.shape[2]
    for i in range(len(cosine)):
        v = (math.sqrt(1.0 - cosine[i] ** 2), 0.0, cosine[i])
        for j in range(len(cosine)):
            sine = math.sqrt(1.0 - cosine[j] ** 2)
            for k in range(azimuths // 2 + 1):
                phi = 2.0 * math.pi * k / azimuths
                l = (sine * math.cos(phi), sine * math.sin(phi), cosine[j])  # noqa: E741
                _, s, _, _ = lobes_and_density(model, row, n, l, v)
                values[i, j, k] = s
                values[i, j, (azimuths - k) % azimuths] = s
