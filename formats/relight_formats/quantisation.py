"""Numbers as small integers times a scale: the error is at most half a scale, and the scale is stored."""

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Code = Literal["int8", "uint8", "int16"]

LARGEST: dict[str, int] = {"int8": 127, "uint8": 255, "int16": 32767}
"""Largest code of each type; signed codes are symmetric, -128 and -32768 are not used."""


def quantise(
    values: Any, dtype: Code, *, axis: int | tuple[int, ...] = -1, least: float = 0.0
) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Round to the nearest multiple of a scale: q = rint(v / s), s = max(max |v| / q_max over `axis`, least).

    `axis=-1` gives one scale per row; all axes but the first give one per receiver; reshape to (blocks, rows, ...) for
    one per block. |v - q s| <= s / 2 holds exactly in real arithmetic.

    Args:
        values: real numbers, any shape with at least one axis; not negative for `uint8`.
        dtype: type of the codes.
        axis: the axes that share a scale.
        least: no scale is smaller, but 0 of all-zero rows. What is small beside it becomes zeros, which compress well.

    Returns:
        codes, shape of `values`; scales, float32, the axes that share one kept with size 1. All-zero rows have scale 0.

    Raises:
        ValueError: NaN or infinite values, negative ones for `uint8`, a scale beyond float32, an unknown `dtype`.
    """
    if dtype not in LARGEST:
        raise ValueError(f"quantise: dtype {dtype!r} is not one of {', '.join(LARGEST)}.")
    exact = np.asarray(values, dtype=np.float64)
    if not np.isfinite(exact).all():
        raise ValueError(
            f"quantise: expected finite values, found {np.count_nonzero(~np.isfinite(exact))} that are not."
        )
    if dtype == "uint8" and (exact < 0).any():
        raise ValueError(f"quantise: expected values of 0 or more for uint8, found {exact.min()}.")
    top = LARGEST[dtype]
    peak = np.abs(exact).max(axis=axis, keepdims=True, initial=0.0)
    if (peak / top > np.finfo(np.float32).max).any():
        raise ValueError(f"quantise: {peak.max()} needs a scale beyond float32.")
    scale = (peak / top).astype(np.float32)
    # A scale rounded down would push the peak past the largest code; for denormal scales by far.
    short = scale.astype(np.float64) * top < peak
    scale = np.where(short, np.nextafter(scale, np.float32(np.inf)), scale)
    if not np.isfinite(scale).all():
        raise ValueError(f"quantise: {peak.max()} needs a scale beyond float32.")
    scale = np.where(scale > 0, np.maximum(scale, np.float32(least)), scale)
    codes = np.rint(exact / np.where(scale > 0, scale, 1).astype(np.float64))
    return codes.astype(dtype), scale


def dequantise(codes: NDArray[Any], scale: NDArray[np.float32]) -> NDArray[np.float32]:
    """v = q s, computed in float64 and rounded once to float32.

    Args:
        codes: as returned by `quantise`.
        scale: float32, broadcast against `codes`.

    Returns:
        float32, shape of `codes`. Besides s / 2 the error holds one rounding to float32, at most 6e-8 |v|.
    """
    return (codes.astype(np.float64) * scale.astype(np.float64)).astype(np.float32)
