"""FLIP, the perceived difference of two pictures shown in alternation, from NVIDIA's `flip_evaluator`.

Sources: [Andersson2020] FLIP: A Difference Evaluator for Alternating Images, HPG 2020 (LDR).
[Andersson2021] Visualizing Errors in Rendered High Dynamic Range Images, Eurographics Short Papers 2021 (HDR: per pixel
the largest LDR error over a range of exposures, which follows from the reference's median and maximum).

The library ends the whole process when it finds no exposure range, which a black or nearly black reference causes, and
passes over NaN; so it only gets what it can bear.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
# Outside these luminances (the reference's largest) both pictures are scaled by a power of two: the library takes less
# than 2^-23 for black, and larger values overflow.
_LEAST, _LARGEST = 2.0**-20, 2.0**40
# Test pixels brighter than this many times the reference's largest luminance are white at every exposure anyway.
_GLARE = 2.0**20


def flip_ldr(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """FLIP of display pictures at the library's default 67 pixels per degree [Andersson2020].

    a, b (H, W, 3) finite, linear Rec.709; clipped to 0..1, what a display can show. Returns (H, W) float32, 0..1.
    """
    return _evaluate(np.clip(a, 0, 1), np.clip(b, 0, 1), "LDR")


def flip_hdr(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """FLIP of scene-linear pictures, b the reference [Andersson2021]; negative values count as 0.

    Where the reference is black, the exposures follow from `a`.
    a, b (H, W, 3) finite, linear Rec.709. Returns (H, W) float32, 0..1.
    """
    test, reference = np.maximum(a, 0).astype(np.float64), np.maximum(b, 0).astype(np.float64)
    brightest = float((reference @ _LUMINANCE).max(initial=0))
    if brightest == 0:
        test, reference = reference, test
        brightest = float((reference @ _LUMINANCE).max(initial=0))
    if brightest == 0:
        return np.zeros(a.shape[:2], np.float32)
    if not _LEAST <= brightest <= _LARGEST:
        scale = 2.0 ** -np.floor(np.log2(brightest))
        test, reference, brightest = test * scale, reference * scale, brightest * scale
    test = np.minimum(test, brightest * _GLARE)
    return _evaluate(test.astype(np.float32), reference.astype(np.float32), "HDR")


def _evaluate(test: NDArray[np.float32], reference: NDArray[np.float32], dynamic_range: str) -> NDArray[np.float32]:
    if np.array_equal(test, reference):
        return np.zeros(test.shape[:2], np.float32)
    import flip_evaluator

    errors, _, _ = flip_evaluator.evaluate(
        np.ascontiguousarray(reference, np.float32),
        np.ascontiguousarray(test, np.float32),
        dynamic_range,
        inputsRGB=False,
        applyMagma=False,
        computeMeanError=False,
    )
    return np.asarray(errors, np.float32).reshape(test.shape[:2])
