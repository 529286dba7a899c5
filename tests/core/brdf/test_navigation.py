"""Mixes of a set's entries: interpolation, the hull, and sets without a triangle."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relightcli.core.brdf.navigation import exponent_mix, fresnel_roughness_mix

EXPONENTS = np.arange(1.0, 201.0)
POINTS = np.array([[0.04, 0.01], [0.04, 0.5], [0.9, 0.02], [0.95, 0.6], [0.5, 0.1], [0.3, 0.3]])

fixed = settings(max_examples=60, deadline=None, derandomize=True)
roughness = st.floats(1e-4, 10.0)
f0 = st.floats(0.0, 1.0)
point_sets = st.lists(st.tuples(f0, roughness), min_size=1, max_size=12)


def plane(points):
    return np.stack([points[..., 0], np.log(points[..., 1])], -1)


def one_at(mix, index):
    expected = np.zeros(len(mix.weights))
    expected[index] = 1
    np.testing.assert_array_equal(mix.weights, expected)
    assert not mix.outside


@fixed
@given(st.floats(1.0, 200.0))
def test_exponents_interpolate_linearly(s):
    mix = exponent_mix(EXPONENTS, s)
    assert not mix.outside
    assert np.count_nonzero(mix.weights) <= 2
    assert (mix.weights >= 0).all()
    assert mix.weights.sum() == pytest.approx(1, rel=1e-15)
    assert mix.weights @ EXPONENTS == pytest.approx(s, rel=1e-14)


@fixed
@given(st.permutations(range(8)), st.floats(0.5, 9.0))
def test_the_order_of_exponents_does_not_matter(order, s):
    points = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.5, 8.0])
    shuffled, plain = exponent_mix(points[list(order)], s), exponent_mix(points, s)
    np.testing.assert_array_equal(shuffled.weights, plain.weights[list(order)])
    assert shuffled.outside == plain.outside


def test_exponents_of_the_set_and_beyond():
    for k in (0, 57, 199):
        one_at(exponent_mix(EXPONENTS, EXPONENTS[k]), k)
    for s, k in ((0.0, 0), (0.999, 0), (200.5, 199), (1e6, 199)):
        mix = exponent_mix(EXPONENTS, s)
        assert mix.outside
        assert mix.weights[k] == 1
    one_at(exponent_mix(np.array([7.0]), 7.0), 0)
    assert exponent_mix(np.array([7.0]), 8.0).outside
    one_at(exponent_mix(np.array([2.0, 5.0, 5.0]), 5.0), 1)


@fixed
@given(point_sets, st.data())
def test_points_of_the_set_are_one_weight(points, data):
    array = np.array(points)
    k = data.draw(st.integers(0, len(points) - 1))
    one_at(fresnel_roughness_mix(array, *array[k]), points.index(points[k]))


@fixed
@given(point_sets, f0, roughness)
def test_weights_are_a_mix(points, f, m):
    mix = fresnel_roughness_mix(np.array(points), f, m)
    assert (mix.weights >= 0).all()
    assert mix.weights.sum() == pytest.approx(1, rel=1e-14)
    assert np.count_nonzero(mix.weights) <= 3


@fixed
@given(st.integers(0, 2**32 - 1))
def test_inside_the_hull_the_mix_is_at_the_point(seed):
    share = np.random.default_rng(seed).dirichlet(np.ones(len(POINTS)))
    at = share @ plane(POINTS)
    mix = fresnel_roughness_mix(POINTS, at[0], np.exp(at[1]))
    assert not mix.outside
    # Rounding of the triangulation's affine maps, 1e-15 of the extent times the triangles' condition.
    np.testing.assert_allclose(mix.weights @ plane(POINTS), at, atol=1e-12)


@fixed
@given(f0, roughness)
def test_outside_it_is_the_nearest_point_of_the_hull(f, m):
    mix = fresnel_roughness_mix(POINTS, f, m)
    found, query = mix.weights @ plane(POINTS), plane(np.array([f, m]))
    extent = np.ptp(plane(POINTS), axis=0)
    assert mix.outside == (np.abs((found - query) / extent).max() > 1e-9)
    distance = np.hypot(*((found - query) / extent))
    # The whole hull, by brute force: no mix of the points is nearer.
    share = np.random.default_rng(0).dirichlet(0.3 * np.ones(len(POINTS)), 2000)
    others = np.hypot(*((share @ plane(POINTS) - query) / extent).T)
    assert distance <= others.min() + 1e-9


def test_the_mix_is_continuous_across_the_hull():
    a, b = plane(POINTS[0]), plane(POINTS[1])
    middle = 0.5 * (a + b)
    inner, outer = (fresnel_roughness_mix(POINTS, middle[0] + d, np.exp(middle[1])) for d in (1e-7, -1e-7))
    assert outer.outside
    assert not inner.outside
    np.testing.assert_allclose(inner.weights, outer.weights, atol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("step", [(0.1, 0.0), (0.0, 0.5), (0.1, -0.4)])
def test_sets_on_a_line(count, step):
    line = np.array([0.2, -1.0]) + np.arange(count)[:, None] * np.array(step)
    points = np.stack([line[:, 0], np.exp(line[:, 1])], -1)
    for k in range(count):
        one_at(fresnel_roughness_mix(points, *points[k]), k)
    if count > 1:
        at = line[0] + 0.7 * (line[1] - line[0])
        mix = fresnel_roughness_mix(points, at[0], np.exp(at[1]))
        assert not mix.outside
        np.testing.assert_allclose(mix.weights[:2], [0.3, 0.7], atol=1e-9)
    off = line[0] + 0.5 * np.array([-step[1], step[0]])
    assert fresnel_roughness_mix(points, off[0], np.exp(off[1])).outside
    beyond = line[-1] + np.array(step) * 0.5
    mix = fresnel_roughness_mix(points, beyond[0], np.exp(beyond[1]))
    assert mix.outside
    assert mix.weights[-1] == 1


def test_identical_points():
    points = np.tile([[0.5, 0.1]], (4, 1))
    one_at(fresnel_roughness_mix(points, 0.5, 0.1), 0)
    assert fresnel_roughness_mix(points, 0.5, 0.2).outside
