"""How well one fraction per receiver stands for all the lights of a cell of the sky, and the cells where it does.

A receiver i sees the samples l of a cell (v_il = 0 or 1) at cosines c_il = max(0, n_i . w_l). Its fraction

    f_i = sum_l v_il c_il / sum_l c_il,

times the cosine of whatever light the cell will hold, is its transfer from the cell: the mean of the sampled transfer
vectors under even light [Johan and Nishita, Eq. 10], with the cosine kept exact, so that only visibility is
approximated. The error of sample l is

    e_l = [sum_i a_i (f_i - v_il)^2 c_il^2 / sum_i a_i]^(1/2),

a_i the receivers' areas, relative to the transfer of an unblocked light overhead. It does not depend on how finely the
mesh is cut. The paper's own error, (11), is the L2 norm over the receivers of T_C - T_l, over their number, with T the
reflectance times v c, and T_C its mean over the samples.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.bits import trailing_zeros


def visibility_errors(
    visible: NDArray[np.uint64], directions: NDArray[np.float64], normal: NDArray[np.float32], area: NDArray[np.float64]
) -> NDArray[np.float64]:
    """e_l (S,) of the samples of a cell. visible (S, W) bits of N receivers; directions (S, 3); normal (N, 3) unit;
    area (N,), which sum to 1."""
    square = np.zeros(len(visible))
    _visibility_errors(visible, np.ascontiguousarray(directions), normal, area, square)
    return np.sqrt(square)


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
    visible: NDArray[np.uint64], directions: NDArray[np.float64], normal: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """f_i (N,) of a cell in steps of 1/255."""
    out = np.zeros(len(normal), np.uint8)
    _fractions(visible, np.ascontiguousarray(directions), normal, out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _cosine(normal, i, directions, s):  # type: ignore[no-untyped-def]
    height = normal[i, 0] * directions[s, 0] + normal[i, 1] * directions[s, 1] + normal[i, 2] * directions[s, 2]
    return max(height, 0.0)


@njit(cache=True, nogil=True)
def _every_and_some(visible, w):  # type: ignore[no-untyped-def]
    every, some = visible[0, w], visible[0, w]
    for s in range(1, len(visible)):
        every &= visible[s, w]
        some |= visible[s, w]
    return every, some


@njit(cache=True, nogil=True, error_model="numpy")
def _fraction(visible, directions, normal, i, cosines):  # type: ignore[no-untyped-def]
    """f_i; fills the cosines, (S,)."""
    word, place = i >> 6, np.uint64(i & 63)
    seen = total = 0.0
    for s in range(len(visible)):
        c = _cosine(normal, i, directions, s)
        cosines[s] = c
        total += c
        if (visible[s, word] >> place) & np.uint64(1):
            seen += c
    return seen / total if total > 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _visibility_errors(visible, directions, normal, area, square):  # type: ignore[no-untyped-def]
    cosines = np.empty(len(visible))
    for w in range(visible.shape[1]):
        every, some = _every_and_some(visible, w)
        mixed = every ^ some
        while mixed != np.uint64(0):
            place = trailing_zeros(mixed)  # type: ignore
            mixed &= mixed - np.uint64(1)
            i = 64 * w + place
            f = _fraction(visible, directions, normal, i, cosines)
            for s in range(len(visible)):
                v = 1.0 if (visible[s, w] >> np.uint64(place)) & np.uint64(1) else 0.0
                e = (f - v) * cosines[s]
                square[s] += area[i] * e * e


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
                t[s] = reflectance[i] * _cosine(normal, i, directions, s)
                mean += t[s]
        mean /= count
        for s in range(count):
            square[s] += (t[s] - mean) * (t[s] - mean)


@njit(cache=True, nogil=True, error_model="numpy")
def _fractions(visible, directions, normal, out):  # type: ignore[no-untyped-def]
    cosines = np.empty(len(visible))
    for w in range(visible.shape[1]):
        every, some = _every_and_some(visible, w)
        for place in range(min(64, len(out) - 64 * w)):
            i = 64 * w + place
            if (every >> np.uint64(place)) & np.uint64(1):
                out[i] = 255
            elif (some >> np.uint64(place)) & np.uint64(1):
                out[i] = np.uint8(255.0 * _fraction(visible, directions, normal, i, cosines) + 0.5)
