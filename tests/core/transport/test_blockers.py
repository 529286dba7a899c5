"""Bits past what has come to stand elsewhere, against tracing everything."""

from __future__ import annotations

import numpy as np

from relightcli.adapters.rays import Tracer
from relightcli.core.transport.blockers import block, bounding_balls
from relightcli.core.transport.visibility import horizon_bits, trace_visibility


def tubes(seed=0, count=40):
    """Triangles strewn about, long ones among them."""
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(count, 1, 3)) * [0.6, 1.0, 0.4] + [0, 1.5, 0] + 0.3 * rng.normal(size=(count, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def test_balls_hold_all_that_they_are_about():
    positions, faces = tubes()
    balls = bounding_balls(positions, faces, 8)
    assert len(balls.radius) == 9
    away = np.linalg.norm(positions[:, None] - balls.center, axis=2)
    assert (away[:, 0] <= balls.radius[0]).all()
    inside = (away[:, 1:] <= balls.radius[1:])[faces].all(axis=1)  # (F, parts)
    assert inside.any(axis=1).all()
    assert balls.radius[1:].max() < balls.radius[0]
    assert len(bounding_balls(positions[:3], faces[:1], 8).radius) == 2


def test_what_is_blocked_is_what_tracing_everything_says():
    positions, faces = tubes()
    rng = np.random.default_rng(1)
    within = rng.normal(size=(50, 3)) + np.array([0, 1.5, 0])
    points = np.concatenate([rng.uniform(-3, 3, (150, 3)) * [1, 0, 1], within])
    normals = rng.normal(size=(200, 3)) + np.repeat([[0, 2.0, 0], [0, 0, 0]], [150, 50], axis=0)
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    open_bits = horizon_bits(normals, 32)
    open_bits[::3, 2] = 0  # blocked by something else before
    tracer = Tracer(positions, faces)
    rows, now, rays = block(tracer, bounding_balls(positions, faces), points, normals, open_bits)
    expected = trace_visibility(tracer, points, normals, 32, 1, 0).bits & open_bits
    found = open_bits.copy()
    found[rows] = now
    np.testing.assert_array_equal(found, expected)
    assert (np.diff(rows) > 0).all()
    assert (open_bits[rows] != now).any(axis=(1, 2, 3)).all()
    assert rays >= np.unpackbits(open_bits[rows] ^ now).sum()


def test_no_rays_where_nothing_can_be():
    positions, faces = tubes()
    up = np.tile(np.array([[0, 1, 0]], np.float32), (20, 1))
    angle = np.linspace(0, 6, 20)
    points = 20 * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], 1)
    bits, balls = horizon_bits(up, 32), bounding_balls(positions, faces)
    rows, _, rays = block(Tracer(positions, faces), balls, points, up, bits)
    assert len(rows) == 20
    # A cap of the ball's angle and a cell's, as a share of the hemisphere.
    cap = 1 - np.cos(np.arcsin(balls.radius[0] / (20 - np.linalg.norm(balls.center[0]))) + 2 * np.sqrt(2) / 16)
    assert rays < cap * np.unpackbits(bits).sum()


def test_nothing_in_sight():
    positions, faces = tubes()
    down = np.tile(np.array([[0, -1, 0]], np.float32), (5, 1))
    points = np.tile([[0, -9.0, 0]], (5, 1))
    rows, now, rays = block(
        Tracer(positions, faces), bounding_balls(positions, faces), points, down, horizon_bits(down, 16)
    )
    assert (len(rows), now.shape, rays) == (0, (0, 6, 16, 2), 0)
