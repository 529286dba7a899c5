"""Visibility as a few zonal harmonic lobes, each circular about an axis of its own. [Nowrouzezahrai 2008, Eq. 1]

    v_lm = sum over lobes x of z_lx u_lm(s_x),    u_lm(s) = sqrt(4 pi / (2 l + 1)) y_lm(s)

(the paper prints 2l + l, and one lobe too many). For given axes the least-squares z of a band solves c equations with
the Gram matrix P_l(s_x . s_y), as every u_l has unit length; what is left is a function of the axes alone, whose
gradient and Gauss-Newton matrix need nothing but Legendre polynomials of the axes' cosines and, per lobe, the
projection f_l(s) = sum_m v_lm u_lm(s) with its slope (variable projection, [Golub 1973], in Kaufman's form).

Bands l >= 1 alone place the axes: at l = 0 all u are 1, so only the sum of the z_0x matters, kept as one number that is
exact.

Every frame of a vertex is fitted from the lobes of the vertex's mean visibility, and a ridge draws to their
coefficients where the data leave a choice, as where two lobes meet: so a lobe stays the same lobe whatever the order of
the frames. Starting each frame from the one before it follows a blocker that crosses another lobe's axis better, and
was worse at every rig that was tried: what goes wrong once stays wrong, and training frames may lie far apart.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.parts import in_parts

RIDGE = 1e-2
STEPS = 12  # of Gauss-Newton and their damped trials, per frame
FIRST_STEPS = 60  # where a vertex starts
TRIALS = 3  # seeds per lobe that are followed
ENOUGH = 1e-5  # of the energy: a step that gains less is the last
MOST_LOBES = 4


class Lobes(NamedTuple):
    """Lobes of frames and vertices: mean (F, V), the coefficient of l = 0; axis (F, V, c, 3), unit; zonal
    (F, V, c, n - 1), z_lx of l = 1 to n - 1. All float32, in the vertices' frames."""

    mean: NDArray[np.float32]
    axis: NDArray[np.float32]
    zonal: NDArray[np.float32]


def fit_lobes(visibility: NDArray[np.float32], count: int, threads: int = 1) -> Lobes:
    """Lobes of visibility (F, V, n^2), count per vertex and frame.

    The result does not depend on `threads`. Raises ValueError for a count outside 1 to MOST_LOBES or values that are
    not finite.
    """
    if not 1 <= count <= MOST_LOBES:
        raise ValueError(f"lobes: expected 1 to {MOST_LOBES}; found {count}")
    if not np.isfinite(visibility).all():
        raise ValueError("visibility: expected finite values")
    frames, vertices, size = visibility.shape
    order = math.isqrt(size)
    values = np.ascontiguousarray(visibility, np.float32)
    axis = np.zeros((frames, vertices, count, 3), np.float32)
    axis[..., 2] = 1.0
    zonal = np.zeros((frames, vertices, count, order - 1), np.float32)
    if frames and order > 1:
        seeds, norms = _seeds(), unit_norms(order)

        def part(a: int, b: int) -> None:
            _fit(values, order, count, seeds, norms, a, b, axis, zonal)

        in_parts(part, vertices, threads)
    return Lobes(values[..., 0].copy(), axis, zonal)


@lru_cache(maxsize=1)
def _seeds() -> NDArray[np.float64]:
    """Axes that a vertex's first lobes are tried at: 24 directions spread evenly over the sphere."""
    k = np.arange(24) + 0.5
    z, phi = 1.0 - 2.0 * k / 24, math.pi * (1.0 + math.sqrt(5.0)) * k
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)


@lru_cache(maxsize=4)
def unit_norms(order: int) -> NDArray[np.float64]:
    """sqrt(4 pi / (2 l + 1)) K_lm, with sqrt 2 for m > 0: (order, order), [l, m]."""
    out = np.zeros((order, order))
    for band in range(order):
        for m in range(band + 1):
            ratio = math.factorial(band - m) / math.factorial(band + m)
            out[band, m] = math.sqrt(ratio * (2.0 if m else 1.0))
    return out


