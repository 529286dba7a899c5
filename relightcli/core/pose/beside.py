"""Posed vertices beside other things: their light past those, and past their own body as a model has it.

    shade = sum over cells c that others leave open of g(w_c . R) V(w_c) L_c

with L_c the sky's flux in one of 6 C C cells, w_c its mean direction there, V the bands of visibility past the own body
in the world's frame, and g a kernel about R. What others block is 0 exactly: however wrong V is, no light comes through
a wall. Where nothing else stands, `shading.shade` is the same sum over the whole sphere, in closed form.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.lights.environment import SkyCube, splat
from relightcli.core.parts import in_parts
from relightcli.core.sphere import cube, sh

F32 = NDArray[np.float32]
CELLS = 16
PROFILE = 2048  # steps of a kernel's table over the cosine from -1 to 1; one of them ends at 0, where lambert's bends


class SkyCells(NamedTuple):
    """Light in cells: flux (6 C C, 3), direction (6 C C, 3), unit, harmonics (6 C C, n^2) there, all float32."""

    flux: F32
    direction: F32
    harmonics: F32


def sky_cells(sky: SkyCube, order: int) -> SkyCells:
    """The sky's light, each texel's shared among the four cells about it, for n bands of visibility.

    The sky's resolution is a multiple of CELLS. A small sun thus casts a shadow that is soft over one cell.
    """
    shrink = sky.resolution // CELLS
    flux = cube.block_sums(sky.flux, sky.resolution, shrink)
    moment = cube.block_sums(sky.moment.reshape(-1, 9), sky.resolution, shrink).reshape(-1, 3, 3)
    shared = splat(SkyCube(CELLS, flux, moment))
    mean = shared.moment.sum(axis=1)
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    centers = cube.texel_directions(CELLS).reshape(-1, 3)
    direction = np.where(length > 0.0, mean / np.maximum(length, 1e-300), centers)
    y = sh.harmonics(direction, order)
    return SkyCells(shared.flux.astype(np.float32), direction.astype(np.float32), y.astype(np.float32))


def lambert_profile() -> F32:
    """max(0, t) / pi, the kernel of diffuse light of albedo 1, as `shade_beside` takes it."""
    return (np.maximum(np.linspace(-1.0, 1.0, PROFILE + 1), 0.0) / math.pi).astype(np.float32)


def band_profile(kappa: NDArray[np.float64]) -> F32:
    """The kernel of factors kappa_L, cut to their bands: sum of kappa_L (2 L + 1) / (4 pi) P_L(t)."""
    band = np.arange(len(kappa))
    series = kappa * (2 * band + 1) / (4.0 * math.pi)
    return np.polynomial.legendre.legval(np.linspace(-1.0, 1.0, PROFILE + 1), series).astype(np.float32)


def shade_beside(
    visibility: F32,
    bits: NDArray[np.uint8],
    cells: SkyCells,
    axis: F32,
    kernel: NDArray[np.int32],
    profiles: list[F32],
    threads: int = 1,
) -> F32:
    """Exit radiance (V, 3) float32 for kernels of unit colour; not negative.

    visibility (V, n^2) past the own body, world's frame; bits (V, 6, C, C/8): cells that others leave open; axis
    (V, 3): the kernel's R; kernel (V,): which of the profiles, -1 for none (0 comes out).
    """
    out = np.zeros((len(visibility), 3), np.float32)
    words = np.ascontiguousarray(bits).reshape(len(bits), -1)
    tables = np.stack(profiles) if profiles else np.zeros((0, PROFILE + 1), np.float32)

    def part(a: int, b: int) -> None:
        _shade(visibility, words, cells, axis, kernel, tables, a, b, out)

    in_parts(part, len(visibility), threads)
    return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _seen(visibility, harmonics, v, c):  # type: ignore[no-untyped-def]
    total = np.float32(0.0)
    for i in range(visibility.shape[1]):
        total += visibility[v, i] * harmonics[c, i]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _shade(visibility, words, cells, axis, kernel, tables, first, last, out):  # type: ignore[no-untyped-def]
    half = np.float32(0.5 * (tables.shape[1] - 1))
    top = tables.shape[1] - 2
    for v in range(first, last):
        k = kernel[v]
        if k < 0:
            continue
        r = g = b = np.float32(0.0)
        for c in range(len(cells.flux)):
            if not (words[v, c >> 3] >> np.uint8(c & 7)) & np.uint8(1):
                continue
            d = cells.direction[c]
            t = axis[v, 0] * d[0] + axis[v, 1] * d[1] + axis[v, 2] * d[2]
            place = min(max((t + np.float32(1.0)) * half, np.float32(0.0)), np.float32(top + 1))
            at = min(int(place), top)
            f = place - np.float32(at)
            w = tables[k, at] + f * (tables[k, at + 1] - tables[k, at])
            if w == np.float32(0.0):
                continue
            w *= _seen(visibility, cells.harmonics, v, c)
            r += w * cells.flux[c, 0]
            g += w * cells.flux[c, 1]
            b += w * cells.flux[c, 2]
        out[v, 0], out[v, 1], out[v, 2] = max(r, np.float32(0.0)), max(g, np.float32(0.0)), max(b, np.float32(0.0))
