"""Placing proxies and weighing them: seeded, no duplicates, no division by zero."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.fields.proxies import place_proxies, proxy_weights


def test_separate_groups_get_a_proxy_each_at_their_mean():
    rng = np.random.default_rng(0)
    places = np.array([[0, 0, 0], [10, 0, 0], [0, 20, 0]])
    points = (places[:, None] + 0.1 * rng.standard_normal((3, 50, 3))).reshape(-1, 3)
    found = place_proxies(points, 3, seed=5)
    order = np.argsort(found @ (1, 1, 0))
    np.testing.assert_allclose(found[order], points.reshape(3, 50, 3).mean(1), atol=1e-12)
    np.testing.assert_array_equal(place_proxies(points, 3, seed=5), found)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_scale_does_not_matter(scale):
    points = np.random.default_rng(1).random((200, 3))
    np.testing.assert_allclose(place_proxies(points * scale, 8) / scale, place_proxies(points, 8), rtol=1e-9)


def test_an_object_of_few_points_has_few_proxies():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    found = place_proxies(np.repeat(corners, 7, axis=0), 8)
    assert sorted(map(tuple, found)) == sorted(map(tuple, corners))
    np.testing.assert_array_equal(place_proxies(np.full((5, 3), 4.0), 8), [[4.0, 4, 4]])


def test_weights_are_inverse_squares_of_distances_and_one_hot_at_a_proxy():
    proxies = np.array([[0.0, 0, 0], [3, 0, 0]])
    weights = proxy_weights(np.array([[1.0, 0, 0], [3, 0, 0], [3, 5e-7, 0], [0, 4, 0]]), proxies, 1.0)
    np.testing.assert_allclose(weights, [[4 / 5, 1 / 5], [0, 1], [0, 1], [25 / 41, 16 / 41]], rtol=1e-15)
    twice = proxy_weights(np.zeros((1, 3)), np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0]]), 1.0)
    np.testing.assert_array_equal(twice, [[0.5, 0.5, 0]])
