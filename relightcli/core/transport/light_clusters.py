"""How well one fraction per receiver stands for all the lights of a cell of the sky, and the cells where it does.

Unblocked, a light at the cosine x = n . w above a receiver's horizon gives x. A cell about the horizon lies partly
below it: if x is the mean cosine of its light, and its light spread over x - r to x + r, it gives

    g(x, r) = x for x > r,  (x + r)^2 / (4 r) for -r <= x <= r,  0 below,

r half the side of the cell, sqrt(solid angle) / 2. A receiver i sees the samples l of a cell (v_il = 0 or 1) at the
cosines c_il = max(0, n_i . w_l); its transfer from the cell under even light is T_i, the mean over l of v_il c_il
[Johan and Nishita, Eq. 10, with the reflectance left out]. Kept is the fraction f_i = T_i / g(n_i . mean of w_l, r), at
most 1, so that f_i g is the transfer of whatever light the cell will hold, with its own direction: what is approximated
is visibility, and not the cosine. The error of sample l is

    e_l = [sum_i a_i (f_i g(n_i . w_l, r) - v_il c_il)^2 / sum_i a_i]^(1/2),

a_i the receivers' areas, relative to the transfer of an unblocked light overhead; that under even light is judged as
well. None depends on how finely the mesh is cut. The paper's own error, (11), is the L2 norm over the receivers of
T_C - T_l, over their number, with T the reflectance times v c, and T_C its mean over the samples.

Where the view is fixed, a receiver with a specular lobe has a second transfer, S_il = v_il times lobe times cosine, of
which the mean over the samples is kept. Its error joins the first one's before the square, both as radiance. Lights
that graze a glossy surface from behind give many times what others do: where a light gives more than the reference, its
error is relative to what it gives.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.bits import trailing_zeros
from relightcli.core.brdf.models import MaterialTable, lobes_and_density


def visibility_errors(
    visible: NDArray[np.uint64],
    directions: NDArray[np.float64],
    radius: float,
    normal: NDArray[np.float32],
    area: NDArray[np.float64],
) -> NDArray[np.float64]:
    """e_l^2 of the samples of a cell and, last, of even light, (S + 1,).

    visible (S, W) bits of N receivers; directions (S, 3); radius r; normal (N, 3) unit; area (N,), which sum to 1.
    """
    square = np.zeros(len(visible) + 1)
    _visibility_errors(visible, _with_mean(directions), radius, normal, area, square)
    return square


def _with_mean(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([directions, directions.mean(axis=0)[None]])


def paper_errors(
    visible: NDArray[np.uint64],
    directions: NDArray[np.float64],
    normal: NDArray[np.float32],
    reflectance: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The paper's errors (S,), Eq. 11. reflectance (N,), sr^-1; the others as in `visibility_errors`."""
    square = np.zeros(len(visible))
    _paper_errors(visible, np.ascontiguousarray(directions), normal, reflectance, square)
    errors: NDArray[np.float64] = np.sqrt(square) / len(normal)
    return errors


