"""The window's kernel is nowhere negative, and what it smooths stays within its bounds."""

import numpy as np
import pytest

from relightcli.core.sphere import sh
from relightcli.core.sphere.rotation import quadrature
from relightcli.core.sphere.window import window
from tests.core.brdf.reflectances import random_directions


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5, 8])
def test_kernel_is_nowhere_negative(order):
    factors = window(order)
    assert factors[0] == pytest.approx(1.0, abs=1e-15)
    pole = sh.harmonics(np.array([0.0, 0.0, 1.0]), order)
    kernel = sh.harmonics(quadrature(80)[0], order) @ (factors * pole)
    assert kernel.min() >= -1e-13  # round-off
    if order > 1:
        # The cut delta itself rings (the negative lobe is -2 to -15 % of the peak): the window is what removes it.
        assert (sh.harmonics(quadrature(80)[0], order) @ pole).min() < -0.02


def test_order_two_is_known():
    # k = (1 + x) / 2: the mean of x is 1/3.
    np.testing.assert_allclose(window(2), [1, 1 / 3, 1 / 3, 1 / 3], atol=1e-14)


def test_hemisphere_stays_between_nothing_and_all():
    d, w = quadrature(120)
    for axis in random_directions(5, 1):
        seen = (d @ axis > 0).astype(float)
        cut = (w * seen) @ sh.harmonics(d, 4)
        plain = sh.harmonics(d, 4) @ cut
        smooth = sh.harmonics(d, 4) @ (window(4) * cut)
        assert plain.min() < -0.05
        assert plain.max() > 1.05
        # The step is integrated by points: not exactly the kernel's mean. 2e-3 by the 1.5 degrees between points.
        assert smooth.min() > -2e-3
        assert smooth.max() < 1 + 2e-3


def test_strength():
    np.testing.assert_array_equal(window(4, 0.0), np.ones(16))
    np.testing.assert_allclose(window(4, 0.5), 0.5 * (1 + window(4)))