def visibility_of(lobes: Lobes) -> NDArray[np.float32]:
    """The coefficients that lobes stand for, (F, V, n^2) float32."""
    frames, vertices, count, bands = lobes.zonal.shape
    out = np.zeros((frames, vertices, (bands + 1) ** 2), np.float32)
    out[..., 0] = lobes.mean
    if bands:
        flat = (frames * vertices, count)
        _expand(
            lobes.axis.reshape(*flat, 3),
            lobes.zonal.reshape(*flat, bands),
            unit_norms(bands + 1),
            out.reshape(frames * vertices, -1),
        )
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _expand(axis, zonal, norms, out):  # type: ignore[no-untyped-def]
    order = norms.shape[0]
    u = np.empty(order * order)
    for i in range(len(out)):
        for x in range(axis.shape[1]):
            unit_harmonics(axis[i, x, 0], axis[i, x, 1], axis[i, x, 2], norms, u)
            for band in range(1, order):
                z = zonal[i, x, band - 1]
                for k in range(band * band, (band + 1) * (band + 1)):
                    out[i, k] += z * u[k]


@njit(cache=True, nogil=True, error_model="numpy")
def unit_harmonics(x, y, z, norms, out):  # type: ignore[no-untyped-def]
    """u_lm(s) of a unit direction into out (n^2,); norms from `unit_norms`."""
    order = norms.shape[0]
    c, s, diagonal = 1.0, 0.0, 1.0
    for m in range(order):
        low, value = 0.0, diagonal
        for band in range(m, order):
            k = band * (band + 1)
            w = norms[band, m] * value
            out[k + m] = w * c
            if m:
                out[k - m] = w * s
            low, value = value, ((2 * band + 1) * z * value - (band + m) * low) / (band + 1 - m)
        c, s = c * x - s * y, c * y + s * x
        diagonal *= 2 * m + 1


@njit(cache=True, nogil=True, error_model="numpy")
def _project(a, order, x, y, z, f, g):  # type: ignore[no-untyped-def]
    """f_l(s), l < order, into f (order,), and its gradient in space into g (order, 3), right along the sphere only.

    a (order, order, 2): coefficients times norms, [l, m, cos or sin].
    """
    for band in range(order):
        f[band] = 0.0
        g[band, 0] = g[band, 1] = g[band, 2] = 0.0
    c, s, c0, s0, diagonal = 1.0, 0.0, 0.0, 0.0, 1.0
    for m in range(order):
        low, value = 0.0, diagonal
        low1, value1 = 0.0, 0.0  # the derivatives in z: those of m + 1
        for band in range(m, order):
            p, r = a[band, m, 0], a[band, m, 1]
            turn = p * c + r * s
            f[band] += value * turn
            g[band, 2] += value1 * turn
            g[band, 0] += value * m * (p * c0 + r * s0)
            g[band, 1] += value * m * (r * c0 - p * s0)
            low, value = value, ((2 * band + 1) * z * value - (band + m) * low) / (band + 1 - m)
            if band == m:
                low1, value1 = 0.0, diagonal * (2 * m + 1)
            else:
                low1, value1 = value1, ((2 * band + 1) * z * value1 - (band + m + 1) * low1) / (band - m)
        c0, s0 = c, s
        c, s = c * x - s * y, c * y + s * x
        diagonal *= 2 * m + 1


