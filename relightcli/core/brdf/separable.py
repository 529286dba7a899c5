"""A specular lobe as a short sum of products: view factors times light factors, isotropic by construction.

With polar angles about the normal, and phi between the two azimuths, the lobe with its cosine is even in phi:

    s(l, v) = sum_m cos(m phi) S_m(theta_v, theta_l),      S_m = sum_j a_mj(theta_v) b_mj(theta_l)

S_m is the cosine transform over phi; its factors come from a singular value decomposition, in the measure of solid
angle for the light and of solid angle times cosine, the flux, for the view. As cos(m (phi_v - phi_l)) = cos cos +
sin sin, every term of order m > 0 is a pair of functions on either side, and pairs are kept or left out whole: turning
both directions about the normal changes nothing.

Kept are, for every lobe alike so that loops over them are short and of fixed length, the strongest products of the
orders below ROWS[0], the second strongest of those below ROWS[1], and four more of order 0, which holds the lobe's
energy. What this leaves out of rough lobes is some percent of their norm, of narrow ones most of it, that is their
sharpness; lobes at least LEAST_WIDTH wide keep their energy to a percent up to 60 degrees, to 5 % beyond
(tests/core/brdf/test_separable.py). A truncated lobe has places below zero, which belong to its energy.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import lobes_and_density

POLAR = 48  # samples of theta, even in p = sqrt(1 - cos theta) from 0 to 1, which goes nearly with theta
AZIMUTHS = 128  # samples of phi from 0 to 360 degrees
ROWS = (14, 6, 1, 1, 1, 1)  # orders of the first, second, ... product; from the third on order 0 alone
TERMS = sum(ROWS)
LEAST_WIDTH = 0.2  # radians in directions of light: narrower lobes have more than the terms can hold


class Separable(NamedTuple):
    """K = TERMS terms, orders 0 to ROWS[0] - 1 first, then 0 to ROWS[1] - 1, ...: view_factor, light_factor (POLAR, K)
    float32 at p = (g + 1/2)/POLAR. The lobe is the sum over the terms of both times cos(order phi), sr^-1."""

    view_factor: NDArray[np.float32]
    light_factor: NDArray[np.float32]


def polar_cosines() -> NDArray[np.float64]:
    """cos(theta) at the samples of the factors, (POLAR,)."""
    p = (np.arange(POLAR) + 0.5) / POLAR
    return 1.0 - p * p


def separate(model: int, row: NDArray[np.float64]) -> Separable:
    """The specular lobe of a parameter row (`brdf.models`), without its colour. Arrays are not to be written to: those
    of the last few lobes are kept, as every picture asks for them again."""
    return _separate(model, row.tobytes())


@lru_cache(maxsize=256)
def _separate(model: int, parameters: bytes) -> Separable:
    spectra, lit, seen = harmonics(model, np.frombuffer(parameters)[None])
    u, size, vt = np.linalg.svd(spectra[0] * (seen[:, None] * lit))
    root = np.sqrt(size)
    view = [root[:count, j, None] * u[:count, :, j] / seen for j, count in enumerate(ROWS)]
    light = [root[:count, j, None] * vt[:count, j] / lit for j, count in enumerate(ROWS)]
    made = Separable(
        np.ascontiguousarray(np.concatenate(view).T, np.float32),
        np.ascontiguousarray(np.concatenate(light).T, np.float32),
    )
    for factor in made:
        factor.flags.writeable = False
    return made


def harmonics(
    model: int, rows: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """S_m (H, ROWS[0], POLAR view, POLAR light) of H parameter rows, and the roots of the measures of light and view
    (POLAR,) that make sums of squares integrals, up to a factor for all."""
    cosine = polar_cosines()
    values = np.empty((POLAR, POLAR, AZIMUTHS))
    spectra = np.empty((len(rows), ROWS[0], POLAR, POLAR))
    for h, row in enumerate(rows):
        _tabulate(model, row, cosine, values)
        spectra[h] = np.moveaxis(np.fft.rfft(values, axis=2).real[:, :, : ROWS[0]], 2, 0) / AZIMUTHS
    spectra[:, 1:] *= 2.0
    lit = np.sqrt(np.sqrt(1.0 - cosine))  # solid angle goes with p dp
    return spectra, lit, lit * np.sqrt(cosine)


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
