"""Direct sunlight after its way through the atmosphere.

Sources: [Preetham1999] Preetham, Shirley, Smits: A Practical Analytic Model for Daylight, SIGGRAPH 1999, appendix A.1
and Table 2. [Wyman2013] Wyman, Sloan, Shirley: Simple Analytic Approximations to the CIE XYZ Color Matching Functions,
JCGT 2(2), 2013, Eq. 4. [IEC61966] IEC 61966-2-1:1999, for XYZ to linear sRGB.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

ANGULAR_RADIUS = math.radians(0.53 / 2)  # of the sun's disc as seen from the earth
SOLID_ANGLE = 4 * math.pi * math.sin(ANGULAR_RADIUS / 2) ** 2  # 2 pi (1 - cos r), without its cancellation

XYZ_TO_RGB: NDArray[np.float64] = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)

# [Preetham1999, Table 2] at 380, 390, ... 750 nm: sun radiance outside the atmosphere (W m^-2 nm^-1 sr^-1), absorption
# of ozone (cm^-1) and of water vapour. The mixed gases absorb from 760 nm on only, outside the range summed here.
_WAVELENGTHS: NDArray[np.float64] = np.arange(380.0, 751.0, 10.0)
# fmt: off
_EXTRATERRESTRIAL: NDArray[np.float64] = np.array([
    16559.0, 16233.7, 21127.5, 25888.2, 25829.1, 24232.3, 26760.5, 29658.3, 30545.4, 30057.5, 30663.7, 28830.4, 28712.1,
    27825.0, 27100.6, 27233.6, 26361.3, 25503.8, 25060.2, 25311.6, 25355.9, 25134.2, 24631.5, 24173.2, 23685.3, 23212.1,
    22827.7, 22339.8, 21970.2, 21526.7, 21097.9, 20728.3, 20240.4, 19870.8, 19427.2, 19072.4, 18628.9, 18259.2,
])
_OZONE: NDArray[np.float64] = np.array([
    0, 0, 0, 0, 0, 0, 0, 0.003, 0.006, 0.009, 0.014, 0.021, 0.030, 0.040, 0.048, 0.063, 0.075, 0.085, 0.103,
    0.120, 0.120, 0.115, 0.125, 0.120, 0.105, 0.090, 0.079, 0.067,
    0.057, 0.048, 0.036, 0.028, 0.023, 0.018, 0.014, 0.011, 0.010, 0.009,
])
_WATER: NDArray[np.float64] = np.array([
    0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
    0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.016, 0.024, 0.0125, 1.0, 0.87, 0.061, 0.001,
])
# fmt: on


def sun_radiance(elevation: float, turbidity: float) -> NDArray[np.float64]:
    """Mean radiance of the sun's disc at the ground.

    L(lambda) = L0 tau_R tau_A tau_O tau_W [Preetham1999, A.1], weighted with the colour matching functions.

    elevation of the sun, radians, 0..pi/2; turbidity T, 2..10.
    Returns (3,) float64, linear Rec.709, >= 0, in kcd m^-2: its luminance is 0.2126 R + 0.7152 G + 0.0722 B.
    """
    micrometres = _WAVELENGTHS / 1000
    beta = 0.04608365822050 * turbidity - 0.04586025928522  # Angstrom's turbidity coefficient
    # Relative optical mass, with the zenith angle in degrees.
    mass = 1 / (math.sin(elevation) + 0.15 * (93.885 - (90 - math.degrees(elevation))) ** -1.253)
    rayleigh = np.exp(-mass * 0.008735 * micrometres**-4.08)
    aerosol = np.exp(-mass * beta * micrometres**-1.3)
    ozone = np.exp(-mass * _OZONE * 0.35)  # 0.35 cm of ozone
    wet = 2.0 * _WATER * mass  # 2 cm of precipitable water
    water = np.exp(-0.2385 * wet / (1 + 20.07 * wet) ** 0.45)
    radiance = _EXTRATERRESTRIAL * rayleigh * aerosol * ozone * water
    xyz = 683 * 10.0 * (_colour_matching(_WAVELENGTHS).T @ radiance)  # lm/W, and the spacing in nm
    return np.maximum(XYZ_TO_RGB @ xyz / 1000, 0)


def _colour_matching(wavelengths: NDArray[np.float64]) -> NDArray[np.float64]:
    """CIE 1931 x, y, z of wavelengths (N,) in nm as sums of skewed Gaussians, (N, 3) [Wyman2013, Eq. 4]."""

    def lobe(weight: float, mean: float, below: float, above: float) -> NDArray[np.float64]:
        width = np.where(wavelengths < mean, below, above)
        return weight * np.exp(-0.5 * ((wavelengths - mean) / width) ** 2)

    x = lobe(1.056, 599.8, 37.9, 31.0) + lobe(0.362, 442.0, 16.0, 26.7) + lobe(-0.065, 501.1, 20.4, 26.2)
    y = lobe(0.821, 568.8, 46.9, 40.5) + lobe(0.286, 530.9, 16.3, 31.1)
    z = lobe(1.217, 437.0, 11.8, 36.0) + lobe(0.681, 459.0, 26.0, 13.8)
    return np.stack([x, y, z], axis=1)
