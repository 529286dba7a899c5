"""How far a picture A lies from a reference B: RMS, relative RMS, PSNR, over a whole array or per pixel.

All take colours without alpha. Associated alpha needs no weighting here: RGB is already the light that reaches the
pixel. Sums run in float64. Nothing here accepts NaN or infinity quietly: they come out as NaN or infinity.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]


def rmse(a: Array, b: Array) -> float:
    """sqrt(mean (a - b)^2) over all elements. a, b: one shape, any unit. Returns that unit."""
    difference = np.asarray(a, np.float64) - np.asarray(b, np.float64)
    return math.sqrt(np.mean(np.square(difference))) if difference.size else 0.0


def relative_rmse(a: Array, b: Array) -> float:
    """||a - b||_2 / ||b||_2 over all elements, b the reference. a, b: one shape, any unit. Returns a ratio.

    Against a reference of nothing but zeros it is 0 if `a` is zero too, else infinite.
    """
    return _ratio(rmse(a, b), _rms(b))


def psnr(a: Array, b: Array, peak: float | None = None) -> float:
    """20 log10(peak / rmse(a, b)) in decibels.

    a, b: one shape; peak: the largest possible value (1 for display pictures), by default the largest in the reference.
    Returns infinity for equal arrays, minus infinity for a peak of 0 and arrays that differ.
    """
    return float(decibels(np.array(rmse(a, b)), _peak(b) if peak is None else peak))


def pixel_rmse(a: Array, b: Array) -> NDArray[np.float64]:
    """sqrt(mean over colours of (a - b)^2) per pixel. a, b (..., C). Returns (...), in their unit."""
    difference = np.asarray(a, np.float64) - np.asarray(b, np.float64)
    per_pixel: NDArray[np.float64] = np.sqrt(np.mean(np.square(difference), axis=-1))
    return per_pixel


def pixel_relative_rmse(a: Array, b: Array) -> NDArray[np.float64]:
    """`pixel_rmse` over the RMS of the whole reference, so that the RMS over all pixels is `relative_rmse`.

    a, b (..., C). Returns (...), a ratio; against a black reference 0 or infinite, pixel by pixel.
    """
    error, scale = pixel_rmse(a, b), _rms(b)
    if scale > 0:
        return error / scale
    return np.where(error > 0, np.inf, 0.0)


def decibels(error: NDArray[np.float64], peak: float) -> NDArray[np.float64]:
    """20 log10(peak / error), elementwise; infinite where the error is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        level: NDArray[np.float64] = 20 * (np.log10(np.float64(peak)) - np.log10(np.maximum(error, 0)))
    return np.where(error == 0, np.inf, level)


def _rms(values: Array) -> float:
    return math.sqrt(np.mean(np.square(np.asarray(values, np.float64)))) if np.size(values) else 0.0


def _peak(values: Array) -> float:
    return max(float(np.max(values)), 0.0) if np.size(values) else 0.0


def _ratio(error: float, scale: float) -> float:
    if scale > 0 or math.isnan(error) or math.isnan(scale):
        return error / scale
    return math.inf if error > 0 else 0.0
