"""A daylight environment: analytic clear sky with its sun, or the CIE overcast sky, over a uniform ground.

Sources: [Preetham1999] Preetham, Shirley, Smits: A Practical Analytic Model for Daylight, SIGGRAPH 1999, section 3 and
appendix A.2. [Perez1993] Perez, Seals, Michalsky: All-weather model for sky luminance distribution, Solar Energy 50(3),
1993, Eq. 1. [Moon1942] Moon, Spencer: Illumination from a non-uniform sky, 1942 (the CIE overcast sky).
[Krochmann1974] Krochmann, Seidl: Quantitative data on daylight for illuminating engineering, 1974.

Known limits of [Preetham1999]: below turbidity 2 its luminance is no longer plausible (Zotti, Wilkie, Purgathofer: A
critical review of the Preetham skylight model, 2007), and it says nothing of a sun below the horizon. Both are refused.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from relightcli.core.lights.latlong import texel_solid_angles
from relightcli.core.lights.sun import ANGULAR_RADIUS, SOLID_ANGLE, XYZ_TO_RGB, sun_radiance
from relightcli.errors import InputError

UNIT = 10.0  # kcd m^-2 per unit of the map: a white card in the midday sun comes out near 3
TURBIDITY_RANGE = (2.0, 10.0)
GROUND_ALBEDO = (0.20, 0.18, 0.15)

# [Preetham1999, A.2]: distribution coefficients A to E (rows) as slope and offset in T, for Y, x, y.
_COEFFICIENTS: dict[str, NDArray[np.float64]] = {
    "Y": np.array([[0.1787, -1.4630], [-0.3554, 0.4275], [-0.0227, 5.3251], [0.1206, -2.5771], [-0.0670, 0.3703]]),
    "x": np.array([[-0.0193, -0.2592], [-0.0665, 0.0008], [-0.0004, 0.2125], [-0.0641, -0.8989], [-0.0033, 0.0452]]),
    "y": np.array([[-0.0167, -0.2608], [-0.0950, 0.0092], [-0.0079, 0.2102], [-0.0441, -1.6537], [-0.0109, 0.0529]]),
}
# [Preetham1999, A.2]: zenith chromaticity = (T^2, T, 1) M (theta_s^3, theta_s^2, theta_s, 1).
_ZENITH_X: NDArray[np.float64] = np.array(
    [[0.00166, -0.00375, 0.00209, 0.0], [-0.02903, 0.06377, -0.03202, 0.00394], [0.11693, -0.21196, 0.06052, 0.25886]]
)
_ZENITH_Y: NDArray[np.float64] = np.array(
    [[0.00275, -0.00610, 0.00317, 0.0], [-0.04214, 0.08970, -0.04153, 0.00516], [0.15346, -0.26756, 0.06670, 0.26688]]
)


def sky_latlong(
    sun_elevation_deg: float,
    sun_azimuth_deg: float = 0.0,
    turbidity: float = 3.0,
    size: tuple[int, int] = (256, 512),
    overcast: bool = False,
    ground: tuple[float, float, float] = GROUND_ALBEDO,
) -> NDArray[np.float32]:
    """A latitude-longitude map of daylight, row 0 at the zenith (+Y).

    Clear: [Preetham1999] sky plus the sun, a uniform disc of 0.53 degrees spread over the texels that it covers so that
    its irradiance does not depend on `size`; what the horizon cuts off is left out. Overcast: the CIE overcast sky,
    grey, with the horizontal illuminance of [Krochmann1974], and no sun. Ground: radiance albedo E / pi, where E is
    what the upper half of this very map gives a horizontal surface.

    sun_elevation_deg above the horizon, 0..90; sun_azimuth_deg: longitude of the sun, degrees, 0 at +Z and 90 at +X;
    turbidity T, 2 (clear) to 10 (haze), unused when overcast; size (H, W); ground: albedo per colour, 0..1.
    Returns (H, W, 3) float32, finite, >= 0, linear Rec.709, in units of 10 kcd m^-2.
    Raises InputError for values outside these ranges.
    """
    _check(sun_elevation_deg, sun_azimuth_deg, turbidity, size, ground)
    height, width = size
    elevation, azimuth = math.radians(sun_elevation_deg), math.radians(sun_azimuth_deg)
    edges = math.pi * (0.5 - np.arange(height + 1) / height)  # latitudes of the rows' upper and lower borders
    latitude = 0.5 * (edges[:-1] + edges[1:])
    longitude = math.pi * (1 - 2 * (np.arange(width) + 0.5) / width)
    texel = texel_solid_angles(height, width)
    # The share of each row above the horizon: with an odd height the middle row has both.
    above = np.clip(edges[:-1], 0, None) - np.clip(edges[1:], 0, None)
    above /= edges[:-1] - edges[1:]

    sine = np.maximum(np.sin(latitude), 0)[:, None]
    if overcast:
        # E = 0.3 + 21 sin h klx [Krochmann1974], and the CIE overcast sky gives E = 7 pi / 9 times its zenith.
        zenith = (0.3 + 21 * math.sin(elevation)) * 9 / (7 * math.pi)
        radiance = np.broadcast_to(overcast_luminance(sine, zenith)[..., None], (height, width, 3)).copy()
    else:
        # Half angles, from which small ones come out as exact as large ones.
        apart = np.sin(0.5 * (latitude - elevation))[:, None] ** 2
        around = (np.maximum(np.cos(latitude), 0) * math.cos(elevation))[:, None] * np.sin(
            0.5 * (longitude - azimuth)
        ) ** 2
        gamma = 2 * np.arcsin(np.sqrt(np.minimum(apart + around, 1)))
        radiance = clear_sky(np.broadcast_to(sine, gamma.shape), gamma, elevation, turbidity)
    radiance *= above[:, None, None]
    if not overcast:
        share = sun_shares(elevation, azimuth, size)
        sun = sun_radiance(elevation, turbidity) * SOLID_ANGLE
        radiance += (share / texel[:, None])[..., None] * sun

    # Integral of sin(latitude) over each texel's part above the horizon.
    top, bottom = np.clip(edges[:-1], 0, None), np.clip(edges[1:], 0, None)
    # (sin^2 top - sin^2 bottom) / 2 as a product, which loses nothing next to the zenith.
    cosine_weight = (math.pi / width) * np.sin(top + bottom) * np.sin(top - bottom)
    upper = np.divide(cosine_weight, above, out=np.zeros(height), where=above > 0)
    irradiance = np.einsum("h,hwc->c", upper, radiance)
    radiance += (1 - above)[:, None, None] * (np.asarray(ground) * irradiance / math.pi)
    return (radiance / UNIT).astype(np.float32)


def perez(cos_theta: NDArray[np.float64], gamma: NDArray[np.float64], c: NDArray[np.float64]) -> NDArray[np.float64]:
    """F(theta, gamma) = (1 + A e^(B / cos theta)) (1 + C e^(D gamma) + E cos^2 gamma) [Perez1993, Eq. 1].

    cos_theta: cosine of the zenith angle, 0..1, and gamma: angle to the sun, radians, of one shape; c = (A, B, C, D, E)
    with B < 0. Returns float64 of that shape, relative to nothing in particular.
    """
    horizon = np.exp(c[1] / np.maximum(cos_theta, 1e-6))
    result: NDArray[np.float64] = (1 + c[0] * horizon) * (1 + c[2] * np.exp(c[3] * gamma) + c[4] * np.cos(gamma) ** 2)
    return result


def zenith_luminance(elevation: float, turbidity: float) -> float:
    """Y_z = (4.0453 T - 4.9710) tan chi - 0.2155 T + 2.4192 in kcd m^-2, chi = (4/9 - T/120)(pi - 2 theta_s).

    elevation of the sun, radians; turbidity T. Source: [Preetham1999, A.2].
    """
    chi = (4 / 9 - turbidity / 120) * 2 * elevation
    return (4.0453 * turbidity - 4.9710) * math.tan(chi) - 0.2155 * turbidity + 2.4192


def clear_sky(
    cos_theta: NDArray[np.float64], gamma: NDArray[np.float64], elevation: float, turbidity: float
) -> NDArray[np.float64]:
    """Sky radiance without the sun's disc.

    Y, x and y each = their value at the zenith times F(theta, gamma) / F(0, theta_s) [Preetham1999, Eq. 4].

    cos_theta, gamma (...): cosine of the zenith angle and angle to the sun; elevation of the sun, radians.
    Returns (..., 3) float64 linear Rec.709, >= 0 (colours outside the gamut are clipped), kcd m^-2.
    """
    theta_s = math.pi / 2 - elevation
    powers = np.array([theta_s**3, theta_s**2, theta_s, 1])
    haze = np.array([turbidity**2, turbidity, 1])
    zenith = {
        "Y": zenith_luminance(elevation, turbidity),
        "x": float(haze @ _ZENITH_X @ powers),
        "y": float(haze @ _ZENITH_Y @ powers),
    }
    value = {}
    for key, lines in _COEFFICIENTS.items():
        c = lines @ np.array([turbidity, 1])
        at_zenith = perez(np.array(1.0), np.array(theta_s), c)
        value[key] = zenith[key] * perez(cos_theta, gamma, c) / at_zenith
    x, y, luminance = value["x"], value["y"], value["Y"]
    xyz = np.stack([x / y * luminance, luminance, (1 - x - y) / y * luminance], axis=-1)
    return np.maximum(xyz @ XYZ_TO_RGB.T, 0)


def overcast_luminance(sine: NDArray[np.float64], zenith: float) -> NDArray[np.float64]:
    """L = L_z (1 + 2 sin a) / 3 at elevation a, the CIE overcast sky [Moon1942]. sine = sin a, 0..1; zenith L_z."""
    return zenith * (1 + 2 * sine) / 3


def sun_shares(elevation: float, azimuth: float, size: tuple[int, int]) -> NDArray[np.float64]:
    """What share of the sun's disc lies in each texel: (H, W) float64, summing to the share above the horizon.

    Points of equal solid angle fill the disc, several per texel that it covers, and each falls into one texel.
    """
    height, width = size
    per_side = max(64, math.ceil(8 * 2 * ANGULAR_RADIUS / (math.pi / height)))
    # Equal areas on the cap: uniform in 1 - cos(angle) and in the turn about the axis.
    ring, turn = np.meshgrid((np.arange(per_side) + 0.5) / per_side, (np.arange(per_side) + 0.5) / per_side)
    angle = 2 * np.arcsin(np.sqrt(ring) * math.sin(ANGULAR_RADIUS / 2))
    phi = 2 * math.pi * turn
    # The axis at the sun, then tilted up to its elevation and turned to its longitude.
    side, up, ahead = np.sin(angle) * np.cos(phi), np.sin(angle) * np.sin(phi), np.cos(angle)
    y = up * math.cos(elevation) + ahead * math.sin(elevation)
    forward = ahead * math.cos(elevation) - up * math.sin(elevation)
    longitude = azimuth + np.arctan2(side, forward)
    column = np.floor((0.5 - longitude / (2 * math.pi)) % 1 * width).astype(np.int64) % width
    row = np.clip(np.floor((0.5 - np.arcsin(np.clip(y, -1, 1)) / math.pi) * height), 0, height - 1).astype(np.int64)
    visible = y > 0
    shares = np.zeros(size)
    np.add.at(shares, (row[visible], column[visible]), 1 / per_side**2)
    return shares


def _check(
    elevation: float, azimuth: float, turbidity: float, size: tuple[int, int], ground: tuple[float, float, float]
) -> None:
    low, high = TURBIDITY_RANGE
    if not 0 <= elevation <= 90:
        raise InputError(f"sun elevation is {elevation:g} degrees; expected 0 to 90 (the model has no night).")
    if not math.isfinite(azimuth):
        raise InputError(f"sun azimuth is {azimuth:g} degrees; expected a finite number.")
    if not low <= turbidity <= high:
        raise InputError(f"turbidity is {turbidity:g}; expected {low:g} (clear) to {high:g} (haze).")
    if len(size) != 2 or min(size) < 1:
        raise InputError(f"sky size is {size}; expected height and width of at least 1.")
    if not all(0 <= albedo <= 1 for albedo in ground):
        raise InputError(f"ground albedo is {ground}; expected three values from 0 to 1.")
