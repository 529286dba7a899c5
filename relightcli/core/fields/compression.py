"""Radiance transfer fields in clusters of their own principal components. [Pan 2007, Eqs. 9 and 12]

A sample's transfer to all proxies is one row of D = m N N C numbers; in its cluster h

    M(r)  ~  E_h0 + sum over j of alpha_j(r) E_hj,

E_h0 the cluster's mean (which Eq. 9 lacks: the method it cites is affine). Reflected light is made in this form: first
E_hj L for the light at the proxies, once for all samples of a cluster, then the sum over j of every sample.

The clusters are found in the leading coordinates of one common basis that leaves a small part of the error that is
allowed: distances stay nearly what they are, and D (2,000 and more) falls to hundreds. Terms are given out where they
pay most for their bytes, until the tolerance is met.

Rounding takes a share of the error on purpose, where it costs least. With orthonormal components every coefficient
errs alike in the sum, so all have the same step. A component's error counts as often as it is used, so its step goes
with 1 / sqrt(its energy in all samples): most numbers are a few bits long, which a store's entropy coder makes use of.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.compress.cpca import cpca
from relightcli.core.compress.tucker import gram_spectrum
from relightcli.errors import NumericalError

CLUSTERS = 32
TERMS = 16
COMMON = 512  # directions of the common basis to begin with
MOST_TOLD_APART = 64  # leading ones of them that clusters are found by
_MOST = 32767  # in 16 bits
_OF_BASIS, _OF_COEFFICIENTS, _OF_COMPONENTS = 0.6, 0.2, 0.1  # shares of the error allowed, in squares, at most
_ENOUGH = 0.01  # of it: a common basis that leaves this is large enough
_COMPONENT_BYTES, _COEFFICIENT_BYTES = 0.75, 0.5  # of a number, about, after the entropy coder
_FLOOR = 1e-4  # relative error below which nothing is allowed for: 16 bits do not carry it
_SLAB = 4096  # samples at a time


@dataclass(frozen=True)
class CompressedTransfer:
    """Transfer of all samples of a field; see `Transfer` of `fields.entities`.

    shape m, N, N, C of a sample; cluster (samples,) uint8
    start (K + 1,) int32: components of cluster h are start[h] to start[h + 1], the mean first
    component (E, m N N C) int16, or float32 (see `albedos`), to be multiplied by scale (E,) float32
    coefficient (A,) int16, to be multiplied by coefficient_scale (E,) float32 of its component: those of a sample, all
    but the mean's, lie together; first (samples + 1,) int64: where
    error: |M - M~| / |M|, Frobenius, over all samples, rounding included
    """

    shape: tuple[int, int, int, int]
    cluster: NDArray[np.uint8]
    start: NDArray[np.int32]
    component: NDArray[Any]
    scale: NDArray[np.float32]
    coefficient: NDArray[np.int16]
    coefficient_scale: NDArray[np.float32]
    error: float
    first: NDArray[np.int64]

    def reflect(self, light: NDArray[np.floating], which: NDArray[np.integer]) -> NDArray[np.float32]:
        """Radiance (k, 3, N) float32 of the object seen from samples `which` (k,), light (m, 3, N) at its proxies."""
        n = self.shape[1]
        used = np.bincount(self.cluster[which], minlength=len(self.start) - 1) > 0
        rows = np.flatnonzero(np.repeat(used, np.diff(self.start)))
        # By the components of clusters that are read alone.
        seen = np.empty((len(self.component), 3, n), np.float32)
        light = np.ascontiguousarray(light, np.float32)
        _apply(self._by_output, self.scale, light, rows, seen)
        out = np.empty((len(which), 3, n), np.float32)
        _combine(
            which, self.cluster, self.start, self.first, self.coefficient, self.coefficient_scale,
            seen.reshape(len(seen), 3 * n), out.reshape(len(out), 3 * n),
        )  # fmt: skip
        return out

    @cached_property
    def _by_output(self) -> NDArray[Any]:
        """The components as (E, N out, C, m, N in): every coefficient of what is sent is one long sum."""
        whole = self.component.reshape(-1, *self.shape)
        return np.ascontiguousarray(whole.transpose(0, 2, 4, 1, 3))

    def decompress(self, start: int = 0, stop: int | None = None) -> NDArray[np.float32]:
        """The transfer (samples, m, N, N, C) float32 of the samples start .. stop."""
        cluster = self.cluster[start:stop]
        rows = np.empty((len(cluster), self.component.shape[1]), np.float32)
        for h in np.unique(cluster):
            own = np.flatnonzero(cluster == h)
            a, b = self.start[h], self.start[h + 1]
            basis = self.component[a:b] * self.scale[a:b, None]
            places = self.first[start + own, None] + np.arange(b - a - 1)
            rows[own] = basis[0] + (self.coefficient[places] * self.coefficient_scale[a + 1 : b]) @ basis[1:]
        return rows.reshape(-1, *self.shape)


def places_of(cluster: NDArray[np.uint8], start: NDArray[np.int32]) -> NDArray[np.int64]:
    """Where the coefficients of every sample begin, (samples + 1,) int64; `CompressedTransfer.first`."""
    first = np.zeros(len(cluster) + 1, np.int64)
    np.cumsum((np.diff(start) - 1)[cluster], out=first[1:])
    return first


def compress(
    transfer: NDArray[np.float32] | Sequence[NDArray[np.float32]],
    clusters: int = CLUSTERS,
    terms: int = TERMS,
    tolerance: float | None = None,
    seed: int = 0,
) -> CompressedTransfer:
    """Compresses a transfer (samples, m, N, N, C), or a sequence of such that follow each other; these are read several
    times, one at a time.

    clusters: at most 256; terms: components of every cluster, the mean counted; tolerance: relative error in the
    Frobenius norm instead, with as many components in all as it takes. Raises NumericalError for values that are not
    finite. The bytes may depend on the number of threads of NumPy's linear algebra.
    """
    if isinstance(transfer, np.ndarray):
        transfer = [transfer[a : a + _SLAB] for a in range(0, len(transfer), _SLAB)]
    rows = _Rows(transfer)
    mean, norm2 = rows.mean()
    if not np.isfinite(norm2):
        raise NumericalError("compression of a transfer field: values that are not finite")
    goal2 = None if tolerance is None else max(tolerance, _FLOOR) ** 2 * norm2
    # By terms, the common basis is as it is, and what it leaves counts as theirs.
    enough, most = (_FLOOR**2 * norm2, np.inf) if goal2 is None else (_ENOUGH * goal2, _OF_BASIS * goal2)
    basis, x, left2 = _common_basis(rows, mean, enough, most, seed)
    label = cpca(x[:, :MOST_TOLD_APART], clusters, max(1, terms - 1), seed).label
    spaces = [_subspace(x[label == h]) for h in range(int(label.max()) + 1)]
    sizes = np.bincount(label)
    kept = [min(terms - 1, len(s.gain)) for s in spaces]
    if goal2 is not None:
        bytes_ = _COMPONENT_BYTES * rows.width + _COEFFICIENT_BYTES * sizes
        rounding = _OF_COEFFICIENTS + _OF_COMPONENTS
        kept = _share_out([s.gain for s in spaces], bytes_.tolist(), (1.0 - rounding) * goal2 - left2)
    else:
        goal2 = max(left2 + sum(float(s.gain[k:].sum()) for s, k in zip(spaces, kept, strict=True)), _FLOOR**2 * norm2)
    start = np.zeros(len(spaces) + 1, np.int32)
    start[1:] = np.cumsum(np.array(kept) + 1)
    cluster = label.astype(np.uint8)
    first = places_of(cluster, start)
    coefficient = np.empty(first[-1], np.int16)
    component = np.empty((start[-1], rows.width), np.int16)
    scale, coefficient_scale = np.empty(start[-1], np.float32), np.ones(start[-1], np.float32)
    step = np.sqrt(12.0 * _OF_COEFFICIENTS * goal2 / max(1, first[-1]))
    energy_step = np.sqrt(12.0 * _OF_COMPONENTS * goal2 / component.size)
    for h, (space, count) in enumerate(zip(spaces, kept, strict=True)):
        a, b = start[h], start[h + 1]
        directions = space.directions[:, :count]
        full = np.concatenate([(mean + basis @ space.mean)[None], (basis @ directions).T])
        energy = np.concatenate([sizes[h : h + 1], space.gain[:count]])
        component[a:b], scale[a:b] = _round(full, energy_step / np.sqrt(np.maximum(energy, 1e-300)))
        alpha = ((x[label == h] - space.mean) @ directions).T
        rounded, coefficient_scale[a + 1 : b] = _round(alpha, np.full(count, step))
        coefficient[first[:-1][label == h, None] + np.arange(count)] = rounded.T
    made = CompressedTransfer(rows.shape, cluster, start, component, scale, coefficient, coefficient_scale, 0.0, first)
    return replace(made, error=rows.error(made, norm2))


class _Rows:
    """The samples as rows of numbers, read slab by slab."""

    def __init__(self, slabs: Sequence[NDArray[np.float32]]) -> None:
        self.slabs = slabs
        self.shape: tuple[int, int, int, int] = slabs[0].shape[1:]
        self.width = int(np.prod(self.shape))

    def mean(self) -> tuple[NDArray[np.float32], float]:
        """The mean row (D,) and the sum of all squares."""
        total, count, norm2 = np.zeros(self.width), 0, 0.0
        for slab in self.slabs:
            rows = slab.reshape(len(slab), -1)
            total += rows.sum(0, dtype=np.float64)
            norm2 += float(np.einsum("ij,ij->", rows, rows, dtype=np.float64))
            count += len(rows)
        return (total / count).astype(np.float32), norm2

    def about(self, mean: NDArray[np.float32]) -> Iterator[NDArray[np.float32]]:
        """Slabs of the rows less the mean."""
        for slab in self.slabs:
            yield slab.reshape(len(slab), -1) - mean

    def error(self, made: CompressedTransfer, norm2: float) -> float:
        """Relative error of what was made."""
        start, error2 = 0, 0.0
        for slab in self.slabs:
            missing = made.decompress(start, start + len(slab)) - slab
            error2 += float(np.einsum("i,i->", missing.ravel(), missing.ravel(), dtype=np.float64))
            start += len(slab)
        return (error2 / norm2) ** 0.5 if norm2 > 0.0 else 0.0


@dataclass(frozen=True)
class _Subspace:
    """mean (R,) of a cluster's rows, orthonormal directions (R, r), and how much every one explains, (r,)."""

    mean: NDArray[np.float64]
    directions: NDArray[np.float64]
    gain: NDArray[np.float64]


