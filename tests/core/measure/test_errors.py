"""Metrics by hand, their relations, and their edges."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from relightcli.core.measure import psnr, relative_rmse, rmse
from relightcli.core.measure.errors import pixel_relative_rmse, pixel_rmse
from relightcli.core.measure.heatmap import heatmap

A = np.array([[[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]])
B = np.array([[[1.0, 2.0, 1.0], [0.0, 1.0, 0.0]]])  # differences 2 and 1 of six, |B|^2 = 7


def test_values_by_hand():
    assert_allclose(rmse(A, B), math.sqrt(5 / 6), rtol=1e-15)
    assert_allclose(relative_rmse(A, B), math.sqrt(5 / 7), rtol=1e-15)
    assert_allclose(psnr(A, B), 20 * math.log10(2 / math.sqrt(5 / 6)), rtol=1e-14)
    assert_allclose(psnr(A, B, peak=1), -20 * math.log10(math.sqrt(5 / 6)), rtol=1e-14)
    assert_allclose(pixel_rmse(A, B), [[math.sqrt(4 / 3), math.sqrt(1 / 3)]], rtol=1e-15)


def test_pixels_add_up_to_the_picture():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 7, 5, 3))
    assert_allclose(np.sqrt(np.mean(pixel_rmse(a, b) ** 2)), rmse(a, b), rtol=1e-12)
    assert_allclose(np.sqrt(np.mean(pixel_relative_rmse(a, b) ** 2)), relative_rmse(a, b), rtol=1e-12)


def test_relative_error_does_not_depend_on_the_unit():
    assert_allclose(relative_rmse(A * 1e-30, B * 1e-30), relative_rmse(A, B), rtol=1e-12)
    assert_allclose(psnr(A * 1e30, B * 1e30), psnr(A, B), rtol=1e-12)


def test_float32_sums_keep_their_digits():
    # 2^25 ones and one more: a float32 sum stops counting at 2^24.
    a = np.ones(2**25, np.float32)
    b = np.zeros(2**25, np.float32)
    assert_allclose(rmse(a, b), 1, rtol=1e-12)
    # A sun of 1e6 beside a sky of 1e-3 that is 1 % wrong.
    b = np.full(1000, 1e-3, np.float32)
    a = b * np.float32(1.01)
    a[0] = b[0] = 1e6
    assert_allclose(rmse(a, b), 1e-5 * math.sqrt(0.999), rtol=1e-4)  # 1.01e-3 is rounded to float32, 6e-6 of the 1 %


def test_equal_and_black():
    zero = np.zeros((2, 2, 3))
    assert rmse(B, B) == 0
    assert relative_rmse(B, B) == 0
    assert psnr(B, B) == math.inf
    assert relative_rmse(zero, zero) == 0
    assert relative_rmse(zero + 1, zero) == math.inf
    assert psnr(zero, zero) == math.inf
    assert psnr(zero + 1, zero) == -math.inf
    assert_array_equal(pixel_relative_rmse(np.array([[1.0], [0.0]]), np.zeros((2, 1))), [np.inf, 0])


@pytest.mark.parametrize("measure", [rmse, relative_rmse, psnr])
def test_nan_is_never_hidden(measure):
    broken = A.copy()
    broken[0, 0, 0] = np.nan
    assert math.isnan(measure(broken, B))


def test_heatmap_goes_from_dark_to_bright():
    error = np.linspace(0, 1, 33)[None]
    colours = heatmap(error, 1.0).astype(int)
    assert_array_equal(colours[0, 0], [0, 0, 4])
    assert_array_equal(colours[0, -1], [252, 253, 191])
    assert np.all(np.diff(colours[0] @ [0.2126, 0.7152, 0.0722]) > 0)
    assert_array_equal(heatmap(np.array([[5.0]]), 1.0)[0, 0], [252, 253, 191])
    assert_array_equal(heatmap(np.array([[np.nan, np.inf]]), 1.0)[0], [[0, 255, 255]] * 2)
