"""Haar transforms of cube faces, and the strongest coefficients of receivers' transfer, against PyWavelets.

The transform is the same (orthonormal, nested, all levels), so that coefficients can be compared one by one. For
transfer the peer does what a script would: texels times cosines, PyWavelets for all receivers of a batch at once, NumPy
to choose the strongest.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Report, Row
from benchmarks.scenes import Setting, main_store
from benchmarks.tensors import fastest

COEFFICIENTS = 128
FACES = 96


def forward_peer(faces: NDArray[np.float64]) -> list[Any]:
    """The coefficients (..., R, R) of all levels, as PyWavelets has them."""
    import pywt

    found: list[Any] = pywt.wavedec2(faces, "haar", mode="periodization")
    return found


def as_array(coefficients: list[Any]) -> NDArray[np.float64]:
    """PyWavelets' coefficients (..., R, R) in our nested layout: their vertical details are our differences along a
    row, upper right."""
    size = coefficients[-1][0].shape[-1] * 2
    out = np.empty((*coefficients[0].shape[:-2], size, size))
    out[..., :1, :1] = coefficients[0]
    for horizontal, vertical, diagonal in coefficients[1:]:
        half = horizontal.shape[-1]
        out[..., :half, half : 2 * half] = vertical
        out[..., half : 2 * half, :half] = horizontal
        out[..., half : 2 * half, half : 2 * half] = diagonal
    return out


def strongest_peer(
    bits: NDArray[np.uint8],
    normals: NDArray[np.float32],
    directions: NDArray[np.float32],
    solid_angle: NDArray[np.float32],
    count: int,
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """As `haar.truncated_cosine_transfer`: indices and values (N, count), in any order."""
    from relightcli.core.sphere.haar import support_areas

    resolution = bits.shape[2]
    seen = np.unpackbits(bits, axis=-1, bitorder="little").reshape(len(bits), -1)
    cosine = np.maximum(normals @ directions.T, 0.0) * np.tile(solid_angle / np.float32(np.pi), 6)
    faces = (seen * cosine).reshape(len(bits), 6, resolution, resolution)
    flat = as_array(forward_peer(faces)).reshape(len(bits), -1)
    rank = np.abs(flat) * np.tile(support_areas(resolution).reshape(-1), 6)
    index = np.argpartition(-rank, count, axis=1)[:, :count]
    return index, np.take_along_axis(flat, index, axis=1)


def measure(setting: Setting) -> Report:
    import relight_formats as formats
    from relightcli.core.sphere import cube, haar

    store = formats.open_store(main_store(setting))
    bits = store.read("visibility/bits")[: 64 if setting.quick else 512]
    normals = store.read("receivers/normal")[: len(bits)].astype(np.float32)
    resolution = bits.shape[2]
    directions = cube.texel_directions(resolution).reshape(-1, 3).astype(np.float32)
    solid_angle = cube.solid_angles(resolution).astype(np.float32).reshape(-1)
    report = Report(f"R = {resolution}; the fastest call each, one thread")
    peer = find_spec("pywt") is not None
    if not peer:
        report.skipped.append("PyWavelets is not installed: pip install 'relightcli[bench]'")

    faces = np.random.default_rng(0).standard_normal((FACES, resolution, resolution))
    seconds, found = fastest(lambda: haar.forward(faces))
    back_seconds, _ = fastest(lambda: haar.inverse(found))
    there, back = f"forward transform of {FACES} faces", f"inverse transform of {FACES} faces"
    if peer:
        import pywt

        theirs, coefficients = fastest(lambda: forward_peer(faces))
        back_theirs, _ = fastest(lambda: pywt.waverec2(coefficients, "haar", mode="periodization"))
        report.rows += [
            Row(there, 1e3 * seconds, "ms", f"PyWavelets: {1e3 * theirs:.3g} ms", theirs / seconds),
            Row(back, 1e3 * back_seconds, "ms", f"PyWavelets: {1e3 * back_theirs:.3g} ms", back_theirs / back_seconds),
            Row("largest difference of coefficients", float(np.abs(as_array(coefficients) - found).max()), ""),
        ]
    else:
        report.rows += [Row(there, 1e3 * seconds, "ms"), Row(back, 1e3 * back_seconds, "ms")]

    given = (bits, normals, directions, solid_angle, COEFFICIENTS)
    seconds, (_, value, _) = fastest(lambda: haar.truncated_cosine_transfer(*given))
    rate = len(bits) / seconds
    work = f"receivers, {COEFFICIENTS} strongest coefficients of their transfer"
    if peer:
        theirs, (_, their_value) = fastest(lambda: strongest_peer(*given))
        against = f"PyWavelets and NumPy: {len(bits) / theirs:,.0f} receivers/s"
        report.rows.append(Row(work, rate, "receivers/s", against, theirs / seconds))
        kept, their_kept = (float((v.astype(np.float64) ** 2).sum()) for v in (value, their_value))
        report.rows.append(Row("energy kept, relative to the peer's", kept / their_kept, ""))
    else:
        report.rows.append(Row(work, rate, "receivers/s"))
    return report
