import numpy as np
import pytest

from relightcli.core.normals import degenerate_faces, vertex_normals


def test_a_corner_weighs_by_its_angle_not_by_its_area():
    # Three faces at the origin in the planes z = 0, x = 0, y = 0, all with a right angle there but of unequal size:
    # equal weights, so the normal is the diagonal.
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [0, 50, 0], [0, 0, 7]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1]], np.int32)
    # Rounding of a sum of three.
    assert np.allclose(vertex_normals(positions, faces)[0], np.ones(3) / np.sqrt(3), atol=1e-15)


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1.0, 1e6, 1e20])
@pytest.mark.parametrize("offset", [0.0, 1e3])
def test_normals_do_not_depend_on_scale_or_place(scale, offset):
    import trimesh

    torus = trimesh.creation.torus(1.0, 0.3, major_sections=24, minor_sections=12)
    positions, faces = np.array(torus.vertices), np.array(torus.faces, np.int32)
    expected = torus.vertex_normals
    found = vertex_normals((positions + offset) * scale, faces)
    # Edges of about 0.1 at an offset of 1000 keep eps * 1000 / 0.1 = 2e-12 of their direction.
    assert np.abs(found - expected).max() < 1e-11


def test_unused_and_cancelled_vertices_get_a_unit_normal():
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9]])
    faces = np.array([[0, 1, 2], [0, 2, 1]], np.int32)  # a face and its back
    assert np.array_equal(vertex_normals(positions, faces), [[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 1, 0]])


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_faces_without_area_are_found_at_any_scale(scale):
    positions = scale * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [0, 0, 0], [1, 1e-6, 0], [1e-7, 0, 0]])
    faces = [[0, 1, 2], [0, 1, 1], [0, 1, 3], [0, 4, 1], [0, 3, 5], [6, 0, 2]]
    found = degenerate_faces(positions, np.array(faces, np.int32))
    # used twice, on a line, at one place; a needle and a sliver are faces still
    assert found.tolist() == [False, True, True, True, False, False]


def test_no_faces():
    none = np.zeros((0, 3), np.int32)
    assert degenerate_faces(np.zeros((2, 3)), none).shape == (0,)
    assert np.array_equal(vertex_normals(np.zeros((2, 3)), none), [[0, 1, 0], [0, 1, 0]])
