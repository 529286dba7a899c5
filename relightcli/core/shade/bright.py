"""The brightest texels of a sky, taken out of it and added one by one, with the exact reflectance and visibility.

Compressed direct light and broad lobes lose the sharp shadows and highlights of a sun. What the COUNT brightest texels
have more than the next one is evaluated point by point instead; what is left of the sky is smooth enough to compress.
Where that is hardly anything, as under clouds, nothing is taken out.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import BLINN_PHONG, COOK_TORRANCE, ROUGHNESS, SHININESS, dot, lobes_and_density
from relightcli.core.lights.environment import SkyCube
from relightcli.core.lights.latlong import LUMINANCE
from relightcli.core.parts import in_parts
from relightcli.core.sphere import cube

COUNT = 24
# Less than this part of the sky's flux is not worth the time.
LEAST = 0.01
# Exponent beyond which a lobe is passed over: it is below 4e-11 of its peak.
NEGLIGIBLE = 24.0


class Bright(NamedTuple):
    """texel (K,) int64: flat index; direction (K, 3): mean direction of its light; flux (K, 3) and moment (K, 3, 3) as
    of `SkyCube`. All float64; K is 0 where no texel stands out."""

    texel: NDArray[np.int64]
    direction: NDArray[np.float64]
    flux: NDArray[np.float64]
    moment: NDArray[np.float64]


def split_bright(sky: SkyCube, count: int = COUNT) -> tuple[SkyCube, Bright]:
    """The sky with its `count` brightest texels cut to the next one's luminance, and what was cut off.

    Both together are the sky. sky: best after `environment.splat`, so that a sun between texels is shared by them.
    """
    area = np.tile(cube.solid_angles(sky.resolution).reshape(-1), 6)
    power = sky.flux @ LUMINANCE
    luminance = power / area
    order = np.argpartition(luminance, -count - 1)[-count - 1 :]
    level = max(float(luminance[order].min()), 0.0)
    texel = np.sort(order[luminance[order] > level])
    share = 1.0 - level / luminance[texel]
    flux, moment = sky.flux[texel] * share[:, None], sky.moment[texel] * share[:, None, None]
    if len(texel) == 0 or float((flux @ LUMINANCE).sum()) < LEAST * float(power.sum()):
        none = np.zeros((0, 3))
        return sky, Bright(np.zeros(0, np.int64), none, none, np.zeros((0, 3, 3)))
    rest = SkyCube(sky.resolution, sky.flux.copy(), sky.moment.copy())
    rest.flux[texel] -= flux
    rest.moment[texel] -= moment
    mean = moment.sum(axis=1)
    return rest, Bright(texel, mean / np.linalg.norm(mean, axis=1, keepdims=True), flux, moment)


def add_irradiance(
    bits: NDArray[np.uint8],
    normals: NDArray[np.float32],
    bright: Bright,
    even: NDArray[np.float32],
    threads: int = 1,
) -> None:
    """Adds to even (N, 3) the texels' irradiance over pi. bits (N, 6, R, R/8); normals (N, 3) float32 unit."""
    words = bits.reshape(len(bits), -1)
    moment = bright.moment / np.pi
    in_parts(
        lambda a, b: _add_irradiance(words[a:b], normals[a:b], bright.texel, moment, even[a:b]), len(bits), threads
    )


def add_highlights(
    bits: NDArray[np.uint8],
    rows: NDArray[np.integer],
    views: NDArray[np.float32],
    normals: NDArray[np.float32],
    bright: Bright,
    model: int,
    parameters: NDArray[np.float64],
    colour: NDArray[np.float32],
    out: NDArray[np.float32],
    threads: int = 1,
) -> None:
    """Adds to out[rows] (N, 3) what the specular lobe of one material sends towards `views` (N, 3).

    rows (M,): receivers that have the material; model, parameters: a row of a `MaterialTable`, widened to texels;
    colour (3,): the specular one. The others as in `add_irradiance`.
    """
    words = bits.reshape(len(bits), -1)
    flux = bright.flux * colour
    if model == COOK_TORRANCE:
        least = 1.0 / (1.0 + NEGLIGIBLE * parameters[ROUGHNESS] ** 2)
    else:
        least = math.exp(-2.0 * NEGLIGIBLE / max(parameters[SHININESS], 1e-3)) if model == BLINN_PHONG else 0.0

    def part(a: int, b: int) -> None:
        _add_highlights(
            words, rows[a:b], views, normals, bright.texel, bright.direction, flux, model, parameters, least, out
        )

    in_parts(part, len(rows), threads)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_irradiance(words, normals, texel, moment, even):  # type: ignore[no-untyped-def]
    for i in range(len(words)):
        x, y, z = np.float64(normals[i, 0]), np.float64(normals[i, 1]), np.float64(normals[i, 2])
        for k in range(len(texel)):
            t = texel[k]
            if (words[i, t >> 3] >> np.uint8(t & 7)) & np.uint8(1):
                for c in range(3):
                    even[i, c] += max(x * moment[k, c, 0] + y * moment[k, c, 1] + z * moment[k, c, 2], 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_highlights(words, rows, views, normals, texel, direction, flux, model, parameters, least, out):  # type: ignore[no-untyped-def]
    for i in rows:
        n = (np.float64(normals[i, 0]), np.float64(normals[i, 1]), np.float64(normals[i, 2]))
        v = (np.float64(views[i, 0]), np.float64(views[i, 1]), np.float64(views[i, 2]))
        nv = dot(n, v)
        if not nv > 0.0:
            continue
        red = green = blue = 0.0
        for k in range(len(texel)):
            t = texel[k]
            if not (words[i, t >> 3] >> np.uint8(t & 7)) & np.uint8(1):
                continue
            l = (direction[k, 0], direction[k, 1], direction[k, 2])  # noqa: E741
            nl = dot(n, l)
            # (n.h)^2 = (n.l + n.v)^2 / |l + v|^2
            if nl > 0.0 and (nl + nv) * (nl + nv) >= least * 2.0 * (1.0 + dot(l, v)):
                _, s, _, _ = lobes_and_density(model, parameters, n, l, v)
                red += s * flux[k, 0]
                green += s * flux[k, 1]
                blue += s * flux[k, 2]
        out[i, 0] += red
        out[i, 1] += green
        out[i, 2] += blue
