"""A latitude-longitude environment: look-up, and importance sampling of its texels.

Image x in [0, 1] left to right and y in [0, 1] top to bottom belong to the direction

    longitude = pi (1 - 2x),  latitude = pi (1/2 - y),  d = (sin lon cos lat, sin lat, cos lon cos lat)

(OpenEXR's ENVMAP_LATLONG). A texel is constant over its solid angle. A rotation by D about +Y, right-handed, makes the
environment L'(d) = L(Ry(-D) d): what was at longitude lon is then at lon + D.

Sampling draws a row, then a column, then a point uniform over the texel's solid angle, with the density (sr^-1)

    p(d) = max(0, Y(d) - Y0) / sum_texels max(0, Y - Y0) Omega

where Y is the luminance of |RGB|, so that negative texels are found too, and Y0 its mean over the sphere, or 0. With
the mean taken off only what stands out of an even sky is looked for; a reflectance that is sampled as well finds the
rest [Karlik 2019, MIS compensation]. The two running sums are float64.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Triple = tuple[float, float, float]

# Luminance of linear Rec.709. [ITU-R BT.709-6, item 3.2]
LUMINANCE: NDArray[np.float64] = np.array([0.2126, 0.7152, 0.0722])


class LatLong(NamedTuple):
    """An environment as kernels read it; made by `make_latlong`.

    radiance   (H, W, 3) float32, finite
    rotation   radians about +Y
    row_cdf    (H + 1,) float64, 0 to 1: share of probability above each row's upper edge
    column_cdf (H, W + 1) float64: the same within a row
    floor      Y0
    density    1 / sum max(0, Y - Y0) Omega; 0 where there is nothing to sample: a black map, or an even one
    lit        whether any texel is not black
    """

    radiance: NDArray[np.float32]
    rotation: float
    row_cdf: NDArray[np.float64]
    column_cdf: NDArray[np.float64]
    floor: float
    density: float
    lit: bool


def texel_solid_angles(height: int, width: int) -> NDArray[np.float64]:
    """Exact solid angle of one texel of each row, (H,) float64, sr: (2 pi / W)(sin lat_top - sin lat_bottom).

    Written as 2 sin(theta_centre) sin(pi / 2H), theta from the nearer pole, which loses no digits there. W times their
    sum is 4 pi.
    """
    centre = np.arange(height) + 0.5
    theta = math.pi * np.minimum(centre, height - centre) / height
    return (4.0 * math.pi / width) * math.sin(0.5 * math.pi / height) * np.sin(theta)


def make_latlong(radiance: NDArray[np.floating[Any]], rotate_degrees: float = 0.0, compensated: bool = True) -> LatLong:
    """Prepare an environment (H, W, 3), finite, any size from 1 x 1; `rotate_degrees` about +Y, right-handed.

    compensated: sample only what is above the mean (Y0 > 0). The other technique must then reach every direction.
    """
    pixels = np.ascontiguousarray(radiance, np.float32)
    height, width = pixels.shape[:2]
    weight = np.abs(pixels).astype(np.float64) @ LUMINANCE
    lit = bool(weight.any())
    solid_angles = texel_solid_angles(height, width)
    floor = 0.0
    if compensated:
        floor = float(weight.sum(axis=1) @ solid_angles) / (4.0 * math.pi)
        # An even sky is its own mean up to rounding; what rounding leaves is no feature to look for.
        weight = np.where(weight > floor * (1.0 + 1e-6), weight - floor, 0.0)
    column_cdf = np.zeros((height, width + 1))
    np.cumsum(weight, axis=1, out=column_cdf[:, 1:])
    row_sum = column_cdf[:, -1].copy()
    used = row_sum > 0
    column_cdf[used] /= row_sum[used, None]
    row_cdf = np.zeros(height + 1)
    np.cumsum(row_sum * solid_angles, out=row_cdf[1:])
    total = float(row_cdf[-1])
    if total > 0:
        row_cdf /= total
    # Degrees are reduced before the multiplication: 360 is then exactly 0.
    rotation = math.radians(math.fmod(rotate_degrees, 360.0))
    density = 1.0 / total if total > 0 else 0.0
    return LatLong(pixels, rotation, row_cdf, column_cdf, floor, density, lit)


@njit(cache=True, error_model="numpy")
def texel_of(height: int, width: int, rotation: float, d: Triple) -> tuple[int, int]:
    """(row, column) of the texel that holds direction d (any length above 0)."""
    x = 0.5 - (math.atan2(d[0], d[2]) - rotation) / (2.0 * math.pi)
    y = 0.5 - math.atan2(d[1], math.hypot(d[0], d[2])) / math.pi
    column = int((x - math.floor(x)) * width)
    return min(max(int(y * height), 0), height - 1), min(column, width - 1)


@njit(cache=True, error_model="numpy")
def lookup(env: LatLong, d: Triple) -> Triple:
    """Radiance arriving from direction d."""
    i, j = texel_of(env.radiance.shape[0], env.radiance.shape[1], env.rotation, d)
    return float(env.radiance[i, j, 0]), float(env.radiance[i, j, 1]), float(env.radiance[i, j, 2])


@njit(cache=True, error_model="numpy")
def direction_density(env: LatLong, radiance: Triple) -> float:
    """Density (sr^-1) with which `sample` draws a direction whose radiance is the given one."""
    luminance = 0.2126 * abs(radiance[0]) + 0.7152 * abs(radiance[1]) + 0.0722 * abs(radiance[2])
    if luminance <= env.floor * (1.0 + 1e-6):
        return 0.0
    return (luminance - env.floor) * env.density


@njit(cache=True, error_model="numpy")
def _bin_of(cdf: Any, u: float) -> int:
    """The bin k of positive width with cdf[k] <= u < cdf[k + 1]."""
    low, high = 0, len(cdf) - 1  # cdf[low] <= u < cdf[high]
    while high - low > 1:
        middle = (low + high) >> 1
        if cdf[middle] <= u:
            low = middle
        else:
            high = middle
    return low


@njit(cache=True, error_model="numpy")
def sample(env: LatLong, u1: float, u2: float) -> tuple[Triple, Triple, float]:
    """Draw a direction from u1, u2 in [0, 1): (direction, radiance, density in sr^-1). Density 0: nothing."""
    if env.density == 0.0:
        return (0.0, 1.0, 0.0), (0.0, 0.0, 0.0), 0.0
    height, width = env.radiance.shape[0], env.radiance.shape[1]
    i = _bin_of(env.row_cdf, u1)
    columns = env.column_cdf[i]
    j = _bin_of(columns, u2)
    # What is left of u1, u2 inside the bin is uniform again.
    y = (u1 - env.row_cdf[i]) / (env.row_cdf[i + 1] - env.row_cdf[i])
    x = (u2 - columns[j]) / (columns[j + 1] - columns[j])
    top = math.sin(math.pi * (0.5 - i / height))
    bottom = math.sin(math.pi * (0.5 - (i + 1) / height))
    sin_lat = top + y * (bottom - top)
    cos_lat = math.sqrt(max(0.0, 1.0 - sin_lat * sin_lat))
    longitude = math.pi * (1.0 - 2.0 * (j + x) / width) + env.rotation
    radiance = (float(env.radiance[i, j, 0]), float(env.radiance[i, j, 1]), float(env.radiance[i, j, 2]))
    d = (math.sin(longitude) * cos_lat, sin_lat, math.cos(longitude) * cos_lat)
    return d, radiance, direction_density(env, radiance)


def lookup_many(env: LatLong, directions: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Radiance (..., 3) float32 arriving from directions (..., 3)."""
    d = np.ascontiguousarray(directions, np.float64)
    out = np.empty(d.shape, np.float32)
    _lookup_rows(env, d.reshape(-1, 3), out.reshape(-1, 3))
    return out


@njit(cache=True, error_model="numpy")
def _lookup_rows(env: LatLong, d: Any, out: Any) -> None:
    for k in range(len(d)):
        out[k, 0], out[k, 1], out[k, 2] = lookup(env, (d[k, 0], d[k, 1], d[k, 2]))
