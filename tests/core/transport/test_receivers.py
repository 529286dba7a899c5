"""Receivers: which vertices, which side, and an order that keeps neighbours together."""

import numpy as np
import pytest

from relightcli.core.transport.receivers import receiver_areas, spatial_order, vertex_receivers
from tests.core.transport.scenes import sphere_grid

POSITIONS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5], [0, 0, 1]], float)
NORMALS = np.array([[0, 0, 1], [0, 1, 0], [1, 0, 0], [0, 0, 1], [0, 1, 0]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 4]], np.int32)
OBJECT = np.array([0, 0, 0, 0, 1], np.int32)


def receivers(both):
    return vertex_receivers(POSITIONS, NORMALS, FACES, OBJECT, np.array(both))


def test_every_vertex_of_a_face_once():
    found = receivers([False, False])
    assert sorted(found.vertex) == [0, 1, 2, 4]  # vertex 3 is in no face
    assert (found.side == 1).all()
    np.testing.assert_array_equal(found.position, POSITIONS[found.vertex])
    np.testing.assert_array_equal(found.normal, NORMALS[found.vertex])
    np.testing.assert_array_equal(found.object, OBJECT[found.vertex])


def test_two_receivers_where_both_sides_are_lit():
    found = receivers([False, True])
    assert len(found) == 5
    back = found.side == -1
    assert found.vertex[back].tolist() == [4]
    np.testing.assert_array_equal(found.normal[back], -NORMALS[[4]])
    assert len(receivers([True, True])) == 8


def test_no_faces_no_receivers():
    found = vertex_receivers(POSITIONS, NORMALS, np.zeros((0, 3), np.int32), OBJECT, np.array([True, True]))
    assert len(found) == 0
    assert found.position.shape == (0, 3)


def test_order_is_a_permutation_that_keeps_neighbours_together():
    points = np.random.default_rng(0).random((4096, 3))
    order = spatial_order(points)
    assert sorted(order) == list(range(4096))
    step = np.linalg.norm(np.diff(points[order], axis=0), axis=1).mean()
    # 4096 points in a unit cube lie 1/16 apart; along a Morton curve steps are under twice that, at random 0.66.
    assert step < 2 / 16


def test_sides_are_kept_apart_and_ties_keep_their_order():
    points = np.zeros((6, 3))
    side = np.array([1, -1, 1, -1, 1, -1], np.int8)
    assert spatial_order(points, side).tolist() == [0, 2, 4, 1, 3, 5]


@pytest.mark.parametrize("scale", [2.0**-13, 2.0**20])
def test_order_does_not_depend_on_the_scale(scale):
    points = np.random.default_rng(1).normal(size=(1000, 3))
    np.testing.assert_array_equal(spatial_order(points * scale), spatial_order(points))


@pytest.mark.parametrize("scale", [1e-4, 1e6])
def test_order_hardly_depends_on_rounding(scale):
    # A point within a rounding of one of 2^20 cell borders may change its cell: 1 in 1e9.
    points = np.random.default_rng(2).normal(size=(1000, 3))
    np.testing.assert_array_equal(spatial_order(points * scale), spatial_order(points))


def test_order_of_nothing_and_of_one_plane():
    assert len(spatial_order(np.zeros((0, 3)))) == 0
    points = np.zeros((100, 3))
    points[:, 0] = np.random.default_rng(3).random(100)
    assert (np.diff(points[spatial_order(points), 0]) >= -(2.0**-20)).all()


def test_areas_sum_to_the_mesh():
    corners, triangles = sphere_grid(12, 24)  # its poles are rings of one point: faces without area
    rng = np.random.default_rng(4)
    positions = np.concatenate([corners * [1.0, 2.0, 0.5], rng.normal(size=(10, 3))])  # ten that no face uses
    faces = np.concatenate([triangles, [[5, 5, 40], [7, 7, 7]]]).astype(np.int32)
    a, b, c = (np.linalg.norm(positions[faces[:, i]] - positions[faces[:, i - 1]], axis=1) for i in range(3))
    s = 0.5 * (a + b + c)
    heron = np.sqrt(np.maximum(s * (s - a) * (s - b) * (s - c), 0))
    found = vertex_receivers(
        positions, np.tile(np.float32([0, 1, 0]), (len(positions), 1)), faces,
        np.zeros(len(positions), np.int32), np.array([False]),
    )  # fmt: skip
    areas = receiver_areas(positions, faces, found.vertex)
    assert areas.sum() == pytest.approx(heron.sum(), rel=1e-9)
    for i in range(0, len(found), 31):
        assert areas[i] == pytest.approx(heron[(faces == found.vertex[i]).any(axis=1)].sum() / 3, rel=1e-6, abs=1e-12)
    np.testing.assert_array_equal(receiver_areas(positions, faces, np.arange(len(corners), len(positions))), 0)
