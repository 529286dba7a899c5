"""Clustered principal component analysis: rows in groups, each near an affine subspace of its own. [Sloan 2003]

    x  ~  mu_c + E_c E_c' (x - mu_c)

Lloyd's scheme: a cluster's mean and its leading eigenvectors E_c, then every row to the cluster that leaves least of
it. Neither step can raise the total residual.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from relightcli.core.compress.tucker import gram_spectrum
from relightcli.core.parts import for_each, in_order
from relightcli.errors import NumericalError

ROUNDS = 12
_CONVERGED = 1e-3  # relative change of the residual at which a round was the last
_ROUND_OFF = 1e-9
_BLOCK = 4096  # rows that are compared at a time


@dataclass(frozen=True)
class Clusters:
    """label (N,) int32; count, clusters in use, each with at least one row; residuals, sums of squares after every
    round, never rising; norm2, of the rows."""

    label: NDArray[np.int32]
    count: int
    residuals: tuple[float, ...]
    norm2: float


def cpca(rows: NDArray[np.floating], clusters: int, terms: int, seed: int = 0, threads: int = 1) -> Clusters:
    """Groups rows (N, D) into at most `clusters`, each with `terms` eigenvectors, from k-means++ centres.

    A cluster that loses all its rows takes the worst row of the others. Raises NumericalError if the rows are not
    finite or the residual rises.
    """
    x = np.asarray(rows, np.float64)
    if not np.isfinite(x).all():
        raise NumericalError("clustering: rows that are not finite")
    n = len(x)
    norm2 = float((x**2).sum())
    # Distances are differences of squares below: what all rows have in common would take their digits.
    x = x - x.mean(0) if n else x
    clusters = max(1, min(clusters, n))
    square = (x**2).sum(1)
    label = _nearest(x, square, _plus_plus(x, square, clusters, np.random.default_rng(seed)))
    residuals: list[float] = []
    for _ in range(ROUNDS):
        subspaces = list(in_order(partial(_subspace, x, label, terms), range(clusters), threads))
        label, least = _assign(x, square, subspaces, threads)
        residuals.append(float(least.sum()))
        if len(residuals) > 1 and residuals[-1] > residuals[-2] + _ROUND_OFF * norm2:
            raise NumericalError(
                f"the residual of a clustering rose in round {len(residuals)}: {residuals[-2]:.17g} to "
                f"{residuals[-1]:.17g}."
            )
        empty = np.flatnonzero(np.bincount(label, minlength=clusters) == 0)
        for c in empty:
            worst = int(least.argmax())
            if not least[worst] > 0.0:
                break
            label[worst] = c
            least[worst] = 0.0
        if len(residuals) > 1 and residuals[-2] - residuals[-1] <= _CONVERGED * residuals[-2]:
            break
    used, compact = np.unique(label, return_inverse=True)
    return Clusters(compact.astype(np.int32), len(used), tuple(residuals), norm2)


def _subspace(
    x: NDArray[np.float64], label: NDArray[np.int32], terms: int, cluster: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Mean (D,) and leading eigenvectors (D, up to terms) of a cluster's rows; None without rows."""
    own = x[label == cluster]
    if not len(own):
        return None
    mean = own.mean(0)
    centred = own - mean
    count = min(terms, len(own) - 1)
    if count < 1 or not centred.any():
        return mean, np.zeros((len(mean), 0))
    _, vectors = gram_spectrum(centred.T @ centred)
    return mean, vectors[:, :count]


def _assign(
    x: NDArray[np.float64],
    square: NDArray[np.float64],
    subspaces: list[tuple[NDArray[np.float64], NDArray[np.float64]] | None],
    threads: int,
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """The cluster (N,) that leaves least of every row, and what it leaves (N,)."""
    label, least = np.empty(len(x), np.int32), np.empty(len(x))
    found = [(c, *subspace) for c, subspace in enumerate(subspaces) if subspace is not None]
    columns = np.concatenate([np.column_stack([mean, vectors]) for _, mean, vectors in found], axis=1)

    def part(first: int) -> None:
        rows = slice(first, first + _BLOCK)
        products = x[rows] @ columns
        distance = np.empty((len(products), len(found)))
        at = 0
        for k, (_, mean, vectors) in enumerate(found):
            along = products[:, at + 1 : at + 1 + vectors.shape[1]] - mean @ vectors
            distance[:, k] = square[rows] - 2.0 * products[:, at] + mean @ mean - (along**2).sum(1)
            at += 1 + vectors.shape[1]
        nearest = distance.argmin(1)
        label[rows] = np.array([c for c, _, _ in found])[nearest]
        least[rows] = np.maximum(distance[np.arange(len(nearest)), nearest], 0.0)

    for_each(part, range(0, len(x), _BLOCK), threads)
    return label, least


def _plus_plus(
    x: NDArray[np.float64], square: NDArray[np.float64], clusters: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """k-means++ centres: each new one a row drawn with the square of its distance from those before."""
    centres = [x[int(rng.integers(len(x)))]]
    least = np.full(len(x), np.inf)
    for _ in range(clusters - 1):
        centre = centres[-1]
        least = np.minimum(least, np.maximum(square - 2.0 * (x @ centre) + centre @ centre, 0.0))
        total = least.sum()
        if not total > 0.0:
            break
        centres.append(x[int(np.searchsorted(np.cumsum(least), rng.random() * total).clip(0, len(x) - 1))])
    return np.array(centres)


def _nearest(x: NDArray[np.float64], square: NDArray[np.float64], centres: NDArray[np.float64]) -> NDArray[np.int32]:
    distance = square[:, None] - 2.0 * (x @ centres.T) + (centres**2).sum(1)
    return distance.argmin(1).astype(np.int32)