def _subspace(own: NDArray[np.float32]) -> _Subspace:
    x = own.astype(np.float64)
    mean = x.mean(0)
    x -= mean
    spectrum, directions = gram_spectrum(x.T @ x)
    most = min(len(own) - 1, len(spectrum))
    return _Subspace(mean, directions[:, :most], np.maximum(spectrum[:most], 0.0))


def _common_basis(
    rows: _Rows, mean: NDArray[np.float32], enough: float, most: float, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float32], float]:
    """An orthonormal basis (D, R), the coordinates (n, R) in it of the rows less their mean, and the square sum that it
    leaves: as small as a basis that leaves `enough`, or COMMON, or as large as one that leaves at most `most`.

    By a random sketch of the rows with one power step: a Gram matrix of D = 6,000 would cost ten times as much.
    """
    count = sum(len(slab) for slab in rows.slabs)
    size = min(COMMON, rows.width, count)
    while True:
        rng = np.random.default_rng(seed)
        sketch = np.zeros((rows.width, size))
        for own in rows.about(mean):
            sketch += own.T @ rng.standard_normal((len(own), size), np.float32)
        small = np.linalg.qr(sketch)[0].astype(np.float32)
        sketch = np.zeros_like(sketch)
        for own in rows.about(mean):
            sketch += own.T @ (own @ small)
        basis, _ = np.linalg.qr(sketch)
        small = basis.astype(np.float32)
        coordinates, gram, total, start = np.empty((count, size), np.float32), np.zeros((size, size)), 0.0, 0
        for own in rows.about(mean):
            along = own @ small
            coordinates[start : start + len(own)] = along
            gram += along.T.astype(np.float64) @ along
            total += float(np.einsum("ij,ij->", own, own, dtype=np.float64))
            start += len(own)
        spectrum, vectors = gram_spectrum(gram)
        left = np.maximum(total - np.cumsum(spectrum), 0.0)
        if left[-1] <= most or size == min(rows.width, count):
            break
        size = min(2 * size, rows.width, count)
    keep = vectors[:, : int((left > enough).sum()) + 1]
    return basis @ keep, coordinates @ keep.astype(np.float32), float(left[keep.shape[1] - 1])


