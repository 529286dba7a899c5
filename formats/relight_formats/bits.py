"""Booleans packed eight to a byte."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def pack_bits(values: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Pack along the last axis: element 8i + j is bit j (value 2^j) of byte i. Bits past the end are 0.

    Args:
        values: (..., n) bool, at least one axis.

    Returns:
        (..., ceil(n / 8)) uint8.

    Raises:
        ValueError: another data type, or no axis.
    """
    if values.dtype != np.bool_ or values.ndim == 0:
        raise ValueError(
            f"pack_bits: expected booleans with at least one axis, found {values.dtype} of shape {values.shape}."
        )
    return np.packbits(values, axis=-1, bitorder="little")


def unpack_bits(packed: NDArray[np.uint8], count: int) -> NDArray[np.bool_]:
    """The inverse of `pack_bits`.

    Args:
        packed: (..., ceil(count / 8)) uint8.
        count: number of booleans along the last axis.

    Returns:
        (..., count) bool.

    Raises:
        ValueError: another data type, or a last axis that does not fit `count`.
    """
    if packed.dtype != np.uint8 or packed.ndim == 0 or count < 0 or packed.shape[-1] != -(-count // 8):
        found: Any = (packed.dtype, packed.shape)
        raise ValueError(f"unpack_bits: expected uint8 with a last axis of ceil({count} / 8), found {found}.")
    # The result holds 0 and 1 only, so its bytes are valid booleans.
    return np.unpackbits(packed, axis=-1, count=count, bitorder="little").view(np.bool_)
