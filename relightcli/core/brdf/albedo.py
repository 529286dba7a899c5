"""Directional albedo of the models' specular part, and of Gaussian lobes at the horizon."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import lobes_and_density, pack_materials
from relightcli.core.brdf.sampling import sample_direction
from relightcli.core.brdf.specular_lobes import gaussian_samples

_RINGS, _AZIMUTHS = 64, 32
# At the horizon itself no model is defined.
_LEAST_COSINE = 1e-3


def directional_albedo(
    family: str, parameters: NDArray[np.float64], cosine: NDArray[np.float64]
) -> NDArray[np.float64]:
    """A = integral of f cos(theta_i) dw_i for specular colour 1: (H, P) of parameters (H, d) and cos(theta_o) (P,).

    family: "blinn-phong", parameters being exponents, or "cook-torrance", f0 and roughness. By 2048 stratified samples
    of the lobe: within 1e-2 of it for roughness to 1, and closer for narrower lobes. A cosine of 0 is taken for 1e-3.
    """
    materials = [_white(family, row) for row in parameters]
    table = pack_materials(materials)
    out = np.empty((len(parameters), len(cosine)))
    _albedo(table.model, table.parameters, np.maximum(cosine, _LEAST_COSINE), out)
    return out


def _white(family: str, row: NDArray[np.float64]) -> SimpleNamespace:
    named = dict(zip(("shininess",) if family == "blinn-phong" else ("f0", "roughness"), row, strict=True))
    black = (0.0, 0.0, 0.0)
    defaults = {"f0": 1.0, "roughness": 1.0, "shininess": 1.0}
    return SimpleNamespace(
        model=family, diffuse=black, specular=(1.0, 1.0, 1.0), transmittance=black, **(defaults | named)
    )


def lobe_share(degrees: float, cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    """Part of the lobe G about a mirror direction at cos(theta) (P,) that is above the horizon: (P,)."""
    if degrees == 0.0:
        return np.ones(len(cosine))
    local, weight = gaussian_samples(degrees)
    sine = np.sqrt(1.0 - cosine**2)
    height = local[:, 2] * cosine[:, None] + local[:, 0] * sine[:, None]
    return (height > 0.0) @ weight


@njit(cache=True, nogil=True, error_model="numpy")
def _albedo(model: Any, parameters: Any, cosine: Any, out: Any) -> None:
    n, black = (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
    for h in range(len(model)):
        for p in range(len(cosine)):
            v = (math.sqrt(max(0.0, 1.0 - cosine[p] * cosine[p])), 0.0, cosine[p])
            total = 0.0
            for a in range(_RINGS):
                for b in range(_AZIMUTHS):
                    turn = (b + 0.6180339887498949 * a) / _AZIMUTHS
                    u1, u2 = (a + 0.5) / _RINGS, turn - math.floor(turn)
                    l, above = sample_direction(model[h], parameters[h], black, n, v, u1, u2)  # noqa: E741
                    if above:
                        _, s, _, q = lobes_and_density(model[h], parameters[h], n, l, v)
                        if q > 0.0:
                            total += s / q
            out[h, p] = total / (_RINGS * _AZIMUTHS)
