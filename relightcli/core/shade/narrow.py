"""Lobes narrower than a texel: a fixed set of directions looks up the map, and the brightest pixels are added by hand.

The directions are distributed as the lobe; each counts the map's pixel there if the visibility texel that holds it is
open. A sun that falls between them would be lost: so what the brightest pixels have more than the rest is left out of
the map and evaluated point by point.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import SPECULAR, dot, lobes_and_density
from relightcli.core.brdf.sampling import sample_direction
from relightcli.core.lights.latlong import LUMINANCE, texel_of, texel_solid_angles
from relightcli.core.sphere.lattice import r2_point

SAMPLES = 256  # directions
SUNS = 64  # brightest pixels that are added by themselves
SUN_POINTS = 4  # points along a side of each


def suns(
    radiance: NDArray[np.float32], rotation: float
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
    """The map with its SUNS brightest pixels cut to the next one's luminance; points on them, and the flux cut off."""
    height, width = radiance.shape[:2]
    luminance = (radiance @ LUMINANCE.astype(np.float32)).reshape(-1)
    if luminance.size <= SUNS:
        return radiance, np.zeros((0, 3)), np.zeros((0, 3))
    brightest = np.argpartition(luminance, -SUNS - 1)[-SUNS - 1 :]
    level = luminance[brightest].min()
    brightest = np.sort(brightest[luminance[brightest] > level])
    share = (level / luminance[brightest]).astype(np.float32)[:, None]
    clamped = radiance.reshape(-1, 3).copy()
    excess = clamped[brightest] * (1.0 - share).astype(np.float64)
    clamped[brightest] *= share

    row, column = brightest // width, brightest % width
    place = (np.arange(SUN_POINTS) + 0.5) / SUN_POINTS
    longitude = math.pi * (1.0 - 2.0 * (column[:, None] + place) / width) + rotation
    top, bottom = np.cos(math.pi * row / height), np.cos(math.pi * (row + 1) / height)
    s = bottom[:, None] + (top - bottom)[:, None] * place  # equal solid angles
    s, longitude = np.broadcast_arrays(s[:, :, None], longitude[:, None, :])
    c = np.sqrt(np.maximum(0.0, 1.0 - s * s))
    direction = np.stack([np.sin(longitude) * c, s, np.cos(longitude) * c], axis=-1).reshape(-1, 3)
    solid_angle = texel_solid_angles(height, width)[row] / SUN_POINTS**2
    flux = np.repeat(excess * solid_angle[:, None], SUN_POINTS**2, axis=0)
    return clamped.reshape(radiance.shape), np.ascontiguousarray(direction), flux


@njit(cache=True, nogil=True, error_model="numpy")
def cube_texel(x, y, z, resolution):  # type: ignore[no-untyped-def]
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face = 0 if x > 0 else 1
        s, t, w = (-z if x > 0 else z), -y, ax
    elif ay >= az:
        face = 2 if y > 0 else 3
        s, t, w = x, (z if y > 0 else -z), ay
    else:
        face = 4 if z > 0 else 5
        s, t, w = (x if z > 0 else -x), -y, az
    column = min(resolution - 1, int((s / w + 1.0) * 0.5 * resolution))
    row = min(resolution - 1, int((t / w + 1.0) * 0.5 * resolution))
    return face, row, column


@njit(cache=True, nogil=True, error_model="numpy")
def sample_lobe(bits, i, n, v, model, row, resolution, radiance, rotation, out, m):  # type: ignore[no-untyped-def]
    black = (0.0, 0.0, 0.0)
    # A white specular colour: the sampler picks the specular lobe, whatever its colour is.
    white = row.copy()
    white[SPECULAR : SPECULAR + 3] = 1.0
    red = green = blue = 0.0
    for q in range(SAMPLES):
        u1, u2 = r2_point(q)
        l, usable = sample_direction(model, white, black, n, v, u1, u2)  # noqa: E741
        if not usable:
            continue
        face, r, c = cube_texel(l[0], l[1], l[2], resolution)
        if not (bits[i, face, r, c >> 3] >> np.uint8(c & 7)) & np.uint8(1):
            continue
        _, s, _, density = lobes_and_density(model, row, n, l, v)
        if not density > 0.0:
            continue
        y, x = texel_of(radiance.shape[0], radiance.shape[1], rotation, l)
        weight = s / density
        red += weight * radiance[y, x, 0]
        green += weight * radiance[y, x, 1]
        blue += weight * radiance[y, x, 2]
    out[m, 0] = red / SAMPLES
    out[m, 1] = green / SAMPLES
    out[m, 2] = blue / SAMPLES


@njit(cache=True, nogil=True, error_model="numpy")
def add_suns(bits, i, n, v, model, row, resolution, direction, flux, out, m):  # type: ignore[no-untyped-def]
    red = green = blue = 0.0
    for q in range(len(direction)):
        l = (direction[q, 0], direction[q, 1], direction[q, 2])  # noqa: E741
        if not dot(n, l) > 0.0:
            continue
        face, r, c = cube_texel(l[0], l[1], l[2], resolution)
        if not (bits[i, face, r, c >> 3] >> np.uint8(c & 7)) & np.uint8(1):
            continue
        _, s, _, _ = lobes_and_density(model, row, n, l, v)
        red += s * flux[q, 0]
        green += s * flux[q, 1]
        blue += s * flux[q, 2]
    out[m, 0] += red
    out[m, 1] += green
    out[m, 2] += blue
