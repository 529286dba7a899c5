"""Lobes: normalisers, energy, expectation maximisation against least squares, what they take from a BRDF set."""

import numpy as np
import pytest
from scipy.optimize import nnls

from relightcli.core.brdf.dataset import blinn_phong_set, cook_torrance_set, table_set
from relightcli.core.brdf.disc import disc_grid, fold
from relightcli.core.brdf.specular_lobes import (
    LOBES,
    MIRROR,
    broad_columns,
    expectation_maximisation,
    fit_lobes,
    lobe_columns,
    lobes_on_grid,
    normaliser,
)

GRID = disc_grid(16)


@pytest.mark.parametrize(("degrees", "expected"), [(7, 0.010415), (14, 0.041590), (21, 0.093319)])
def test_normalisers(degrees, expected):
    # Close to 2 pi sigma^2, less by sigma^2 / 3 of it for the sphere's curvature.
    assert normaliser(degrees) == pytest.approx(expected, abs=6e-7)
    sigma = np.radians(degrees) / 3
    assert normaliser(degrees) == pytest.approx(2 * np.pi * sigma**2 * (1 - sigma**2 / 3), rel=sigma**4)


def test_lobes_have_energy_one_and_lose_what_is_below_the_horizon():
    found = lobe_columns(GRID, LOBES).sum(-1)
    cosine = GRID.direction[GRID.octant, 2]
    np.testing.assert_array_equal(found[:, 0], 1)
    # 4.8 standard deviations of the widest above the horizon: everything. The rest is summation.
    np.testing.assert_allclose(found[cosine > np.sin(np.radians(7 * 4.8))], 1, rtol=1e-12)
    # The cell nearest to the horizon, by random views in it.
    low = int(cosine.argmin())
    rng = np.random.default_rng(0)
    p = GRID.position[GRID.octant[low]] + rng.uniform(-1, 1, (400_000, 2)) / GRID.resolution
    p = p[(p**2).sum(1) < 1]
    elevation = np.arcsin(np.sqrt(1 - (p**2).sum(1)))
    tilt = np.radians(np.array(LOBES[1:]) / 3) * rng.standard_normal((len(p), 1))  # plane: the lobes are narrow
    above = (elevation[:, None] + tilt > 0).mean(0)
    # The outermost of 16 rings of equal energy is at 2.6 sigma; a tail beyond it, below 1/32, is only seen as a ring.
    np.testing.assert_allclose(found[low, 1:], above, atol=1 / 32)


def test_lobes_lie_about_the_mirror_direction():
    columns = lobe_columns(GRID, LOBES)
    steep = GRID.direction[GRID.octant, 2] > 0.8
    mirror = GRID.direction[GRID.octant][steep] * (-1, -1, 1)
    angle = np.arccos(np.clip(mirror @ GRID.direction.T, -1, 1))
    spread = np.sqrt((columns[steep] * angle[:, None] ** 2).sum(-1))
    sigma = np.radians(LOBES) / 3
    # Two axes of sigma each; cells of both ends widen it by their own 2 * (2/N)^2 / 12, more by 1/cos.
    low, high = np.sqrt(2) * sigma, np.sqrt(2 * sigma**2 + 2 * 2 * (2 / 16) ** 2 / 12 / 0.8**2)
    assert (spread[:, 1:] > low[1:]).all()
    assert (spread < high).all()


def test_components_sum_to_one():
    np.testing.assert_allclose(broad_columns(GRID).sum(-1), 1, rtol=1e-13)


def components(degrees=LOBES):
    lobes = lobe_columns(GRID, degrees)
    return np.concatenate([lobes / lobes.sum(-1, keepdims=True), broad_columns(GRID)], 1)


def test_expectation_maximisation_conserves_energy_on_any_data():
    y = np.random.default_rng(1).exponential(size=(len(GRID.octant), len(GRID)))
    g = components()
    y *= (g > 0).any(1)
    weights = expectation_maximisation(y, g)
    assert (weights >= 0).all()
    # Round-off of some hundred rounds.
    np.testing.assert_allclose(weights.sum(1), y.sum(1), rtol=1e-11)


def mixtures(g):
    rng = np.random.default_rng(2)
    truth = rng.exponential(size=g.shape[:2]) * (rng.uniform(size=g.shape[:2]) < 0.6)
    truth[:, 0] += 0.1
    return truth, np.einsum("mq,mqn->mn", truth, g)


def test_expectation_maximisation_finds_a_mixture_as_least_squares_does():
    g = components()[:, [0, 3, 4]]  # 0 and 21 degrees and the broadest term: far apart
    truth, y = mixtures(g)
    found = expectation_maximisation(y, g)
    for row in range(len(y)):
        squares, residual = nnls(g[row].T, y[row])
        assert residual < 1e-12 * y[row].sum()
        np.testing.assert_allclose(squares, truth[row], atol=1e-9)
        # EM stops when a round moves less than 1e-5 of the energy. A weight that should be 0 falls as 1/round, so by
        # its square every round: it is then sqrt(1e-5).
        np.testing.assert_allclose(found[row], squares, atol=np.sqrt(1e-5) * y[row].sum())


