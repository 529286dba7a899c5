"""Products in spherical harmonics: against projection of the product, symmetry, bounds of the matrix, equivariance."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from relightcli.core.sphere import sh
from relightcli.core.sphere.rotation import quadrature, rotation_matrices
from relightcli.core.sphere.triple_product import coefficients, product, product_matrices


def random_functions(count, order, seed):
    return np.random.default_rng(seed).normal(size=(count, order * order))


@pytest.mark.parametrize("order", [1, 2, 4, 6])
def test_is_the_projected_product(order):
    a, b = random_functions(20, order, 1), random_functions(20, order, 2)
    d, w = quadrature(3 * order + 5)  # finer than needed, other points than the coefficients were made from
    y = sh.harmonics(d, order)
    expected = ((y @ a.T) * (y @ b.T) * w[:, None]).T @ y
    np.testing.assert_allclose(product(a, b), expected, atol=1e-12 * order**4)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", product_matrices(a), b), expected, atol=1e-12 * order**4)


def test_coefficients_of_order_four():
    i, j, k, value = coefficients(4)
    assert len(value) == 353
    assert len({tuple(sorted(t)) for t in zip(i.tolist(), j.tolist(), k.tolist(), strict=True)}) == 77
    assert np.abs(value).min() > 1e-2
    band = np.floor(np.sqrt(np.stack([i, j, k]))).astype(int)
    assert (band.sum(0) % 2 == 0).all()  # parity
    assert (2 * band.max(0) <= band.sum(0)).all()  # triangle rule


def test_the_constant_one_is_neutral():
    a = random_functions(3, 5, 3)
    one = np.zeros(25)
    one[0] = np.sqrt(4 * np.pi)
    np.testing.assert_allclose(product(one, a), a, atol=1e-13)


def test_matrix_is_symmetric_and_bounded_by_the_function():
    a = random_functions(10, 4, 4)
    matrices = product_matrices(a)
    np.testing.assert_allclose(matrices, np.swapaxes(matrices, 1, 2), atol=1e-14)
    values = sh.harmonics(quadrature(60)[0], 4) @ a.T
    eigen = np.linalg.eigvalsh(matrices)
    # 1e-2: the extreme values of the function between the points of the quadrature, 3 degrees apart.
    assert (eigen.min(1) >= values.min(0) - 1e-2).all()
    assert (eigen.max(1) <= values.max(0) + 1e-2).all()


def test_product_of_the_rotated_is_the_rotated_product():
    a, b = random_functions(1, 4, 5)[0], random_functions(1, 4, 6)[0]
    for turn in rotation_matrices(Rotation.random(5, random_state=7).as_matrix(), 4):
        np.testing.assert_allclose(product(turn @ a, turn @ b), turn @ product(a, b), atol=1e-12)
