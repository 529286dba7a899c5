import numpy as np
import pytest

from relightcli.core.affine import compose, is_mirror, is_singular, normal_matrix, transform_mesh, unit

NO_TURN = (np.array([0.0, 1.0, 0.0]), 0.0)


def test_scale_comes_first_then_rotation_then_translation():
    # By hand: (1, 0, 0) scaled to (2, 0, 0), a quarter turn about +Y takes +X to -Z, then moved by (10, 20, 30).
    matrix = compose(np.array([10.0, 20.0, 30.0]), np.array([0.0, 5.0, 0.0]), 90.0, np.array([2.0, 3.0, 4.0]))
    # Quarter turns are exact, so no tolerance.
    assert np.array_equal(matrix @ (1, 0, 0, 1), (10, 20, 28, 1))
    assert np.array_equal(matrix @ (0, 0, 1, 1), (14, 20, 30, 1))


@pytest.mark.parametrize("degrees", [-720, -270, -180, -90, 0, 90, 180, 270, 450])
def test_quarter_turns_are_exact(degrees):
    matrix = compose(np.zeros(3), np.array([0.0, 0.0, 1.0]), degrees, np.ones(3))
    assert set(np.unique(matrix)) <= {-1.0, 0.0, 1.0}


def test_rotation_about_a_diagonal_permutes_the_axes():
    matrix = compose(np.zeros(3), np.array([1e-200, 1e-200, 1e-200]), 120.0, np.ones(3))
    # A few roundings of sine and cosine.
    assert np.allclose(matrix[:3, :3] @ np.eye(3), [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15)


@pytest.mark.parametrize("size", [1e-120, 1.0, 1e120])
def test_normals_stay_square_to_their_surface(size):
    rng = np.random.default_rng(7)
    linear = rng.normal(size=(3, 3)) * size
    a, b = rng.normal(size=(2, 3))
    normal = normal_matrix(linear) @ np.cross(a, b)
    normal /= np.linalg.norm(normal)
    for tangent in (linear @ a, linear @ b):
        # Rounding of a 3x3 product whose entries are of order one.
        assert abs(normal @ tangent) < 1e-13 * np.linalg.norm(tangent)


def test_a_mirror_turns_faces_and_keeps_normals_outward():
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2]], np.int32)
    normals = np.tile([0.6, 0.0, 0.8], (3, 1))
    moved, turned, wound = transform_mesh(mirror, positions, normals, faces)
    p = moved[wound[0]]
    assert np.array_equal(np.cross(p[1] - p[0], p[2] - p[0]), (0, 0, 1))
    assert np.allclose(turned, [-0.6, 0.0, 0.8], atol=1e-15)
    assert is_mirror(mirror[:3, :3])
    assert not is_mirror(-mirror[:3, :3])


def test_identity_changes_nothing():
    positions, normals, faces = np.full((3, 3), 0.1), np.full((3, 3), 0.3), np.array([[0, 1, 2]], np.int32)
    moved, turned, wound = transform_mesh(np.eye(4), positions, normals, faces)
    assert moved is positions
    assert turned is normals
    assert wound is faces


@pytest.mark.parametrize(
    "matrix", [np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0]), np.ones((3, 3)), np.diag([1.0, 1, 1e-15])]
)
def test_flattening_matrices_are_singular(matrix):
    assert is_singular(matrix)


def test_unequal_and_tiny_scales_are_not_singular():
    assert not is_singular(np.diag([1e-6, 1.0, 1e6]))
    assert not is_singular(np.diag([1e-200, 1e-200, 1e-200]))


def test_unit_handles_extremes():
    vectors = np.array([[3e200, 4e200, 0], [3e-200, 0, 4e-200], [0, 0, 0], [np.nan, 1, 0], [np.inf, 0, 0]])
    expected = [[0.6, 0.8, 0], [0.6, 0, 0.8], [0, 0, 0], [0, 0, 0], [0, 0, 0]]
    assert np.allclose(unit(vectors), expected, atol=1e-15)
