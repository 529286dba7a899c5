"""Bit packing: order fixed by hand, round trip by chance."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from relight_formats import pack_bits, unpack_bits


def test_element_0_is_bit_0_of_byte_0() -> None:
    row = np.zeros(10, dtype=bool)
    row[[0, 3, 9]] = True
    np.testing.assert_array_equal(pack_bits(row), np.array([0b0000_1001, 0b0000_0010], dtype=np.uint8))


@given(arrays(bool, array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=19)))
def test_round_trip(values: np.ndarray) -> None:
    packed = pack_bits(values)
    assert packed.shape == (*values.shape[:-1], -(-values.shape[-1] // 8))
    back = unpack_bits(packed, values.shape[-1])
    assert back.dtype == np.bool_
    np.testing.assert_array_equal(back, values)


@given(st.integers(1, 40))
def test_bits_past_the_end_are_zero(count: int) -> None:
    packed = pack_bits(np.ones(count, dtype=bool))
    assert int(np.unpackbits(packed).sum()) == count


@pytest.mark.parametrize("bad", [np.zeros(8, dtype=np.uint8), np.array(True), np.zeros(3)])
def test_packing_takes_booleans_with_an_axis(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="expected booleans"):
        pack_bits(bad)


@pytest.mark.parametrize(
    ("packed", "count"),
    [
        (np.zeros(2, np.uint8), 8),
        (np.zeros(2, np.uint8), 17),
        (np.zeros(2, np.uint8), -1),
        (np.zeros(2, np.int8), 16),
        (np.array(3, np.uint8), 8),
    ],
)
def test_unpacking_needs_a_count_that_fits(packed: np.ndarray, count: int) -> None:
    with pytest.raises(ValueError, match="expected uint8 with a last axis"):
        unpack_bits(packed, count)
