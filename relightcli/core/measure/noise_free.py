"""Error of a picture against noisy references, without the references' noise.

Two independent path-traced pictures A = T + m and B = T + n of the truth T have E[m] = E[n] = E[m n] = 0. For a
picture x = T + e the mean of (x - A)(x - B) = (e - m)(e - n) is therefore an estimate of mean e^2 that no noise adds
to; the mean of A B is one of mean T^2. It may come out below zero where e is far below the noise.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]


def squared_error(x: Array, a: Array, b: Array) -> float:
    """mean (x - a)(x - b): an unbiased estimate of mean (x - truth)^2. All of one shape; the unit squared."""
    x, a, b = (np.asarray(p, np.float64) for p in (x, a, b))
    return float(np.mean((x - a) * (x - b)))


def power(a: Array, b: Array) -> float:
    """mean a b: an unbiased estimate of mean truth^2."""
    return float(np.mean(np.asarray(a, np.float64) * np.asarray(b, np.float64)))


def squared_error_noise(x: Array, a: Array, b: Array, variance_a: Array, variance_b: Array) -> float:
    """Standard error of `squared_error`, from the variances of a and b per pixel and colour.

    Var (e - m)(e - n) = e^2 (va + vb) + va vb. Pixels are independent; the colours of one share their paths and are
    taken as fully correlated, which can only overstate. e^2 is estimated by max(0, (x - a)(x - b)).

    All (H, W, C). Returns the unit squared.
    """
    x, a, b, va, vb = (np.asarray(p, np.float64) for p in (x, a, b, variance_a, variance_b))
    e2 = np.maximum(0.0, (x - a) * (x - b))
    deviation = np.sqrt(e2 * (va + vb) + va * vb).sum(axis=-1)
    return float(np.sqrt(np.sum(deviation * deviation)) / x.size)


def difference_noise(x: Array, y: Array, variance_a: Array, variance_b: Array) -> float:
    """Standard error of squared_error(x, a, b) - squared_error(y, a, b), for two pictures against the same references.

    With d = x - y the difference is mean (e_x^2 - e_y^2 - d (m + n)): the noise of a and b counts where x and y differ
    only, Var = d^2 (va + vb). Colours as in `squared_error_noise`. All (H, W, C). Returns the unit squared.
    """
    x, y, va, vb = (np.asarray(p, np.float64) for p in (x, y, variance_a, variance_b))
    deviation = (np.abs(x - y) * np.sqrt(va + vb)).sum(axis=-1)
    return float(np.sqrt(np.sum(deviation * deviation)) / x.size)