def fractions(
    visible: NDArray[np.uint64], directions: NDArray[np.float64], radius: float, normal: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """f_i (N,) of a cell in steps of 1/255; 255 only where every sample is seen, above the horizon therefore."""
    out = np.zeros(len(normal), np.uint8)
    _fractions(visible, _with_mean(directions), radius, normal, out)
    return out


def lobe_transfer(
    visible: NDArray[np.uint64],
    directions: NDArray[np.float64],
    normal: NDArray[np.float32],
    view: NDArray[np.float32],
    rows: NDArray[np.int64],
    material: NDArray[np.int32],
    table: MaterialTable,
) -> NDArray[np.float32]:
    """S_il (S, n) of the receivers `rows` (n,), without the specular colour. view (N, 3) unit, to the viewer; material
    (N,): row of the table."""
    out = np.zeros((len(visible), len(rows)), np.float32)
    d = np.ascontiguousarray(directions)
    _lobe_transfer(visible, d, normal, view, rows, material, table.model, table.parameters, out)
    return out


def add_glossy_errors(
    square: NDArray[np.float64],
    visible: NDArray[np.uint64],
    directions: NDArray[np.float64],
    radius: float,
    normal: NDArray[np.float32],
    rows: NDArray[np.int64],
    lobes: NDArray[np.float32],
    diffuse: NDArray[np.float64],
    specular: NDArray[np.float64],
    area: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Adds to the squared errors (S + 1,) those of receivers with lobes (S, n); returns the mean square of what their
    lobes give, (S + 1,).

    diffuse (N,): reflectance over that of the reference; specular (N,): luminance of the specular colour over the
    reference; area (N,) sums to 1; the others as in `visibility_errors`.
    """
    given = np.zeros(len(square))
    _add_glossy_errors(
        square, given, visible, _with_mean(directions), radius, normal, rows, lobes, diffuse, specular, area
    )
    return given


@njit(cache=True, nogil=True, error_model="numpy")
def spread_cosine(x: float, r: float) -> float:
    """g(x, r)."""
    if x >= r:
        return x
    return 0.25 * (x + r) * (x + r) / r if x > -r else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _height(normal, i, directions, s):  # type: ignore[no-untyped-def]
    return normal[i, 0] * directions[s, 0] + normal[i, 1] * directions[s, 1] + normal[i, 2] * directions[s, 2]


@njit(cache=True, nogil=True)
def _every_and_some(visible, w):  # type: ignore[no-untyped-def]
    every, some = visible[0, w], visible[0, w]
    for s in range(1, len(visible)):
        every &= visible[s, w]
        some |= visible[s, w]
    return every, some


@njit(cache=True, nogil=True, error_model="numpy")
def _fraction(visible, directions, radius, normal, i, errors):  # type: ignore[no-untyped-def]
    """f_i; fills errors (S + 1,) with f_i g - v_il c_il, and last with f_i g - T_i."""
    word, place = i >> 6, np.uint64(i & 63)
    count = len(visible)
    mean = 0.0
    for s in range(count):
        errors[s] = 0.0
        if (visible[s, word] >> place) & np.uint64(1):
            errors[s] = max(_height(normal, i, directions, s), 0.0)
            mean += errors[s]
    mean /= count
    whole = spread_cosine(_height(normal, i, directions, count), radius)
    f = min(mean / whole, 1.0) if whole > 0.0 else 0.0
    for s in range(count):
        errors[s] = f * spread_cosine(_height(normal, i, directions, s), radius) - errors[s]
    errors[count] = f * whole - mean
    return f


@njit(cache=True, nogil=True, error_model="numpy")
def _visibility_errors(visible, directions, radius, normal, area, square):  # type: ignore[no-untyped-def]
    errors = np.empty(len(square))
    for w in range(visible.shape[1]):
        every, some = _every_and_some(visible, w)
        mixed = every ^ some
        while mixed != np.uint64(0):
            i = 64 * w + trailing_zeros(mixed)  # type: ignore[call-arg]
            mixed &= mixed - np.uint64(1)
            _fraction(visible, directions, radius, normal, i, errors)
            for s in range(len(square)):
                square[s] += area[i] * errors[s] * errors[s]


@njit(cache=True, nogil=True, error_model="numpy")
def _paper_errors(visible, directions, normal, reflectance, square):  # type: ignore[no-untyped-def]
    count = len(visible)
    t = np.empty(count)
    for i in range(len(normal)):
        word, place = i >> 6, np.uint64(i & 63)
        mean = 0.0
        for s in range(count):
            t[s] = 0.0
            if (visible[s, word] >> place) & np.uint64(1):
                t[s] = reflectance[i] * max(_height(normal, i, directions, s), 0.0)
                mean += t[s]
        mean /= count
        for s in range(count):
            square[s] += (t[s] - mean) * (t[s] - mean)


@njit(cache=True, nogil=True, error_model="numpy")
def _fractions(visible, directions, radius, normal, out):  # type: ignore[no-untyped-def]
    errors = np.empty(len(directions))
    for w in range(visible.shape[1]):
        every, some = _every_and_some(visible, w)
        for place in range(min(64, len(out) - 64 * w)):
            i = 64 * w + place
            if (every >> np.uint64(place)) & np.uint64(1):
                out[i] = 255
            elif (some >> np.uint64(place)) & np.uint64(1):
                out[i] = np.uint8(min(255.0 * _fraction(visible, directions, radius, normal, i, errors) + 0.5, 254.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _lobe_transfer(visible, directions, normal, view, rows, material, model, parameters, out):  # type: ignore[no-untyped-def]
    for j in range(len(rows)):
        i = rows[j]
        word, place = i >> 6, np.uint64(i & 63)
        n = (np.float64(normal[i, 0]), np.float64(normal[i, 1]), np.float64(normal[i, 2]))
        v = (np.float64(view[i, 0]), np.float64(view[i, 1]), np.float64(view[i, 2]))
        for s in range(len(visible)):
            if (visible[s, word] >> place) & np.uint64(1):
                l = (directions[s, 0], directions[s, 1], directions[s, 2])  # noqa: E741
                _, lobe, _, _ = lobes_and_density(model[material[i]], parameters[material[i]], n, l, v)
                out[s, j] = lobe


@njit(cache=True, nogil=True, error_model="numpy")
def _add_glossy_errors(  # type: ignore[no-untyped-def]
    square, given, visible, directions, radius, normal, rows, lobes, diffuse, specular, area
):
    errors = np.empty(len(square))
    for j in range(len(rows)):
        i = rows[j]
        _fraction(visible, directions, radius, normal, i, errors)
        mean = 0.0
        for s in range(len(visible)):
            mean += lobes[s, j]
        mean /= len(visible)
        for s in range(len(square)):
            e = diffuse[i] * errors[s]
            lobe = mean
            if s < len(visible):
                lobe = lobes[s, j]
                e += specular[i] * (mean - lobe)
            square[s] += area[i] * e * e
            given[s] += area[i] * (specular[i] * lobe) ** 2
