"""Light of factors from clusters against dense sums, and what groups of clusters cost."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relightcli.core.lights.leaf_light import LeafLight
from relightcli.core.lights.points import Points, both
from relightcli.core.shade.cluster_sum import ALL, NONE, Fractions
from relightcli.core.shade.factor_sum import factor_light
from relightcli.core.sphere import cube
from tests.core.brdf.reflectances import random_directions
from tests.core.transport.test_direct_tensor import disc_values, local

SIDE, N = 16, 200  # cells along a face, all alike; receivers
DIRECTIONS = cube.texel_directions(SIDE).reshape(-1, 3)
SOLID = np.tile(cube.solid_angles(SIDE).reshape(-1), 6)
RADIUS = 0.5 * np.sqrt(SOLID)
NONE_BESIDE = (np.zeros((0, N), bool), Points(np.zeros((0, 3)), np.zeros((0, 3))))
FAMILY = np.flatnonzero(np.arange(N) % 7 != 3)


def normals():
    """The first two groups of 64 look up, and see all that is overhead."""
    found = random_directions(N, 2)
    found[:128] = 0.05 * found[:128] + [0.0, 1.0, 0.0]
    return (found / np.linalg.norm(found, axis=1, keepdims=True)).astype(np.float32)


def fractions():
    """(cells, N) in steps: all, nothing or something between, alike over neighbouring cells."""
    rng = np.random.default_rng(3)
    coarse = rng.choice(np.array([0, 255, 255, 80, 200], np.uint8), (6, SIDE // 4, SIDE // 4, N))
    steps = coarse.repeat(4, axis=1).repeat(4, axis=2).reshape(-1, N)
    steps[DIRECTIONS[:, 1] > 0.6, :128] = 255
    steps[DIRECTIONS[:, 1] < -0.6, :128] = 0
    return steps


def table(count=9):
    """Smooth factors over the disc, of either sign."""
    axis = (np.arange(32) + 0.5) / 16 - 1
    x, y = np.meshgrid(axis, axis, indexing="ij")
    return np.stack([np.cos(k * x + 0.3 * k) * np.cos(2 * y - k) for k in range(count)], -1).astype(np.float32)


def light(seed=5):
    """One direction per cell, somewhere in it; a third of the cells are dark."""
    rng = np.random.default_rng(seed)
    flux = rng.random((len(DIRECTIONS), 3)) * SOLID[:, None] * (rng.random((len(DIRECTIONS), 1)) > 0.3)
    d = DIRECTIONS + 0.2 / SIDE * rng.uniform(-1, 1, DIRECTIONS.shape)
    return LeafLight(flux, flux[:, :, None] * (d / np.linalg.norm(d, axis=1, keepdims=True))[:, None, :])


def packed():
    steps = fractions()
    return Fractions((steps[:, a : a + 128] for a in range(0, N, 128)), normals(), RADIUS)


def dense(sky, factors, normal, seen):
    """Every cell with factors of its own, float64. seen (cells, n)."""
    total = sky.flux.sum(1, keepdims=True)
    d = np.divide(sky.moment.sum(1), total, out=np.zeros_like(DIRECTIONS), where=total != 0)
    height = normal.astype(float) @ d.T
    low = np.maximum(height + RADIUS, 0) ** 2 / (4 * RADIUS)
    inside = local(normal, d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-300))
    flat = np.maximum(np.linalg.norm(inside[..., :2], axis=2, keepdims=True), 1e-9)
    inside = np.where(inside[..., 2:] < 0, inside / flat, inside)  # below the horizon: its rim
    transfer = seen.T / 255.0 * np.where(height >= RADIUS, height, low)
    return np.einsum("nt,ntk,tc->nkc", transfer, disc_values(factors, inside), sky.flux)


def test_cells_one_by_one_are_the_dense_sum():
    every, factors, sky = packed(), table(), light()
    assert (every.place == ALL).any()
    assert (every.place == NONE).any()
    cells = np.arange(len(DIRECTIONS))
    start = np.arange(len(DIRECTIONS) + 1)
    found = factor_light(every, FAMILY, sky, cells, RADIUS, start, *NONE_BESIDE, factors)
    truth = dense(sky, factors, normals()[FAMILY], fractions()[:, FAMILY])
    # Products and places on the disc in single precision: 1e-6 each, of terms that cancel a little.
    np.testing.assert_allclose(found, truth, atol=2e-5 * np.abs(truth).max())


def group_by(side):
    """Order of the cells in which squares of side x side of them follow each other, and where each begins."""
    face, row, column = np.unravel_index(np.arange(len(DIRECTIONS)), (6, SIDE, SIDE))
    key = (face * SIDE + row // side) * SIDE + column // side
    order = np.argsort(key, kind="stable")
    return order, np.arange(0, len(order) + 1, side * side)


def test_error_of_groups_falls_with_the_square_of_their_size():
    """A factor is taken at the mean direction, so that its gradient over a group costs nothing."""
    every, factors, sky = packed(), table(), light()
    truth = dense(sky, factors, normals()[FAMILY], fractions()[:, FAMILY])
    errors = []
    for side in (4, 2):
        order, start = group_by(side)
        moved = LeafLight(sky.flux[order], sky.moment[order])
        found = factor_light(every, FAMILY, moved, order, RADIUS[order], start, *NONE_BESIDE, factors)
        errors.append(math.sqrt(((found - truth) ** 2).sum() / (truth**2).sum()))
    assert errors[0] < 0.06
    assert errors[0] / errors[1] > 3.0  # 4 but for the factors' kinks at the disc's cells


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_and_other_receivers_change_nothing(threads):
    every, factors, sky = packed(), table(), light()
    order, start = group_by(2)
    given = (LeafLight(sky.flux[order], sky.moment[order]), order, RADIUS[order], start, *NONE_BESIDE, factors)
    whole = factor_light(every, np.arange(N), *given, threads)
    np.testing.assert_array_equal(factor_light(every, FAMILY, *given), whole[FAMILY])


def test_points_are_added_where_they_are_seen_and_taken_away_again():
    factors, normal = table(), normals()
    points = Points(random_directions(5, 8), np.random.default_rng(9).random((5, 3)))
    seen = np.random.default_rng(10).random((5, N)) > 0.4
    dark = LeafLight(np.zeros((len(DIRECTIONS), 3)), np.zeros((len(DIRECTIONS), 3, 3)))
    order, start = group_by(4)
    given = (packed(), FAMILY, dark, order, RADIUS[order], start)
    found = factor_light(*given, seen, points, factors, 2)
    inside = local(normal[FAMILY], points.direction)
    transfer = seen[:, FAMILY].T * np.maximum(inside[..., 2], 0)
    truth = np.einsum("np,npk,pc->nkc", transfer, disc_values(factors, inside), points.flux)
    np.testing.assert_allclose(found, truth, atol=1e-5)
    none = both(points, Points(points.direction, -points.flux))
    np.testing.assert_allclose(factor_light(*given, np.concatenate([seen, seen]), none, factors), 0.0, atol=1e-6)


def test_no_light_is_nothing():
    dark = LeafLight(np.zeros((len(DIRECTIONS), 3)), np.zeros((len(DIRECTIONS), 3, 3)))
    order, start = group_by(4)
    assert not factor_light(packed(), FAMILY, dark, order, RADIUS[order], start, *NONE_BESIDE, table()).any()
    assert factor_light(packed(), FAMILY[:0], dark, order, RADIUS[order], start, *NONE_BESIDE, table()).shape == (
        0,
        9,
        3,
    )