@njit(cache=True, nogil=True, error_model="numpy")
def _legendre(order, t, p, d, dd):  # type: ignore[no-untyped-def]
    """P_l, P_l' and P_l'' at t, l < order."""
    p[0], d[0], dd[0] = 1.0, 0.0, 0.0
    p[1], d[1], dd[1] = t, 1.0, 0.0
    for n in range(1, order - 1):
        p[n + 1] = ((2 * n + 1) * t * p[n] - n * p[n - 1]) / (n + 1)
        d[n + 1] = d[n - 1] + (2 * n + 1) * p[n]
        dd[n + 1] = dd[n - 1] + (2 * n + 1) * d[n]


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(matrix, rhs, n):  # type: ignore[no-untyped-def]
    """Cholesky in place of matrix[:n, :n], then rhs (n, k) solved in place."""
    for i in range(n):
        for j in range(i):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / matrix[j, j]
        total = matrix[i, i]
        for k in range(i):
            total -= matrix[i, k] * matrix[i, k]
        matrix[i, i] = math.sqrt(max(total, 1e-300))
    for c in range(rhs.shape[1]):
        for i in range(n):
            total = rhs[i, c]
            for k in range(i):
                total -= matrix[i, k] * rhs[k, c]
            rhs[i, c] = total / matrix[i, i]
        for i in range(n - 1, -1, -1):
            total = rhs[i, c]
            for k in range(i + 1, n):
                total -= matrix[k, i] * rhs[k, c]
            rhs[i, c] = total / matrix[i, i]


class _Room(NamedTuple):
    """What the steps of one fit write into, taken once. c lobes, n bands."""

    f: NDArray[np.float64]  # (c, n) projections
    g: NDArray[np.float64]  # (c, n, 3) their slopes
    p: NDArray[np.float64]  # (c, c, n) Legendre polynomials of the axes' cosines, first axis above second
    d: NDArray[np.float64]  # and their derivatives
    dd: NDArray[np.float64]
    gram: NDArray[np.float64]  # (c, c)
    rhs: NDArray[np.float64]  # (c, 1)
    e: NDArray[np.float64]  # (c, 2, 3) tangents
    gradient: NDArray[np.float64]  # (2 c,)
    hessian: NDArray[np.float64]  # (2 c, 2 c)
    w: NDArray[np.float64]  # (c, 2 c)
    u: NDArray[np.float64]  # (c, 2 c)
    system: NDArray[np.float64]  # (2 c, 2 c)
    step: NDArray[np.float64]  # (2 c, 1)
    trial: NDArray[np.float64]  # (c, 3)
    new_z: NDArray[np.float64]  # (n, c)
    before: NDArray[np.float64]  # (n, c) coefficients that the ridge draws to


