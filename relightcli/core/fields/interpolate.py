"""Values of a field between its samples: four directions on each of two shells. [Pan 2007, Eq. 10]

Between shells the weight is linear in the logarithm of the distance (shells in equal ratios) or in the distance (equal
steps). On a shell it is bilinear over the cube map's texels; over the edge of a face the row of the neighbour goes on,
and at the cube's eight corners the fourth sample is the mean of the three that meet there: the weights are continuous
everywhere and sum to 1.

Inside the innermost shell its values hold; outside the outermost its difference from empty space falls as the square
of the distance. Samples inside the object are left out, the others' weights fill up; where all eight are, those further
out in the same directions stand in.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.sphere import cube

CORNERS = 8
_CORNER = -1  # in a padded face: no texel, the mean of the three around it
_LEAST = 1e-4  # share of the weights below which the samples that are left say nothing


class Grid(NamedTuple):
    """Where samples lie and which are to be used.

    radii (S,) float64, rising; logarithmic: weights between shells; padded (6, n + 2, n + 2) int32, texels of the faces
    and of the rows around them, -1 in the corners; stand_in (S 6nn,) int32: the sample itself where it is valid, else
    the next one further out in its direction, or -1; clear: of this shell and all further out every sample is valid.
    """

    radii: NDArray[np.float64]
    logarithmic: bool
    padded: NDArray[np.int32]
    stand_in: NDArray[np.int32]
    clear: int


def make_grid(
    radii: NDArray[np.float64], resolution: int, valid: NDArray[np.bool_] | None = None, logarithmic: bool | None = None
) -> Grid:
    """The grid of a field: radii (S,), n, valid (S, 6nn). `logarithmic` None: as the radii are nearer to equal ratios
    or to equal steps."""
    radii = np.asarray(radii, np.float64)
    if logarithmic is None:
        ratios, steps = np.diff(np.log(radii)), np.diff(radii)
        logarithmic = len(radii) < 3 or bool(np.ptp(ratios) * steps.mean() <= np.ptp(steps) * ratios.mean())
    texels = 6 * resolution * resolution
    own = np.arange(len(radii) * texels, dtype=np.int32).reshape(len(radii), texels)
    stand_in = np.where(True if valid is None else valid, own, -1).astype(np.int32)
    for shell in range(len(radii) - 2, -1, -1):
        stand_in[shell] = np.where(stand_in[shell] < 0, stand_in[shell + 1], stand_in[shell])
    missing = np.flatnonzero((stand_in != own).any(axis=1))
    clear = int(missing[-1]) + 1 if len(missing) else 0
    return Grid(radii, logarithmic, _padded(resolution), stand_in.reshape(-1), clear)


@lru_cache(maxsize=8)
def _padded(resolution: int) -> NDArray[np.int32]:
    n = resolution
    # Just over the edge, so that the place along it stays: the neighbour's texel there has the same one.
    c = np.concatenate([[-1.0 - 1e-6], cube.texel_centers(n), [1.0 + 1e-6]])
    out = np.empty((6, n + 2, n + 2), np.int32)
    for face in range(6):
        out[face] = cube.texel_index(cube.face_directions(face, c[None, :], c[:, None]), n)
    out[:, [0, 0, -1, -1], [0, -1, 0, -1]] = _CORNER
    return out


def locate(grid: Grid, points: NDArray[np.floating]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Samples (n, 8) int32 and weights (n, 8) float32 for points (n, 3) about the field's centre.

    The weights sum to 1, less outside the outermost shell: the rest belongs to empty space (see `blend`). Nothing is
    refused: at the centre the direction is +X.
    """
    p = np.ascontiguousarray(points, np.float64)
    index, weight = np.empty((len(p), CORNERS), np.int32), np.empty((len(p), CORNERS), np.float32)
    _locate(p, *grid, index, weight)
    return index, weight


