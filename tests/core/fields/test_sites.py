"""Sites on an object: spread over it, and what its other points take from them."""

from __future__ import annotations

import numpy as np

from relightcli.core.fields.sites import between, outlook, spread_out


def test_points_take_the_nearest_sites():
    rng = np.random.default_rng(1)
    sites, points = rng.random((20, 3)), rng.random((50, 3))
    points[0] = sites[7]
    spread = between(points, sites)
    np.testing.assert_allclose(spread.weight.sum(axis=1), 1.0, atol=1e-6)
    values = rng.random((20, 2)).astype(np.float32)
    found = spread.blend(values)
    np.testing.assert_allclose(found[0], values[7], atol=1e-6)
    assert (found >= values.min(axis=0) - 1e-6).all()
    assert (found <= values.max(axis=0) + 1e-6).all()
    alone = between(points, sites[:1])
    np.testing.assert_allclose(alone.blend(values[:1]), np.tile(values[0], (50, 1)))


def test_no_point_is_farther_from_a_site_than_sites_are_from_each_other():
    """What farthest points are chosen for; it holds whatever the points, to rounding."""
    rng = np.random.default_rng(3)
    points = np.concatenate([rng.random((500, 6)), 0.01 * rng.random((500, 6))])  # most of them in a corner
    chosen = spread_out(points, 40)
    assert len(chosen) == 40
    assert (np.diff(chosen) > 0).all()
    apart = np.linalg.norm(points[chosen, None] - points[chosen], axis=2)
    covered = np.linalg.norm(points[:, None] - points[chosen], axis=2).min(axis=1)
    assert covered.max() <= apart[apart > 0].min() * (1 + 1e-12)


def test_few_different_points_are_few_sites():
    points = np.repeat(np.eye(3), 4, axis=0)
    assert len(spread_out(points, 64)) == 3
    assert len(spread_out(points[:1], 64)) == 1


def test_a_side_takes_little_from_the_sole_beside_it():
    """The rim of a sole and the side above it, next to each other: by places alone half of a side's light would be that
    of the sole."""
    turn = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    ring = np.stack([np.cos(turn), np.zeros(60), np.sin(turn)], axis=1)
    points = np.concatenate([0.98 * ring, ring + np.array([0.0, 0.02, 0.0])])
    normals = np.concatenate([np.tile([0.0, -1.0, 0.0], (60, 1)), ring]).astype(np.float32)
    outlooks = outlook(points, normals, 1.0)
    chosen = spread_out(outlooks, 64)
    share = {}
    for name, where in (("outlook", outlooks), ("place", points)):
        spread = between(where, where[chosen])
        share[name] = float((spread.weight * (chosen[spread.site] < 60)).sum(axis=1)[60:].mean())
    assert share["outlook"] < 0.25 * share["place"]