@njit(cache=True, nogil=True, error_model="numpy")
def _room(c, n):  # type: ignore[no-untyped-def]
    return _Room(
        np.empty((c, n)),
        np.empty((c, n, 3)),
        np.empty((c, c, n)),
        np.empty((c, c, n)),
        np.empty((c, c, n)),
        np.empty((c, c)),
        np.empty((c, 1)),
        np.empty((c, 2, 3)),
        np.empty(2 * c),
        np.empty((2 * c, 2 * c)),
        np.empty((c, 2 * c)),
        np.empty((c, 2 * c)),
        np.empty((2 * c, 2 * c)),
        np.empty((2 * c, 1)),
        np.empty((c, 3)),
        np.zeros((n, c)),
        np.zeros((n, c)),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def tangents(s, e):  # type: ignore[no-untyped-def]
    """Two tangents of every axis s (c, 3), continuous but at the south pole, into e (c, 2, 3)."""
    for i in range(len(s)):
        x, y, z = s[i, 0], s[i, 1], s[i, 2]
        sign = 1.0 if z >= 0.0 else -1.0
        a = -1.0 / (sign + z)
        b = x * y * a
        e[i, 0, 0], e[i, 0, 1], e[i, 0, 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
        e[i, 1, 0], e[i, 1, 1], e[i, 1, 2] = b, sign + y * y * a, -y


@njit(cache=True, nogil=True, error_model="numpy")
def _explain(a, order, s, z, room):  # type: ignore[no-untyped-def]
    """Energy that axes s (c, 3) explain; their z (order, c), and in room everything that the slopes need.

    z is least in |v - U z|^2 + RIDGE |z - before|^2; what that is less than a constant by is the energy.
    """
    count = len(s)
    f, g, p, d, dd, gram, rhs = room.f, room.g, room.p, room.d, room.dd, room.gram, room.rhs
    for x in range(count):
        _project(a, order, s[x, 0], s[x, 1], s[x, 2], f[x], g[x])
        for y in range(x):
            t = s[x, 0] * s[y, 0] + s[x, 1] * s[y, 1] + s[x, 2] * s[y, 2]
            _legendre(order, min(max(t, -1.0), 1.0), p[x, y], d[x, y], dd[x, y])
    energy = 0.0
    for band in range(1, order):
        for x in range(count):
            for y in range(x):
                gram[x, y] = p[x, y, band]
            gram[x, x] = 1.0 + RIDGE
            rhs[x, 0] = f[x, band] + RIDGE * room.before[band, x]
        _solve(gram, rhs, count)
        for x in range(count):
            z[band, x] = rhs[x, 0]
            energy += rhs[x, 0] * (f[x, band] + RIDGE * room.before[band, x])
    return energy


@njit(cache=True, nogil=True, error_model="numpy")
def _slopes(order, s, z, room):  # type: ignore[no-untyped-def]
    """Gradient (2 c,) of the explained energy along the tangents, and the Gauss-Newton matrix, halved both."""
    count = len(s)
    g, p, d, dd, gram, e = room.g, room.p, room.d, room.dd, room.gram, room.e
    gradient, hessian, w, u = room.gradient, room.hessian, room.w, room.u
    gradient[:] = 0.0
    hessian[:] = 0.0
    for band in range(1, order):
        w[:] = 0.0
        for x in range(count):
            for y in range(x):
                gram[x, y] = p[x, y, band]
            gram[x, x] = 1.0 + RIDGE
            for k in range(2):
                i = 2 * x + k
                slope = e[x, k, 0] * g[x, band, 0] + e[x, k, 1] * g[x, band, 1] + e[x, k, 2] * g[x, band, 2]
                for y in range(count):
                    if y != x:
                        first = d[max(x, y), min(x, y), band]
                        along = e[x, k, 0] * s[y, 0] + e[x, k, 1] * s[y, 1] + e[x, k, 2] * s[y, 2]
                        w[y, i] = z[band, x] * first * along
                        slope -= z[band, y] * first * along
                gradient[i] += z[band, x] * slope
        u[:] = w
        _solve(gram, u, count)
        for x in range(count):
            for k in range(2):
                i = 2 * x + k
                hessian[i, i] += z[band, x] * z[band, x] * (0.5 * band * (band + 1))
                for y in range(count):
                    for m in range(2):
                        j = 2 * y + m
                        if j > i:
                            continue
                        total = 0.0
                        for n in range(count):
                            total -= w[n, i] * u[n, j]
                        if y != x:
                            hi, lo = max(x, y), min(x, y)
                            across = along = cross = 0.0
                            for n in range(3):
                                across += e[x, k, n] * e[y, m, n]
                                along += e[x, k, n] * s[y, n]
                                cross += e[y, m, n] * s[x, n]
                            both = d[hi, lo, band] * across + dd[hi, lo, band] * along * cross
                            total += z[band, x] * z[band, y] * both
                        hessian[i, j] += total


@njit(cache=True, nogil=True, error_model="numpy")
def _refine(a, order, s, steps, least, z, room):  # type: ignore[no-untyped-def]
    """Moves the axes s (c, 3) to a maximum of the explained energy by damped Gauss-Newton steps; returns it, and z."""
    count = len(s)
    gradient, hessian, system, step, e = room.gradient, room.hessian, room.system, room.step, room.e
    trial, new_z = room.trial, room.new_z
    energy = _explain(a, order, s, z, room)
    damping, fresh = 1e-3, True
    for _ in range(steps):
        if fresh:
            tangents(s, e)
            _slopes(order, s, z, room)
            fresh = False
        largest = 0.0
        for i in range(2 * count):
            largest = max(largest, hessian[i, i])
        if not largest > 0.0:
            break
        for i in range(2 * count):
            for j in range(i + 1):
                system[i, j] = hessian[i, j]
            system[i, i] += damping * (hessian[i, i] + 1e-3 * largest)
            step[i, 0] = gradient[i]
        _solve(system, step, 2 * count)
        for x in range(count):
            length2 = step[2 * x, 0] ** 2 + step[2 * x + 1, 0] ** 2
            shrink = min(1.0, 0.5 / math.sqrt(length2)) if length2 > 0.0 else 1.0  # half a radian at most
            norm2 = 0.0
            for n in range(3):
                trial[x, n] = s[x, n] + shrink * (step[2 * x, 0] * e[x, 0, n] + step[2 * x + 1, 0] * e[x, 1, n])
                norm2 += trial[x, n] ** 2
            for n in range(3):
                trial[x, n] /= math.sqrt(norm2)
        found = _explain(a, order, trial, new_z, room)
        if found > energy:
            gain = found - energy
            energy, damping, fresh = found, 0.2 * damping, True
            s[:] = trial
            z[:] = new_z
            if gain < least:
                break
        else:
            if damping > 1e4 or found > energy - 1e-3 * least:
                break
            damping *= 10.0
    return energy


@njit(cache=True, nogil=True, error_model="numpy")
def _load(v, norms, a):  # type: ignore[no-untyped-def]
    """Coefficients (n^2,) times norms into a (n, n, 2); returns the energy of the bands from 1."""
    order = norms.shape[0]
    total = 0.0
    for band in range(1, order):
        k = band * (band + 1)
        for m in range(band + 1):
            a[band, m, 0] = norms[band, m] * v[k + m]
            a[band, m, 1] = norms[band, m] * v[k - m] if m else 0.0
        for j in range(band * band, (band + 1) * (band + 1)):
            total += v[j] * v[j]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _begin(a, order, total, count, seeds, s, z):  # type: ignore[no-untyped-def]
    """Axes s (count, 3) to start from: lobe after lobe, at the few seeds that explain most, all of them then moved."""
    explained = np.empty(len(seeds))
    for lobes in range(1, count + 1):
        room, part, part_z = _room(lobes, order), np.empty((lobes, 3)), np.zeros((order, lobes))
        for k in range(len(seeds)):
            part[: lobes - 1] = s[: lobes - 1]
            part[lobes - 1] = seeds[k]
            explained[k] = _explain(a, order, part, part_z, room)
        ranks = np.argsort(-explained)
        best = -1.0
        for k in ranks[:TRIALS]:
            part[: lobes - 1] = s[: lobes - 1]
            part[lobes - 1] = seeds[k]
            energy = _refine(a, order, part, FIRST_STEPS, 1e-7 * total, part_z, room)
            if energy > best * (1.0 + 1e-6) + 1e-300:
                best = energy
                kept = part.copy()
        s[:lobes] = kept


@njit(cache=True, nogil=True, error_model="numpy")
def _fit(values, order, count, seeds, norms, first, last, axis, zonal):  # type: ignore[no-untyped-def]
    a, z = np.zeros((order, order, 2)), np.zeros((order, count))
    s, anchor, room = np.empty((count, 3)), np.empty((count, 3)), _room(count, order)
    for v in range(first, last):
        mean = np.zeros(values.shape[2])
        for t in range(len(values)):
            for k in range(len(mean)):
                mean[k] += values[t, v, k] / len(values)
        total = _load(mean, norms, a)
        anchor[:] = 0.0
        anchor[:, 2] = 1.0
        if total > 0.0:
            _begin(a, order, total, count, seeds, anchor, z)
        for x in range(count):  # opposite axes say the same, odd bands turned in sign: those above the surface
            if anchor[x, 2] < 0.0:
                anchor[x] = -anchor[x]
        _load(mean, norms, a)
        room.before[:] = 0.0
        _explain(a, order, anchor, z, room)
        room.before[:] = z
        for t in range(len(values)):
            s[:] = anchor
            total = _load(values[t, v], norms, a)
            if total > 0.0:
                _refine(a, order, s, STEPS, ENOUGH * total, z, room)
            else:
                z[:] = 0.0
            for x in range(count):
                for n in range(3):
                    axis[t, v, x, n] = s[x, n]
                for band in range(1, order):
                    zonal[t, v, x, band - 1] = z[band, x]
