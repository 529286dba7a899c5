"""From scene-linear light to display values and back: the sRGB transfer curve and exposure in stops.

Source: IEC 61966-2-1:1999 (sRGB), section 4.4 (display to linear) and 4.5 (linear to display).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def decode_srgb(encoded: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Linear light of display values: x / 12.92 up to 0.04045, else ((x + 0.055) / 1.055)^2.4.

    encoded: any shape, display values, nominally 0..1; values above 1 follow the curve, negative ones its linear part.
    Returns float32 of the same shape.
    """
    x = np.asarray(encoded, np.float32)
    curve = ((np.maximum(x, 0) + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.where(x <= 0.04045, x / np.float32(12.92), curve).astype(np.float32)


def encode_srgb(linear: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Display values of linear light, clipped to 0..1: 12.92 x up to 0.0031308, else 1.055 x^(1/2.4) - 0.055.

    linear: any shape, scene-linear. NaN becomes 0, infinity 1. Returns float32 of the same shape, 0..1.
    """
    x = np.clip(np.nan_to_num(np.asarray(linear, np.float32), nan=0.0, posinf=1.0, neginf=0.0), 0, 1)
    curve = np.float32(1.055) * x ** np.float32(1 / 2.4) - np.float32(0.055)
    return np.where(x <= 0.0031308, x * np.float32(12.92), curve).astype(np.float32)


def to_display(linear: NDArray[np.floating[Any]], exposure: float = 0.0) -> NDArray[np.uint8]:
    """8-bit sRGB of scene-linear light times 2^exposure, rounded to nearest.

    linear: any shape; exposure in stops. Returns uint8 of the same shape.
    """
    scaled = np.asarray(linear, np.float64) * 2.0 ** min(max(exposure, -1000.0), 1000.0)  # beyond: black or white
    return np.rint(encode_srgb(scaled.astype(np.float32)) * 255).astype(np.uint8)