def test_expectation_maximisation_describes_any_mixture():
    # Neighbours (7 and 14 degrees in cells of 7) trade weight slowly, while the sum is long described.
    g = components()
    _, y = mixtures(g)
    found = expectation_maximisation(y, g)
    assert (np.abs(y - np.einsum("mq,mqn->mn", found, g)).sum(1) < 0.02 * y.sum(1)).all()


def test_least_squares_on_a_real_set():
    # The two norms differ, so weights may; lobes plus broad terms must describe the data about as well.
    brdfs = cook_torrance_set([(0.8, 0.08)], 16)
    y = fold(brdfs.grid, brdfs.values[0]) * brdfs.grid.area
    g = components()
    weights = expectation_maximisation(y, g)
    for row in range(len(y)):
        if brdfs.grid.direction[brdfs.grid.octant[row], 2] > 0.5:
            squares, best = nnls(g[row].T, y[row])
            residual = np.linalg.norm(y[row] - weights[row] @ g[row])
            # Least squares is the optimum of this norm: at least as good, by definition.
            assert best <= residual * (1 + 1e-9)
            assert residual < max(2 * best, 0.05 * np.linalg.norm(y[row]))
            assert squares.sum() == pytest.approx(weights[row].sum(), rel=0.05)  # EM's is exact


def test_a_mirror_is_the_lobe_of_width_zero():
    brdfs = cook_torrance_set([(1.0, 1e-5), (0.5, 1e-5)], 16)
    for degrees in (LOBES, MIRROR):
        lobes = fit_lobes(brdfs, degrees)
        assert lobes.energy.shape == (2, len(lobes.radius), len(degrees))
        cosine = np.sqrt(1 - lobes.radius**2)
        fresnel = np.stack([np.ones_like(cosine), 0.5 + 0.5 * (1 - cosine) ** 5])
        # The set's own error at grazing angles (means over a cell); elsewhere the mirror cell holds everything but
        # some 1e-4 that falls over its border.
        np.testing.assert_allclose(lobes.energy[:, cosine > 0.5, 0], fresnel[:, cosine > 0.5], atol=5e-3)
        remainder = brdfs.values - lobes_on_grid(GRID, lobes)
        assert (remainder**2).sum() < 1e-4 * (brdfs.values**2).sum()


def test_wider_lobes_go_to_wider_terms():
    # Half-vector lobes of roughness m have sigma = sqrt(2) m about the mirror direction: 2.3, 4.7, 7 degrees.
    brdfs = cook_torrance_set([(1.0, np.radians(k / 3) / np.sqrt(2)) for k in LOBES[1:]], 32)
    lobes = fit_lobes(brdfs)
    mean = (lobes.energy * np.array(LOBES)).sum(-1)[:, lobes.radius < 0.5].mean(1)
    np.testing.assert_allclose(mean, LOBES[1:], atol=2.5)  # degrees; a third of the step from lobe to lobe
    assert (np.diff(mean) > 4).all()


def test_a_matte_set_keeps_its_light():
    brdfs = blinn_phong_set([1.0], 16)
    lobes = fit_lobes(brdfs)
    steep = lobes.radius < 0.8
    total = fold(GRID, brdfs.values[0]).sum(1).mean() * GRID.area
    assert lobes.energy[0, steep].sum(-1).max() < 0.02 * total  # EM leaves a little everywhere


def test_no_lobes_and_black_entries():
    brdfs = table_set(np.stack([np.zeros((len(GRID), len(GRID))), cook_torrance_set([(1.0, 0.1)], 16).values[0]]), 16)
    none = fit_lobes(brdfs, ())
    assert not lobes_on_grid(GRID, none).any()
    assert none.at(np.array([1.0, 0.0]), np.zeros(3)).shape == (3, 0)
    lobes = fit_lobes(brdfs)
    assert not lobes.energy[0].any()
    assert lobes.energy[1].any()


def test_light_that_no_component_reaches_is_left_alone():
    # A table that only sends grazing light back where it came from.
    table = np.zeros((1, len(GRID), len(GRID)))
    low = GRID.direction[:, 2].argmin()
    table[0, low, low] = 1.0
    assert not fit_lobes(table_set(table, 16)).energy.any()


def test_energies_between_nodes_and_entries():
    lobes = fit_lobes(cook_torrance_set([(1.0, 0.03), (0.2, 0.1)], 8))
    mix = np.array([0.25, 0.75])
    nodes = np.einsum("h,hrk->rk", mix, lobes.energy)
    np.testing.assert_allclose(lobes.at(mix, lobes.radius), nodes, rtol=1e-14)
    middle = 0.5 * (lobes.radius[:-1] + lobes.radius[1:])
    np.testing.assert_allclose(lobes.at(mix, middle), 0.5 * (nodes[:-1] + nodes[1:]), rtol=1e-12)
    np.testing.assert_array_equal(lobes.at(mix, np.array([0.0, 1.0])), nodes[[0, -1]])


def test_lobes_on_the_grid_are_isotropic():
    brdfs = cook_torrance_set([(1.0, 0.05)], 16)
    f_s = lobes_on_grid(GRID, fit_lobes(brdfs))
    for image in GRID.images:
        np.testing.assert_allclose(f_s[:, image][:, :, image], f_s, rtol=1e-12, atol=1e-300)
