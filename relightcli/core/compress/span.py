"""Columns that span all others: Cholesky's factors with pivots of a Gram matrix."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def span(
    gram: NDArray[np.float64], allowed: float = 0.0, most: int | None = None, group: int = 1
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Columns (r,) of a matrix with Gram matrix (n, n), and all columns (r, n) as their combinations, by least squares.

    Each one is the furthest from all combinations of those before. As many as leave `allowed` of the sum of squares,
    but at most `most`, filled up to whole groups. No linear algebra library is asked: the same bytes come out anywhere.
    """
    n = len(gram)
    left = np.diag(gram).copy()
    factors = np.zeros((n, n))
    chosen: list[int] = []
    while len(chosen) < (n if most is None else min(n, most)):
        if left.sum() <= allowed and len(chosen) % group == 0:
            break
        k, at = len(chosen), int(left.argmax())
        if not left[at] > 0.0:
            break
        so_far = (factors[:k, at, None] * factors[:k]).sum(axis=0)
        factors[k] = (gram[at] - so_far) / math.sqrt(left[at])
        factors[k, chosen] = 0.0
        left = np.maximum(left - factors[k] ** 2, 0.0)
        left[at] = 0.0
        chosen.append(at)
    columns = np.array(chosen, np.int64)
    basis = factors[: len(chosen)].copy()
    for k in range(len(chosen) - 1, -1, -1):  # back substitution: the chosen ones become the unit matrix
        basis[k] -= (basis[k, columns[k + 1 :], None] * basis[k + 1 :]).sum(axis=0)
        basis[k] /= factors[k, columns[k]]
    return columns, basis