def _share_out(gains: list[NDArray[np.float64]], bytes_: list[float], allowed: float) -> list[int]:
    """Components for every cluster: the best gains for their bytes, until what is left is allowed."""
    owner = np.repeat(np.arange(len(gains)), [len(g) for g in gains])
    gain = np.concatenate(gains)
    best = np.argsort(-gain / np.array(bytes_)[owner], kind="stable")
    left = gain.sum() - np.cumsum(gain[best])
    enough = int((left > allowed).sum()) + 1 if gain.sum() > allowed else 0
    return np.bincount(owner[best[:enough]], minlength=len(gains)).tolist()


def _round(rows: NDArray[np.float64], step: NDArray[np.float64]) -> tuple[NDArray[np.int16], NDArray[np.float32]]:
    """Whole numbers (n, D) and scales (n,) of rows: steps (n,) as asked for, or what 16 bits reach to."""
    peak = np.abs(rows).max(1, initial=0.0)
    scale = np.clip(step, peak / _MOST, peak).astype(np.float32)
    steps = np.where(scale > 0.0, scale, 1.0).astype(np.float64)
    return np.clip(np.rint(rows / steps[:, None]), -_MOST, _MOST).astype(np.int16), scale


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _apply(component, scale, light, rows, out):  # type: ignore[no-untyped-def]
    """E L of components e = rows[r] of (E, N out, C, m, N in), of scale[e], into out[e] (3, N)."""
    size = light.shape[0] * light.shape[2]
    laid = np.ascontiguousarray(light.transpose(1, 0, 2)).reshape(3, size)
    flat = component.reshape(len(component), component.shape[1], component.shape[2], size)
    red, green, blue = laid[0], laid[1], laid[2]
    for r in range(len(rows)):
        e = rows[r]
        for i in range(flat.shape[1]):
            p, q, w = flat[e, i, 0], flat[e, i, flat.shape[2] // 2], flat[e, i, flat.shape[2] - 1]
            x = y = z = np.float32(0.0)
            if flat.shape[2] == 1:
                for k in range(size):
                    value = np.float32(p[k])
                    x += value * red[k]
                    y += value * green[k]
                    z += value * blue[k]
            else:
                for k in range(size):
                    x += np.float32(p[k]) * red[k]
                    y += np.float32(q[k]) * green[k]
                    z += np.float32(w[k]) * blue[k]
            out[e, 0, i], out[e, 1, i], out[e, 2, i] = scale[e] * x, scale[e] * y, scale[e] * z


@njit(cache=True, nogil=True, fastmath={"contract"})
def _combine(which, cluster, start, first, coefficient, scale, seen, out):  # type: ignore[no-untyped-def]
    for r in range(len(which)):
        s = which[r]
        a = start[cluster[s]]
        at = first[s]
        own = out[r]
        own[:] = seen[a]
        count = first[s + 1] - at
        for j in range(0, count - count % 4, 4):
            b, p = a + 1 + j, at + j
            w, x = coefficient[p] * scale[b], coefficient[p + 1] * scale[b + 1]
            y, z = coefficient[p + 2] * scale[b + 2], coefficient[p + 3] * scale[b + 3]
            e, f, g, h = seen[b], seen[b + 1], seen[b + 2], seen[b + 3]
            for k in range(len(own)):
                own[k] += w * e[k] + x * f[k] + y * g[k] + z * h[k]
        for j in range(count - count % 4, count):
            w, term = coefficient[at + j] * scale[a + 1 + j], seen[a + 1 + j]
            for k in range(len(own)):
                own[k] += w * term[k]
