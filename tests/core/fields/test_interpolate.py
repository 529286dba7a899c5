"""Interpolation of fields: exact on samples, continuous everywhere, sound where samples are missing."""

import numpy as np
import pytest

from relightcli.core.fields.field import shell_radii
from relightcli.core.fields.interpolate import blend, locate, make_grid
from relightcli.core.sphere import cube
from tests.core.brdf.reflectances import random_directions

N = 6
RADII = shell_radii(1.0, 5)


def samples(radii=RADII, n=N):
    return (radii[:, None, None] * cube.texel_directions(n).reshape(1, -1, 3)).reshape(-1, 3)


def value(grid, points, values, empty=0.0):
    return blend(*locate(grid, points), values, np.float64(empty))


@pytest.mark.parametrize("logarithmic", [False, True])
def test_samples_are_their_own_value(logarithmic):
    grid = make_grid(RADII, N, logarithmic=logarithmic)
    values = np.random.default_rng(1).normal(size=len(samples()))
    # float32 weights; a sample on the outermost shell is also where the fading begins.
    np.testing.assert_allclose(value(grid, samples(), values), values, atol=1e-5)


def test_spacing_is_found_from_the_radii():
    assert make_grid(shell_radii(2.0, 16), 2).logarithmic
    assert not make_grid(shell_radii(2.0, 16, "paper"), 2).logarithmic


@pytest.mark.parametrize("logarithmic", [False, True])
def test_weights_are_linear_in_distance_or_its_logarithm(logarithmic):
    grid = make_grid(RADII, N, logarithmic=logarithmic)
    per_shell = np.log(RADII) if logarithmic else RADII
    values = np.repeat(per_shell, 6 * N * N)
    d = np.random.default_rng(2).uniform(RADII[0], RADII[-1], 200)
    points = random_directions(200, 3) * d[:, None]
    np.testing.assert_allclose(value(grid, points, values), np.log(d) if logarithmic else d, rtol=1e-5, atol=1e-6)


def test_continuous_over_edges_and_corners():
    grid = make_grid(RADII, N)
    values = np.random.default_rng(4).normal(size=len(samples()))
    rng = np.random.default_rng(5)
    signs = rng.choice([-1.0, 1.0], size=(300, 3))
    along = np.where(np.arange(300) < 100, 1.0, rng.uniform(0.7, 1.0, 300))  # a third in the corners themselves
    edge = signs * np.stack([np.ones(300), np.ones(300), along], 1)
    edge = np.stack([np.roll(e, k % 3) for k, e in enumerate(edge)]) * 1.3
    step = 1e-7 * rng.normal(size=(20, 300, 3))
    found = np.stack([value(grid, edge + s, values) for s in step])
    # Neighbouring values differ by about 1 and a texel is 1/3: a slope of some 30, 1e-5 by a step of 3e-7; a jump
    # would be of the order of 0.1.
    assert np.ptp(found, axis=0).max() < 2e-5


def test_weights_sum_to_one_and_are_not_negative():
    grid = make_grid(RADII, N)
    p = np.concatenate([random_directions(500, 6) * 3, np.sign(random_directions(50, 7)), np.zeros((1, 3)), np.eye(3)])
    index, weight = locate(grid, p)
    assert (weight >= 0).all()
    assert index.min() >= 0
    assert index.max() < len(samples())
    np.testing.assert_allclose(weight.sum(1), 1.0, atol=1e-6)


def test_inside_and_outside_of_all_shells():
    grid = make_grid(RADII, N)
    values = np.repeat(np.arange(1.0, 6.0), 6 * N * N)
    d = random_directions(20, 8)
    np.testing.assert_allclose(value(grid, 1e-3 * d, values), 1.0, rtol=1e-6)
    np.testing.assert_allclose(value(grid, np.zeros((1, 3)), values), 1.0, rtol=1e-6)
    for far in (1.0 + 1e-7, 2.0, 1e6):
        found = value(grid, d * RADII[-1] * far, values, 7.0)
        np.testing.assert_allclose(found, 7.0 + (5.0 - 7.0) / far**2, rtol=1e-5)


def test_invalid_samples_are_left_out():
    valid = np.ones((5, 6 * N * N), bool)
    valid[:2] = np.random.default_rng(9).random((2, 6 * N * N)) < 0.6
    valid[0, :36] = valid[1, :36] = False
    grid = make_grid(RADII, N, valid)
    values = np.where(valid, 3.0, np.nan).reshape(-1)
    p = random_directions(2000, 10) * np.random.default_rng(11).uniform(0.0, 4.0, (2000, 1))
    index, weight = locate(grid, p)
    np.testing.assert_allclose(weight.sum(1), 1.0, atol=1e-6)
    used = np.where(weight > 0, values[index], 3.0)
    np.testing.assert_array_equal(used, 3.0)


def test_no_valid_sample_at_all_is_empty_space():
    grid = make_grid(RADII, N, np.zeros((5, 6 * N * N), bool))
    index, weight = locate(grid, random_directions(10, 12))
    np.testing.assert_array_equal(weight, 0.0)
    assert (index >= 0).all()


@pytest.mark.parametrize("n", [1, 2])
def test_coarse_maps(n):
    grid = make_grid(RADII[:1], n)
    index, weight = locate(grid, random_directions(200, 13))
    np.testing.assert_allclose(weight.sum(1), 1.0, atol=1e-6)
    assert index.max() < 6 * n * n
