"""Quantisation: error at most half a scale, over the whole range of float32."""

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from relight_formats import dequantise, quantise

ULP = 2.0**-23
"""A scale is rounded to float32, and up by one step where it came out short."""

SIGNED = arrays(
    np.float32,
    array_shapes(min_dims=1, max_dims=3, max_side=6),
    elements=st.floats(-(2.0**126), 2.0**126, width=32, allow_subnormal=True),
)


def check(values: np.ndarray, dtype: Any, axis: Any) -> None:
    codes, scale = quantise(values, dtype, axis=axis)
    assert codes.dtype == dtype
    assert scale.dtype == np.float32
    assert codes.shape == values.shape
    exact = values.astype(np.float64)
    product = codes.astype(np.float64) * scale
    # The bound holds in real arithmetic; float64 products of an integer and a float32 are exact, and the quotient that
    # is rounded is off by 2^-53 of itself, at most 32767 * 2^-53 < 1e-11 of a scale.
    assert (np.abs(exact - product) <= scale.astype(np.float64) * (0.5 + 1e-11)).all()
    back = dequantise(codes, scale)
    assert back.dtype == np.float32
    # One rounding to float32: 2^-24 relative, and half the least denormal, 2^-150, near zero.
    assert (np.abs(back - product) <= np.abs(product) * 2.0**-24 + 2.0**-150).all()


@given(SIGNED, st.sampled_from(["int8", "int16"]))
@example(np.array([1e-45, 2e-43], dtype=np.float32), "int16")
@example(np.array([1e-45], dtype=np.float32), "int8")
def test_error_is_at_most_half_a_scale(values: np.ndarray, dtype: str) -> None:
    check(values, dtype, -1)
    check(values, dtype, tuple(range(values.ndim)))


@given(SIGNED)
def test_error_of_unsigned_codes(values: np.ndarray) -> None:
    check(np.abs(values), "uint8", -1)


@pytest.mark.parametrize(("dtype", "top"), [("int8", 127), ("int16", 32767), ("uint8", 255)])
def test_the_largest_value_takes_the_largest_code(dtype: Any, top: int) -> None:
    codes, scale = quantise(np.array([[0.0, 1.0], [0.0, 8.0]]), dtype)
    np.testing.assert_array_equal(codes, [[0, top], [0, top]])
    np.testing.assert_allclose(scale, [[1 / top], [8 / top]], rtol=ULP)


def test_negative_values_do_not_wrap_around() -> None:
    codes, _ = quantise(np.array([-1.0, 1.0]), "int8")
    np.testing.assert_array_equal(codes, [-127, 127])


def test_rows_of_zeros_have_scale_zero_and_come_back_as_zeros() -> None:
    codes, scale = quantise(np.zeros((2, 3)), "int8")
    assert (scale == 0).all()
    np.testing.assert_array_equal(dequantise(codes, scale), np.zeros((2, 3), np.float32))


def test_one_scale_per_block_by_reshaping() -> None:
    rows = np.repeat([1.0, 100.0], 4).reshape(8, 1)
    _, scale = quantise(rows.reshape(2, 4, 1), "int8", axis=(1, 2))
    assert scale.shape == (2, 1, 1)
    np.testing.assert_allclose(scale.ravel(), [1 / 127, 100 / 127], rtol=ULP)


def test_empty_arrays() -> None:
    codes, scale = quantise(np.zeros((0, 3)), "int8")
    assert (codes.shape, scale.shape) == ((0, 3), (0, 1))
    codes, scale = quantise(np.zeros((3, 0)), "int8")
    assert (codes.shape, scale.shape) == ((3, 0), (3, 1))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="found 1 that are not"):
        quantise(np.array([1.0, bad]), "int8")


def test_negative_values_are_refused_for_unsigned_codes() -> None:
    with pytest.raises(ValueError, match="0 or more for uint8, found -2"):
        quantise(np.array([1.0, -2.0]), "uint8")


def test_scales_beyond_float32_are_refused() -> None:
    with pytest.raises(ValueError, match="beyond float32"):
        quantise(np.array([1e300]), "int8")


def test_unknown_codes_are_refused() -> None:
    with pytest.raises(ValueError, match="is not one of int8, uint8, int16"):
        quantise(np.zeros(3), "int4")  # type: ignore[arg-type]


def test_least_scale():
    codes, scale = quantise(np.array([[127.0, 0.6], [2.6, 1.4], [0.3, 0.4], [0.0, 0.0]]), "int8", least=1.0)
    np.testing.assert_array_equal(scale, [[1.0], [1.0], [1.0], [0.0]])
    np.testing.assert_array_equal(codes, [[127, 1], [3, 1], [0, 0], [0, 0]])
