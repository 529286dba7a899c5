"""A perceptual colour map for errors: dark is small, bright is large, in grey print too."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# "Magma" by Stefan van der Walt and Nathaniel Smith (matplotlib, CC0) at 0, 1/16, ... 1, display sRGB.
# fmt: off
_MAGMA: NDArray[np.float64] = np.array([
    (0, 0, 4), (10, 8, 34), (29, 17, 71), (54, 16, 107), (81, 18, 124), (106, 28, 129),
    (131, 38, 129), (156, 46, 127), (183, 55, 121), (208, 65, 111), (231, 82, 99), (245, 107, 92),
    (252, 137, 97), (254, 167, 114), (254, 196, 136), (253, 226, 163), (252, 253, 191),
], dtype=np.float64)
# fmt: on


def heatmap(error: NDArray[np.floating[Any]], largest: float) -> NDArray[np.uint8]:
    """Colours for errors from 0 (black) to `largest` and above (pale yellow); NaN and infinity are cyan.

    error (H, W), >= 0; largest > 0. Returns (H, W, 3) uint8, display sRGB.
    """
    values = np.asarray(error, np.float64)
    finite = np.isfinite(values)
    place = np.clip(np.where(finite, values, 0) / largest, 0, 1) * (len(_MAGMA) - 1)
    steps = np.arange(len(_MAGMA))
    colours = np.stack([np.interp(place, steps, _MAGMA[:, c]) for c in range(3)], axis=-1)
    colours[~finite] = (0, 255, 255)
    return np.rint(colours).astype(np.uint8)
