"""What one entity does to light around it, in its own frame: occlusion, transfer, source fields. [Pan 2007, section 3]

Fields are sampled on concentric spheres about the entity's bounding sphere. Sample (shell s, direction d) lies at
center + radii[s] * direction d; the directions are the texel centres of a cube map of `resolution` n, in the flat order
of `core.sphere.cube`: (face n + row) n + column. Directions in all spherical functions point away from the sample or
surface point, towards what is seen; N = order^2 coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

GEOMETRIC_RANGE = (1.02, 8.0)  # shells in bounding radii: none inside a round body
PAPER_RANGE = (0.1, 8.0)  # [Pan 2007, section 6]


@dataclass(frozen=True)
class Field:
    """Occlusion and radiance transfer of one object.

    center (3,) float64, radius: bounding sphere (the paper's eta); radii (S,) float64, rising distances from `center`
    resolution n: 6 n n samples per shell
    valid (S, 6nn) bool: False where the sample lies inside the object: its values are no use to interpolation
    proxies (m, 3) float64: where the light that falls on the object is taken
    occlusion (S, 6nn, N) float32: integral of V y_i, V = 1 where a ray from the sample passes the object
    transfer (S, 6nn, m, N, N, C) float32: coefficient i (the fourth axis) of the object's radiance as the sample sees
        it per coefficient j (the fifth) of the light at proxy k; C = 1 if every colour is reflected alike, else 3
    """

    center: NDArray[np.float64]
    radius: float
    radii: NDArray[np.float64]
    resolution: int
    valid: NDArray[np.bool_]
    proxies: NDArray[np.float64]
    occlusion: NDArray[np.float32]
    transfer: NDArray[np.float32]


@dataclass(frozen=True)
class SelfTransfer:
    """What light arrives at an object's vertices per light at its proxies, shadows and its own reflections included.

    transfer (P, m, N, N, C) float32: coefficient i of what vertex p receives, in the object's frame, per coefficient j
    of the light at proxy k, the proxies' weights included: the sum over k is the transfer of even light. Directions
    below the vertex's horizon count as open: a cosine cuts them off later (see `self_transfer`).
    """

    transfer: NDArray[np.float32]


@dataclass(frozen=True)
class SourceField:
    """A local light as it is seen from the samples. radii (S,) float64; radiance (S, 6nn, N, 3) float32, of y_i."""

    center: NDArray[np.float64]
    radius: float
    radii: NDArray[np.float64]
    resolution: int
    radiance: NDArray[np.float32]


def shell_radii(radius: float, count: int, spacing: str = "geometric") -> NDArray[np.float64]:
    """Radii (count,) of the shells around a bounding sphere: `geometric`, 1.02 to 8 times its radius in equal ratios,
    or `paper`, 0.1 to 8 times in equal steps, of which some lie inside the object."""
    if spacing == "paper":
        return radius * np.linspace(*PAPER_RANGE, count)
    return radius * np.geomspace(*GEOMETRIC_RANGE, count)