def blend(
    index: NDArray[np.int32], weight: NDArray[np.float32], values: NDArray[np.floating], empty: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Values at points: sum of weight times values (samples, ...), the weights' rest times `empty` (...)."""
    w = weight.astype(np.float64)
    rest = 1.0 - w.sum(1)
    found: NDArray[np.float64] = np.einsum("nk,nk...->n...", w, values[index])
    return found + np.multiply.outer(rest, empty)


@njit(cache=True, nogil=True)
def shell_steps(radii, logarithmic):  # type: ignore[no-untyped-def]
    """Of all shells (S, 3): the square of the radius, the radius in the measure that weights are linear in, and 1 / the
    step to the next in it."""
    out = np.zeros((len(radii), 3))
    for k in range(len(radii)):
        out[k, 0] = radii[k] * radii[k]
        out[k, 1] = 0.5 * math.log(out[k, 0]) if logarithmic else radii[k]
    for k in range(len(radii) - 1):
        out[k, 2] = 1.0 / (out[k + 1, 1] - out[k, 1])
    return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"}, inline="always")
def locate_one(x, y, z, steps, logarithmic, padded, stand_in, clear, index, weight):  # type: ignore[no-untyped-def]
    """The samples and weights of one point, into index and weight (8,); steps from `shell_steps`."""
    n = padded.shape[1] - 2
    square = x * x + y * y + z * z
    ax, ay, az = abs(x), abs(y), abs(z)
    # Faces +X -X +Y -Y +Z -Z as in core.sphere.cube.
    if ax >= ay and ax >= az:
        face, s, t, major = (0, -z, -y, ax) if x >= 0.0 else (1, z, -y, ax)
    elif ay >= az:
        face, s, t, major = (2, x, z, ay) if y >= 0.0 else (3, x, -z, ay)
    else:
        face, s, t, major = (4, x, -y, az) if z >= 0.0 else (5, -x, -y, az)
    if major > 0.0:
        shrink = 1.0 / major
        s, t = s * shrink, t * shrink
    else:
        s, t = 0.0, 0.0
    u, v = (s + 1.0) * 0.5 * n + 0.5, (t + 1.0) * 0.5 * n + 0.5  # in padded texels, whose centres are whole numbers
    j, i = min(max(int(u), 0), n), min(max(int(v), 0), n)
    u, v = u - j, v - i
    last = len(steps) - 1
    low, along, fade = 0, 0.0, 1.0
    if square >= steps[last, 0]:
        low, fade = last, steps[last, 0] / square
    elif square > steps[0, 0]:
        measure = 0.5 * math.log(square) if logarithmic else math.sqrt(square)
        # As if all steps were like the first; then to where it is.
        low = min(int((measure - steps[0, 1]) * steps[0, 2]), last - 1)
        while steps[low + 1, 0] <= square:
            low += 1
        while steps[low, 0] > square:
            low -= 1
        along = min(max((measure - steps[low, 1]) * steps[low, 2], 0.0), 1.0)
    high = min(low + 1, last)
    weight[0], weight[1] = (1.0 - u) * (1.0 - v), u * (1.0 - v)
    weight[2], weight[3] = (1.0 - u) * v, u * v
    index[0], index[1] = padded[face, i, j], padded[face, i, j + 1]
    index[2], index[3] = padded[face, i + 1, j], padded[face, i + 1, j + 1]
    if (i == 0 or i == n) and (j == 0 or j == n):
        for k in range(4):
            if index[k] < 0:
                third = weight[k] / 3.0
                weight[k] = 0.0
                for other in range(4):
                    if other != k:
                        weight[other] += third
                index[k] = index[(k + 1) % 4]
    texels = 6 * n * n
    near, far = (1.0 - along) * fade, along * fade
    for k in range(4):
        w = weight[k]
        at = index[k]
        index[k], weight[k] = low * texels + at, w * near
        index[k + 4], weight[k + 4] = high * texels + at, w * far
    if low < clear:
        _leave_out(stand_in, fade, index, weight)


@njit(cache=True, nogil=True)
def _leave_out(stand_in, fade, index, weight):  # type: ignore[no-untyped-def]
    """Gives the weights of samples that are not valid to the others; all of them together weigh `fade`."""
    total = 0.0
    for k in range(8):
        if stand_in[index[k]] == index[k]:
            total += weight[k]
    if total >= (1.0 - 1e-12) * fade:
        return
    if total > _LEAST * fade:
        for k in range(8):
            if stand_in[index[k]] != index[k]:
                weight[k] = 0.0
        scale = fade / total
    else:
        left = 0.0
        for k in range(8):
            at = stand_in[index[k]]
            if at < 0:
                weight[k] = 0.0
            else:
                index[k] = at
                left += weight[k]
        scale = fade / left if left > _LEAST * fade else 0.0
    for k in range(8):
        weight[k] *= scale


@njit(cache=True, nogil=True)
def _locate(points, radii, logarithmic, padded, stand_in, clear, index, weight):  # type: ignore[no-untyped-def]
    steps = shell_steps(radii, logarithmic)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        locate_one(x, y, z, steps, logarithmic, padded, stand_in, clear, index[i], weight[i])
