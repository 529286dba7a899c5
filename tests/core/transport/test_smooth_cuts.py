"""Faces are cut where unblocked light varies across them, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from relightcli.core.transport.smooth_cuts import NEAR, SLOPES, TURN, TURNS, cut_for_shading, lobe_width
from relightcli.core.transport.tessellation import angle_between
from relightcli.scene.model import Material
from tests.core.transport.test_tessellation import edges, quad, scene

NOWHERE = np.zeros((0, 3))
MATTE = Material("matte")
GLOSSY = Material("glossy", "cook-torrance", specular=(0.5, 0.5, 0.5), roughness=0.1)


def test_flat_matte_faces_under_the_sky_stay_whole():
    before = scene(quad(50.0))
    assert cut_for_shading(before, [MATTE], np.array([[0.0, 0.1, 0.0]]), NOWHERE) is before


@pytest.mark.parametrize(
    ("material", "eyes", "lights", "slope"),
    [
        (GLOSSY, [[1.0, 2.0, 0.0]], NOWHERE, 0.05),
        (Material("a", adjustable=True), [[1.0, 2.0, 0.0]], NOWHERE, SLOPES[1]),
        (MATTE, NOWHERE, [[1.0, 2.0, 0.0]], NEAR),
        (GLOSSY, NOWHERE, [[1.0, 2.0, 0.0]], 0.05),
    ],
)
def test_no_edge_is_longer_than_the_distance_allows(material, eyes, lights, slope):
    before = scene(quad(3.0))
    after = cut_for_shading(before, [material], np.array(eyes), np.array(lights))
    a, b = after.positions[edges(after, 0).T]
    distance = np.linalg.norm(0.5 * (a + b) - [1.0, 2.0, 0.0], axis=1)
    length = np.linalg.norm(a - b, axis=1)
    assert (length <= slope * distance).all()
    # Halving leaves half, and of a face's edges the longest go first.
    assert np.mean(length > 0.25 * slope * distance) > 0.5


@pytest.mark.parametrize(("material", "most"), [(MATTE, TURN), (GLOSSY, TURNS[0])])
def test_bent_edges_are_cut_and_normals_interpolated_over_the_first_faces(material, most):
    ball = trimesh.creation.icosphere(1)
    before = scene(ball)
    after = cut_for_shading(before, [material], NOWHERE, NOWHERE)
    a, b = edges(after, 0).T
    assert angle_between(after.normals[a], after.normals[b]).max() <= most
    # Every new point lies on a first face; its normal is that of barycentric interpolation there, to float32.
    count = len(before.positions)
    new, place = after.normals[count:], after.positions[count:]
    _, _, face = trimesh.proximity.closest_point_naive(ball, place)
    weights = trimesh.triangles.points_to_barycentric(ball.triangles[face], place)
    wanted = np.einsum("nk,nki->ni", weights, before.normals[before.faces[face]])
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    np.testing.assert_allclose(new, wanted, atol=1e-5)


def test_an_eye_on_a_face_and_objects_kept_whole():
    before = scene(quad(1.0))
    after = cut_for_shading(before, [GLOSSY], np.array([[0.0, 0.0, 0.0]]), NOWHERE)
    assert 500 < len(after.positions) < 41_000
    assert cut_for_shading(before, [GLOSSY], np.array([[0.0, 0.0, 0.0]]), NOWHERE, whole=(0,)) is before


def test_widths_of_lobes():
    assert lobe_width(MATTE) == np.inf
    assert lobe_width(Material("black", "cook-torrance")) == np.inf
    assert lobe_width(GLOSSY) == 0.1
    # (n.h)^n = exp(-x^2 / w^2) to second order in x
    assert lobe_width(Material("p", "phong", specular=(1, 0, 0), shininess=50.0)) == pytest.approx(0.2)
