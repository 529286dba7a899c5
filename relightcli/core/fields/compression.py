"""Radiance transfer fields in clusters of their own principal components. [Pan 2007, Eqs. 9 and 12]

A sample's transfer to all proxies is one row of m N N C numbers; in its cluster h

    M(r)  ~  E_h0 + sum over j of alpha_j(r) E_hj,

E_h0 the cluster's mean (which Eq. 9 lacks: the method it cites is affine). Reflected light is made in this form: first
E_hj L for the light at the proxies, once for all samples of a cluster, then the sum over j of every sample.

The clusters are found in the leading coordinates of one common basis that leaves less than a tenth of the tolerance:
distances stay nearly what they are, and D (2,000 and more) falls to hundreds. Terms are given out where they pay most
for their bytes, until the tolerance is met. Components are 8-bit integers with a scale for each; those whose rounding
would show have a second 8 bits, of what the first leave. Coefficients are 16-bit integers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.compress.cpca import cpca
from relightcli.core.compress.tucker import gram_spectrum
from relightcli.errors import NumericalError

CLUSTERS = 32
TERMS = 16
MOST_COMMON = 384  # directions of the common basis
MOST_TOLD_APART = 64  # leading ones of them that clusters are found by
_STEPS, _COEFFICIENT_STEPS = 127, 32767
_FINER = np.float32(254.0)  # half a step is 127 of these
_ROUNDING = 0.1  # share of the error that rounding may have, in squares
_FLOOR = 1e-4  # of the norm: far below what a few bits of components leave


@dataclass(frozen=True)
class CompressedTransfer:
    """Transfer of all samples of a field; see `Transfer` of `fields.entities`.

    shape m, N, N, C of a sample; cluster (samples,) uint8 or int32
    start (K + 1,) int32: components of cluster h are start[h] to start[h + 1], the mean first
    component (E, m N N C) int8 and its scale (E,) float32; finer (G, m N N C) int8 in steps of 1/254 of the scale, to
    be added to the components refined (G,) int32
    first (samples + 1,) int64: a sample's coefficients, all but the mean's, in coefficient (A,) int16; their scale is
    that of the component, coefficient_scale (E,) float32
    error: |M - M~| / |M|, Frobenius, over all samples, quantisation included
    """

    shape: tuple[int, int, int, int]
    cluster: NDArray[np.int32]
    start: NDArray[np.int32]
    component: NDArray[np.int8]
    scale: NDArray[np.float32]
    finer: NDArray[np.int8]
    refined: NDArray[np.int32]
    first: NDArray[np.int64]
    coefficient: NDArray[np.int16]
    coefficient_scale: NDArray[np.float32]
    error: float

    @property
    def nbytes(self) -> int:
        """Bytes kept: a cluster's number takes one, the places of coefficients follow from it."""
        arrays = (
            self.start,
            self.component,
            self.scale,
            self.finer,
            self.refined,
            self.coefficient,
            self.coefficient_scale,
        )
        return sum(a.nbytes for a in arrays) + len(self.cluster)

    def reflect(self, light: NDArray[np.floating], which: NDArray[np.integer]) -> NDArray[np.float32]:
        """Radiance (k, 3, N) float32 of the object seen from samples `which` (k,), light (m, 3, N) at its proxies."""
        m, n, _, colours = self.shape
        used = np.bincount(self.cluster[which], minlength=len(self.start) - 1) > 0
        rows = np.flatnonzero(np.repeat(used, np.diff(self.start)))
        # (m, N in, C) against (E, m, N out, N in, C), by the components of clusters that are read alone
        seen = np.zeros((len(self.component), 3, n), np.float32)
        light = np.ascontiguousarray(light, np.float32)
        shape = m, n, n, colours
        _apply(self.component.reshape(-1, *shape), self.scale, light, rows, rows, seen)
        fine = np.flatnonzero(np.isin(self.refined, rows))
        _apply(self.finer.reshape(-1, *shape), self.scale / _FINER, light, fine, self.refined[fine], seen)
        out = np.empty((len(which), 3, n), np.float32)
        _combine(
            which, self.cluster, self.start, self.first, self.coefficient, self.coefficient_scale,
            seen.reshape(len(seen), 3 * n), out.reshape(len(out), 3 * n),
        )  # fmt: skip
        return out

    def decompress(self) -> NDArray[np.float32]:
        """The transfer (samples, m, N, N, C) float32."""
        rows = np.empty((len(self.cluster), self.component.shape[1]), np.float32)
        for h in range(len(self.start) - 1):
            own = np.flatnonzero(self.cluster == h)
            a, b = self.start[h], self.start[h + 1]
            basis = self.component[a:b] * self.scale[a:b, None]
            fine = np.flatnonzero((self.refined >= a) & (self.refined < b))
            basis[self.refined[fine] - a] += self.finer[fine] * (self.scale[self.refined[fine], None] / _FINER)
            places = self.first[own, None] + np.arange(b - a - 1)
            alpha = self.coefficient[places] * self.coefficient_scale[a + 1 : b]
            rows[own] = basis[0] + alpha @ basis[1:]
        return rows.reshape(-1, *self.shape)


