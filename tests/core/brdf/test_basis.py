"""The basis of whole BRDFs and its split: errors are discarded singular energy."""

import numpy as np
import pytest

from relightcli.core.brdf.basis import brdf_basis, shared_split
from relightcli.core.brdf.dataset import blinn_phong_set, cook_torrance_set, table_set
from relightcli.core.brdf.disc import disc_grid

BRDFS = cook_torrance_set([(f, m) for f in (0.04, 0.5, 1.0) for m in (0.05, 0.1, 0.3, 0.6)], 12)
AREA = BRDFS.grid.area


def rebuilt(basis):
    return np.tensordot(basis.coefficients, basis.functions[:-1], 1)


@pytest.mark.parametrize("count", [1, 4, 7])
def test_error_is_the_discarded_singular_energy(count):
    basis = brdf_basis(BRDFS, count)
    singular = np.linalg.svd(BRDFS.values.reshape(len(BRDFS), -1) * AREA, compute_uv=False)
    measured = ((BRDFS.values - rebuilt(basis)) ** 2).sum() * AREA**2
    discarded = (singular[count:] ** 2).sum()
    # 1e-10 of the whole: Gram matrices square the singular values' rounding, 1e-16 of the largest.
    assert measured == pytest.approx(discarded, abs=1e-10 * basis.norm2)
    assert basis.error2 == pytest.approx(discarded, abs=1e-10 * basis.norm2)
    assert basis.norm2 == pytest.approx((singular**2).sum(), rel=1e-13)


def test_functions_are_orthonormal_and_the_last_is_diffuse():
    basis = brdf_basis(BRDFS)
    assert basis.functions.shape == (5, len(BRDFS.grid), len(BRDFS.grid))
    np.testing.assert_array_equal(basis.functions[-1], 1 / np.pi)
    flat = basis.functions[:-1].reshape(4, -1) * AREA
    np.testing.assert_allclose(flat @ flat.T, np.eye(4), atol=1e-10)  # as above


def test_coefficients_are_projections():
    basis = brdf_basis(BRDFS)
    projected = np.einsum("hoi,poi->hp", BRDFS.values, basis.functions[:-1]) * AREA**2
    np.testing.assert_allclose(basis.coefficients, projected, atol=1e-10 * np.sqrt(basis.norm2))


def test_functions_are_reciprocal_and_isotropic_as_the_set_is():
    basis = brdf_basis(BRDFS)
    scale = np.abs(basis.functions).max()
    np.testing.assert_allclose(basis.functions, np.swapaxes(basis.functions, 1, 2), atol=1e-12 * scale)
    for image in BRDFS.grid.images:
        np.testing.assert_allclose(basis.functions[:, image][:, :, image], basis.functions, atol=1e-12 * scale)


def test_the_basis_is_not_centred():
    # A set of multiples of one BRDF has exactly one function, and nothing left over.
    one = BRDFS.values[5]
    basis = brdf_basis(table_set(np.stack([one, 2 * one, 0.5 * one]), 12))
    assert basis.functions.shape[0] == 2
    np.testing.assert_allclose(rebuilt(basis), np.stack([one, 2 * one, 0.5 * one]), rtol=1e-12)


def test_one_entry_and_the_zero_set():
    single = brdf_basis(blinn_phong_set([20.0], 8))
    assert single.coefficients.shape == (1, 1)
    assert single.error2 <= 1e-14 * single.norm2
    cells = len(disc_grid(4))
    black = brdf_basis(table_set(np.zeros((3, cells, cells)), 4))
    assert not black.functions[:-1].any()
    assert black.error2 == 0
    split = shared_split(black, 3)
    assert not split.view.any()
    assert np.isfinite(split.light).all()


@pytest.mark.parametrize("terms", [1, 2, 5, 12, 1000])
def test_split_error_is_the_discarded_singular_energy(terms):
    basis = brdf_basis(BRDFS)
    specular = basis.functions[:-1]
    split = shared_split(basis, terms)
    kept = len(split.light)
    assert kept in (terms, terms + 1) or kept < terms
    singular = np.linalg.svd(specular.reshape(-1, specular.shape[2]) * AREA, compute_uv=False)
    near = np.einsum("pko,ki->poi", split.view, split.light)
    discarded = (singular[kept:] ** 2).sum()
    assert ((specular - near) ** 2).sum() * AREA**2 == pytest.approx(discarded, abs=1e-10 * split.norm2)
    assert split.error2 == pytest.approx(discarded, abs=1e-10 * split.norm2)
    np.testing.assert_allclose(split.light @ split.light.T * AREA, np.eye(kept), atol=1e-12)


@pytest.mark.parametrize("terms", range(1, 12))
def test_split_keeps_isotropy(terms):
    split = shared_split(brdf_basis(BRDFS), terms)
    near = np.einsum("pko,ki->poi", split.view, split.light)
    turn = BRDFS.grid.images[1]
    # A quarter turn is exact on the grid. One of eigenvectors 1e-10 apart can mix with its neighbour.
    np.testing.assert_allclose(near[:, turn][:, :, turn], near, atol=1e-8 * np.abs(near).max())
