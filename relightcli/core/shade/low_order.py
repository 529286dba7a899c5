"""Surfaces under light of a few spherical harmonic bands: their diffuse and specular exit radiance. [Sun 2007, Eq. 4]

For an isotropic lobe s(l, v) = sum_m cos(m (phi_l - phi_v)) S_m(theta_v, theta_l) and light sum a_lm y_lm in the
surface's frame,

    exit = sum over l, m >= 0 of F_lm(theta_v) (a_l,m cos m phi_v + a_l,-m sin m phi_v)
    F_lm(theta_v) = (2 pi or, m > 0, pi) int S_m(theta_v, theta) y_lm(theta, 0) sin theta dtheta,

which is exact for any BRDF: the light's bands are all that is cut. Lobes narrower than LEAST are taken that wide; the
light's own detail is some 45 degrees.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import COOK_TORRANCE, F0, ROUGHNESS, SHININESS, pack_materials
from relightcli.core.brdf.separable import POLAR, harmonics
from relightcli.core.brdf.transport_basis import white, widths
from relightcli.core.parts import in_parts
from relightcli.core.shade.lobe_factors import axes_of
from relightcli.core.sphere import sh

LEAST = 0.08  # radians in directions of light
NODES = 40


class Responses(NamedTuple):
    """Responses of one model: node (H,), logarithms of width; table (H, 2, POLAR, B) float64 for f0 = 0 and 1; B counts
    (l, m >= 0), l slowest. The first is reflectance times y_00 under even light."""

    node: NDArray[np.float64]
    table: NDArray[np.float64]


@lru_cache(maxsize=8)
def responses(model: int, order: int) -> Responses:
    """F_lm of the lobes of a model code over their range."""
    nodes = widths(model, LEAST, NODES)
    packed = pack_materials([white(model, width, f0) for width in nodes for f0 in (0.0, 1.0)])
    spectra, _, _ = harmonics(model, packed.parameters)
    p = (np.arange(POLAR) + 0.5) / POLAR
    z = 1.0 - p * p
    values = sh.harmonics(np.stack([np.sqrt(1.0 - z * z), np.zeros(POLAR), z], -1), order)
    columns = []
    for band in range(order):
        for m in range(band + 1):
            weight = values[:, band * (band + 1) + m] * (2.0 * p / POLAR) * (math.pi if m else 2.0 * math.pi)
            columns.append(spectra[:, m] @ weight)
    return Responses(np.log(nodes), np.stack(columns, -1).reshape(len(nodes), 2, POLAR, -1))


def response(model: int, row: NDArray[np.float64], order: int) -> NDArray[np.float32]:
    """F_lm (POLAR, B) of a parameter row, without its colour."""
    found = responses(model, order)
    width = row[ROUGHNESS] if model == COOK_TORRANCE else row[SHININESS]
    at = float(np.interp(math.log(max(width, 1e-300)), found.node, np.arange(len(found.node))))
    k = min(int(at), len(found.node) - 2)
    ends = (1.0 - (at - k)) * found.table[k] + (at - k) * found.table[k + 1]
    f0 = row[F0] if model == COOK_TORRANCE else 0.0
    return ((1.0 - f0) * ends[0] + f0 * ends[1]).astype(np.float32)


def shade_low_order(
    rows: NDArray[np.int64],
    light: NDArray[np.float32],
    uniform: NDArray[np.float32],
    normals: NDArray[np.float32],
    view: NDArray[np.float32],
    table: NDArray[np.float32],
    colour: NDArray[np.float32],
    material: NDArray[np.int32],
    threads: int = 1,
    rotation: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Specular exit radiance (2, n, 3) float32 towards view (n, 3): of light (n, 3, order^2) in the receivers' frames,
    and of light that is the same from everywhere, uniform (n, 3). Of the receivers `rows` alone; of others 0.

    normals (n, 3); table (M, POLAR, B) from `response`; colour (M, 3), the specular colour; material (n,). rotation
    (n, sum of (2 l + 1)^2), if given, takes the light into the frames: band after band, of each matrix column after
    column. The response goes back through it, which is a third of the work.
    """
    out = np.zeros((2, len(light), 3), np.float32)
    order = math.isqrt(light.shape[2])
    turn = np.zeros((0, 0), np.float32) if rotation is None else rotation

    def part(a: int, b: int) -> None:
        _shade(rows[a:b], light, uniform, normals, view, table, colour, material, order, turn, out)

    in_parts(part, len(rows), threads)
    return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _shade(rows, light, uniform, normals, view, table, colour, material, order, turn, out):  # type: ignore[no-untyped-def]
    c, s = np.empty(order, np.float32), np.empty(order, np.float32)
    response, turned = np.empty(order * order, np.float32), np.empty(order * order, np.float32)
    even = np.float32(math.sqrt(4.0 * math.pi))
    for i in rows:
        axes = axes_of((np.float64(normals[i, 0]), np.float64(normals[i, 1]), np.float64(normals[i, 2])))
        x = y = z = 0.0
        for k in range(3):
            x += axes[0][k] * view[i, k]
            y += axes[1][k] * view[i, k]
            z += axes[2][k] * view[i, k]
        if not z > 0.0:
            continue
        length = math.sqrt(x * x + y * y)
        scale = 1.0 / length if length > 0.0 else 0.0
        c1, s1 = np.float32(x * scale), np.float32(y * scale)
        c[0], s[0] = np.float32(1.0), np.float32(0.0)
        for m in range(1, order):
            c[m] = c[m - 1] * c1 - s[m - 1] * s1
            s[m] = c[m - 1] * s1 + s[m - 1] * c1
        place = min(max(math.sqrt(max(0.0, 1.0 - z)) * POLAR - 0.5, 0.0), POLAR - 1.001)
        g = int(place)
        f = np.float32(place - g)
        low, high = table[material[i], g], table[material[i], g + 1]
        k = 0
        for band in range(order):
            middle = band * (band + 1)
            for m in range(band + 1):
                w = low[k] + f * (high[k] - low[k])
                k += 1
                response[middle + m] = w * c[m]
                if m:
                    response[middle - m] = w * s[m]
        if len(turn):
            at = 0
            for band in range(order):
                first, n = band * band, 2 * band + 1
                for k in range(n):
                    total = np.float32(0.0)
                    for j in range(n):
                        total += turn[i, at + k * n + j] * response[first + j]
                    turned[first + k] = total
                at += n * n
        else:
            turned[:] = response
        r = gr = b = np.float32(0.0)
        for k in range(order * order):
            r += turned[k] * light[i, 0, k]
            gr += turned[k] * light[i, 1, k]
            b += turned[k] * light[i, 2, k]
        m = material[i]
        out[0, i, 0], out[0, i, 1], out[0, i, 2] = r * colour[m, 0], gr * colour[m, 1], b * colour[m, 2]
        w = even * (low[0] + f * (high[0] - low[0]))
        for k in range(3):
            out[1, i, k] = w * uniform[i, k] * colour[m, k]
