"""The environment behind the scene, through every pixel of a camera: the mean over the pixel, by a box filter.

A pixel whose four corners look into one texel shows that texel; any other one is the mean of FINE x FINE points, so
that a border between two texels is off by at most their difference over 2 FINE.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.lights.latlong import LatLong, lookup, texel_of
from relightcli.core.transport.camera import Film, film_direction

FINE = 4


def backdrop(environment: LatLong, film: Film, threads: int = 1) -> NDArray[np.float32]:
    """Radiance (H, W, 3) of the environment seen through the film's pixels."""
    out = np.empty((film.height, film.width, 3), np.float32)
    cuts = np.linspace(0, film.height, max(1, threads) + 1).astype(int)
    with ThreadPoolExecutor(max(1, threads)) as pool:
        list(pool.map(lambda a, b: _rows(environment, film, a, b, out), cuts[:-1], cuts[1:]))
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _rows(environment, film, first, last, out):  # type: ignore[no-untyped-def]
    height, width = environment.radiance.shape[0], environment.radiance.shape[1]
    for y in range(first, last):
        for x in range(film.width):
            one = texel_of(height, width, environment.rotation, film_direction(film, float(x), float(y)))
            alike = True
            for k in range(1, 4):
                corner = film_direction(film, float(x + k % 2), float(y + k // 2))
                alike = alike and texel_of(height, width, environment.rotation, corner) == one
            n = 1 if alike else FINE
            r = g = b = 0.0
            for i in range(n):
                for j in range(n):
                    seen = lookup(environment, film_direction(film, x + (j + 0.5) / n, y + (i + 0.5) / n))
                    r, g, b = r + seen[0], g + seen[1], b + seen[2]
            out[y, x, 0], out[y, x, 1], out[y, x, 2] = r / (n * n), g / (n * n), b / (n * n)