def compress(
    transfer: NDArray[np.float32],
    clusters: int = CLUSTERS,
    terms: int = TERMS,
    tolerance: float | None = None,
    seed: int = 0,
) -> CompressedTransfer:
    """Compresses a transfer (samples, m, N, N, C).

    terms: components of every cluster, the mean counted; tolerance: relative error in the Frobenius norm instead, with
    as many components in all as it takes, within a common basis of MOST_COMMON directions. Raises NumericalError for
    values that are not finite.
    """
    shape = transfer.shape[1:]
    rows = transfer.reshape(len(transfer), -1)
    norm2 = float(np.einsum("ij,ij->", rows, rows, dtype=np.float64))
    if not np.isfinite(norm2):
        raise NumericalError("compression of a transfer field: values that are not finite")
    goal2 = (0.0 if tolerance is None else tolerance) ** 2 * norm2
    rng = np.random.default_rng(seed)
    origin, basis, x, left2 = _common_basis(rows, max(goal2 / 100.0, _FLOOR**2 * norm2), rng)
    label = cpca(x[:, :MOST_TOLD_APART], clusters, max(1, terms - 1), seed).label
    count = int(label.max()) + 1
    means, vectors, gains = [], [], []
    for h in range(count):
        own = x[label == h]
        mean = own.mean(0)
        spectrum, directions = gram_spectrum((own - mean).T @ (own - mean))
        most = min(len(own) - 1, len(spectrum))
        means.append(mean)
        vectors.append(directions[:, :most])
        gains.append(np.maximum(spectrum[:most], 0.0))
    kept = [min(terms - 1, len(g)) for g in gains]
    if tolerance is not None:
        sizes = np.bincount(label)
        bytes_ = [rows.shape[1] + 8.0 + 2.0 * size for size in sizes]
        kept = _share_out(gains, bytes_, (1.0 - _ROUNDING) * goal2 - left2)
    start = np.zeros(count + 1, np.int32)
    start[1:] = np.cumsum(np.array(kept) + 1)
    alpha = [(x[label == h] - means[h]) @ vectors[h][:, : kept[h]] for h in range(count)]
    first = np.concatenate([[0], np.cumsum(np.array(kept)[label])]).astype(np.int64)
    component = np.empty((start[-1], rows.shape[1]), np.int8)
    scale, coefficient_scale = np.empty(start[-1], np.float32), np.ones(start[-1], np.float32)
    coefficient = np.empty(first[-1], np.int16)
    rest = np.empty((start[-1], rows.shape[1]), np.float32)  # what 8 bits leave of a component, in steps
    shown = np.empty(start[-1])  # its square sum in all samples
    for h in range(count):
        a, b = start[h], start[h + 1]
        full = np.concatenate([(origin + basis @ means[h])[None], (basis @ vectors[h][:, : kept[h]]).T])
        integers, scale[a:b] = _quantise(full, _STEPS)
        component[a:b] = integers
        rest[a:b] = full / np.where(scale[a:b] > 0.0, scale[a:b], 1.0)[:, None] - integers
        weight = np.concatenate([[float((label == h).sum())], gains[h][: kept[h]]])
        shown[a:b] = weight * (rest[a:b] ** 2).sum(1) * scale[a:b].astype(np.float64) ** 2
        integers, coefficient_scale[a + 1 : b] = _quantise(alpha[h].T, _COEFFICIENT_STEPS)
        coefficient[first[:-1][label == h, None] + np.arange(kept[h])] = integers.T
    left = left2 + sum(float(g[k:].sum()) for g, k in zip(gains, kept, strict=True))
    refined = _worst(shown, _ROUNDING * (left if tolerance is None else goal2))
    finer = np.clip(np.rint(rest[refined] * _FINER), -_STEPS, _STEPS).astype(np.int8)
    made = CompressedTransfer(
        shape, label, start, component, scale, finer, refined, first, coefficient, coefficient_scale, 0.0
    )
    missing = made.decompress().reshape(rows.shape) - rows
    error2 = float(np.einsum("ij,ij->", missing, missing, dtype=np.float64))
    return CompressedTransfer(**{**made.__dict__, "error": (error2 / norm2) ** 0.5 if norm2 > 0.0 else 0.0})


