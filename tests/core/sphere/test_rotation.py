"""Rotation of spherical harmonics: against the rotated function, as a group, where angles would be singular."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from relightcli.core.sphere import sh
from relightcli.core.sphere.rotation import quadrature, rotation_matrices
from tests.core.brdf.reflectances import random_directions

ORDERS = [1, 2, 4, 8]


def rotations(count, seed=1):
    return Rotation.random(count, random_state=seed).as_matrix()


@pytest.mark.parametrize("order", ORDERS)
def test_is_the_rotated_function(order):
    r = rotations(5)
    c = np.random.default_rng(2).normal(size=(5, order**2))
    found = np.einsum("nij,nj->ni", rotation_matrices(r, order), c)
    d = random_directions(40, 3)
    for k in range(5):
        expected = sh.harmonics(d @ r[k], order) @ c[k]  # f(R^-1 d)
        np.testing.assert_allclose(sh.harmonics(d, order) @ found[k], expected, atol=1e-12 * order**2)


@pytest.mark.parametrize("order", ORDERS)
def test_group(order):
    a, b = rotations(4, 4), rotations(4, 5)
    of_a, of_b = rotation_matrices(a, order), rotation_matrices(b, order)
    np.testing.assert_allclose(of_a @ of_b, rotation_matrices(a @ b, order), atol=1e-12)
    np.testing.assert_allclose(np.swapaxes(of_a, 1, 2), rotation_matrices(np.swapaxes(a, 1, 2), order), atol=1e-12)
    np.testing.assert_allclose(
        of_a @ np.swapaxes(of_a, 1, 2), np.broadcast_to(np.eye(order**2), of_a.shape), atol=1e-12
    )


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, 0.8]])
@pytest.mark.parametrize("angle", [0.0, 1e-9, np.pi - 1e-9, np.pi])
def test_nothing_is_singular(axis, angle):
    r = Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
    d = random_directions(30, 6)
    found = sh.harmonics(d, 5) @ rotation_matrices(r, 5)
    np.testing.assert_allclose(found, sh.harmonics(d @ r, 5), atol=1e-12)


def test_mirrors():
    mirror = np.diag([1.0, -1.0, 1.0])
    signs = np.diag(rotation_matrices(mirror, 4))
    expected = [-1.0 if m < 0 else 1.0 for band in range(4) for m in range(-band, band + 1)]
    np.testing.assert_allclose(signs, expected, atol=1e-13)


@pytest.mark.parametrize("degree", [0, 1, 6, 9])
def test_quadrature_is_exact_up_to_its_degree(degree):
    d, w = quadrature(degree)
    integrals = w @ sh.harmonics(d, degree + 1)
    np.testing.assert_allclose(integrals, np.sqrt(4 * np.pi) * (np.arange((degree + 1) ** 2) == 0), atol=1e-13)
