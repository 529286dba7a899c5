"""FLIP: values of the library where it can be called, and answers where it would end the process."""

import subprocess
import sys

import flip_evaluator
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from relightcli.adapters.flip import flip_hdr, flip_ldr

BLACK = np.zeros((8, 9, 3), np.float32)
NOISE = np.random.default_rng(3).random((8, 9, 3)).astype(np.float32)


@pytest.mark.parametrize("flip", [flip_ldr, flip_hdr])
def test_equal_pictures_have_no_error(flip):
    for picture in (BLACK, NOISE, BLACK - 1):
        assert_array_equal(flip(picture, picture), np.zeros((8, 9)))


def test_agrees_with_the_library():
    expected = flip_evaluator.evaluate(NOISE, 0.9 * NOISE, "HDR", applyMagma=False)[0]
    assert_array_equal(flip_hdr(np.float32(0.9) * NOISE, NOISE), expected[..., 0])
    expected = flip_evaluator.evaluate(NOISE, 0.9 * NOISE, "LDR", inputsRGB=False, applyMagma=False)[0]
    assert_array_equal(flip_ldr(np.float32(0.9) * NOISE, NOISE), expected[..., 0])


def test_black_against_white_is_nearly_one():
    # [Andersson2020]: the colour part saturates near 1 for black against white; the library gives 0.967.
    assert_allclose(flip_ldr(BLACK + 1, BLACK).mean(), 0.967, atol=0.01)


@pytest.mark.parametrize("exponent", [-60, -20, 20, 60])
def test_hdr_does_not_depend_on_the_unit_of_light(exponent):
    # A power of two scales float32 without rounding; the exposures move along, but for the rounding of their logarithm.
    scale = np.float32(2.0**exponent)
    assert_allclose(flip_hdr(NOISE[::-1] * scale, NOISE * scale), flip_hdr(NOISE[::-1], NOISE), atol=1e-4)


def test_what_would_end_the_process_does_not():
    """In a child, because a fault here would take the test run with it."""
    code = """
import numpy as np
from relightcli.adapters.flip import flip_hdr, flip_ldr
black, ones = np.zeros((5, 4, 3), np.float32), np.ones((5, 4, 3), np.float32)
spot = black.copy(); spot[2, 2] = 1e30
pictures = [black, black - 1, black + 0.5, spot, ones * 1e-30, ones * 1e-44, ones * 3e38, ones]
for a in pictures:
    for b in pictures:
        for flip in (flip_ldr, flip_hdr):
            error = flip(a, b)
            assert error.shape == (5, 4) and np.isfinite(error).all() and 0 <= error.min() and error.max() <= 1
one = flip_hdr(ones[:1, :1], 2 * ones[:1, :1])
assert one.shape == (1, 1)
print("done")
"""
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert child.stdout.strip() == "done", child.stderr


def test_black_reference_still_shows_the_difference():
    assert flip_hdr(NOISE, BLACK).mean() > 0.9
    assert flip_hdr(BLACK, NOISE).mean() > 0.9