def _common_basis(
    rows: NDArray[np.float32], allowed: float, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64], float]:
    """The rows' mean (D,), an orthonormal basis (D, R), the coordinates (n, R) in it, and the square sum that it
    leaves: R as small as `allowed` says, at most MOST_COMMON.

    By a random sketch of the rows with one power step: a Gram matrix of D = 6,000 would cost ten times as much.
    """
    mean = rows.mean(0, dtype=np.float64).astype(np.float32)
    size = min(MOST_COMMON, *rows.shape)
    parts = [slice(a, a + 4096) for a in range(0, len(rows), 4096)]
    sketch = np.zeros((rows.shape[1], size))
    for part in parts:
        own = rows[part] - mean
        sketch += own.T @ rng.standard_normal((len(own), size), np.float32)
    for _ in range(2):
        basis, _ = np.linalg.qr(sketch)
        sketch = np.zeros_like(sketch)
        gram, total = np.zeros((size, size)), 0.0
        coordinates = np.empty((len(rows), size))
        for part in parts:
            own = rows[part] - mean
            along = own @ basis.astype(np.float32)
            sketch += own.T @ along
            coordinates[part] = along
            gram += coordinates[part].T @ coordinates[part]
            total += float(np.einsum("ij,ij->", own, own, dtype=np.float64))
    spectrum, vectors = gram_spectrum(gram)
    left = np.maximum(total - np.cumsum(spectrum), 0.0)
    keep = vectors[:, : int((left > allowed).sum()) + 1]
    return mean, basis @ keep, coordinates @ keep, float(left[keep.shape[1] - 1])


def _share_out(gains: list[NDArray[np.float64]], bytes_: list[float], allowed: float) -> list[int]:
    """Components for every cluster: the best gains for their bytes, until what is left is allowed."""
    owner = np.repeat(np.arange(len(gains)), [len(g) for g in gains])
    gain = np.concatenate(gains)
    best = np.argsort(-gain / np.array(bytes_)[owner], kind="stable")
    left = gain.sum() - np.cumsum(gain[best])
    enough = int((left > allowed).sum()) + 1 if gain.sum() > allowed else 0
    return np.bincount(owner[best[:enough]], minlength=len(gains)).tolist()


def _worst(shown: NDArray[np.float64], allowed: float) -> NDArray[np.int32]:
    """The fewest components, rising, without which the sum of `shown` is within what is allowed."""
    order = np.argsort(-shown, kind="stable")
    left = shown.sum() - np.concatenate([[0.0], np.cumsum(shown[order])])
    return np.sort(order[: int((left > allowed).sum())]).astype(np.int32)


def _quantise(rows: NDArray[np.float64], most: int) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Whole numbers (n, D) from -most to most, and scales (n,), of rows."""
    scale = (np.abs(rows).max(1, initial=0.0) / most).astype(np.float32)
    steps = np.where(scale > 0.0, scale, 1.0).astype(np.float64)
    return np.clip(np.rint(rows / steps[:, None]), -most, most), scale


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _apply(component, scale, light, rows, at, out):  # type: ignore[no-untyped-def]
    """Adds E L of components rows[r] (of (E, m, N, N, C)), of scale at[r], to out[at[r]] (3, N)."""
    colours = component.shape[4]
    for r in range(len(rows)):
        e, to = rows[r], at[r]
        for k in range(component.shape[1]):
            for i in range(component.shape[2]):
                for c in range(3):
                    total = np.float32(0.0)
                    if colours == 1:
                        for j in range(component.shape[3]):
                            total += component[e, k, i, j, 0] * light[k, c, j]
                    else:
                        for j in range(component.shape[3]):
                            total += component[e, k, i, j, c] * light[k, c, j]
                    out[to, c, i] += scale[to] * total


@njit(cache=True, nogil=True, fastmath={"contract"})
def _combine(which, cluster, start, first, coefficient, scale, seen, out):  # type: ignore[no-untyped-def]
    for r in range(len(which)):
        s = which[r]
        a = start[cluster[s]]
        at = first[s]
        for k in range(seen.shape[1]):
            out[r, k] = seen[a, k]
        for j in range(first[s + 1] - at):
            alpha = coefficient[at + j] * scale[a + 1 + j]
            for k in range(seen.shape[1]):
                out[r, k] += alpha * seen[a + 1 + j, k]
