"""The estimates against pictures whose truth and noise are known."""

import numpy as np
import pytest

from relightcli.core.measure.noise_free import difference_noise, power, squared_error, squared_error_noise

TRIALS = 400
SHAPE = (12, 16, 3)


@pytest.fixture(scope="module")
def trials():
    """Truth, an inexact picture, another one, the references' variance, and many pairs of references."""
    random = np.random.default_rng(3)
    truth = random.uniform(0.2, 2.0, SHAPE)
    ours = truth * (1 + 0.05 * random.standard_normal(SHAPE))
    other = ours + 0.01 * random.standard_normal(SHAPE)
    deviation = 0.3 * truth
    # The colours of a pixel share their noise, as those of a path do.
    noise = random.standard_normal((2, TRIALS, *SHAPE[:2], 1)) * deviation
    return truth, ours, other, deviation**2, truth + noise[0], truth + noise[1]


def test_the_mean_is_free_of_noise_and_the_standard_error_is_right(trials):
    truth, ours, _, variance, a, b = trials
    exact = np.mean((ours - truth) ** 2)
    found = np.array([squared_error(ours, p, q) for p, q in zip(a, b, strict=True)])
    spread = found.std(ddof=1)
    assert abs(found.mean() - exact) < 4 * spread / np.sqrt(TRIALS)  # four standard errors of the mean
    # One reference alone counts its noise as error: 0.09 mean truth^2 on top.
    assert np.mean((ours - a[0]) ** 2) > 10 * exact
    # Fully correlated colours are what the estimate assumes. Its e^2, clamped at 0, overstates: at most by half here.
    told = [squared_error_noise(ours, p, q, variance, variance) for p, q in zip(a[:20], b[:20], strict=True)]
    assert spread * 0.9 < np.mean(told) < 1.5 * spread


def test_the_power_is_that_of_the_truth(trials):
    truth, _, _, _, a, b = trials
    found = np.array([power(p, q) for p, q in zip(a, b, strict=True)])
    assert abs(found.mean() - np.mean(truth**2)) < 4 * found.std(ddof=1) / np.sqrt(TRIALS)


def test_two_pictures_are_told_apart_far_below_the_noise_of_either(trials):
    _, ours, other, variance, a, b = trials
    found = np.array([squared_error(ours, p, q) - squared_error(other, p, q) for p, q in zip(a, b, strict=True)])
    told = difference_noise(ours, other, variance, variance)
    # The colours of d differ in sign here, so that some noise cancels, which the estimate does not count on.
    assert found.std(ddof=1) < 1.1 * told
    assert told < 0.2 * squared_error_noise(ours, a[0], b[0], variance, variance)


def test_equal_pictures_have_no_error_and_no_noise_without_variance():
    x = np.full(SHAPE, 0.5, np.float32)
    zero = np.zeros(SHAPE)
    assert squared_error(x, x, x) == 0
    assert squared_error_noise(x, x, x, zero, zero) == 0
    assert difference_noise(x, x, zero + 1, zero) == 0
