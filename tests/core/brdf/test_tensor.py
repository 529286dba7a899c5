"""The factorised set as a whole: errors, isotropy, evaluation, hard cases."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from relightcli.core.brdf.dataset import blinn_phong_set, cook_torrance_set, table_set
from relightcli.core.brdf.disc import bilinear
from relightcli.core.brdf.specular_lobes import LOBES, MIRROR, lobes_on_grid
from relightcli.core.brdf.tensor import evaluate, factorise_dataset, lobes_at, remainder_at
from relightcli.core.compress.tucker import hooi
from tests.core.brdf.reflectances import direction, random_directions

CT = cook_torrance_set([(f, m) for f in (0.0, 1.0) for m in (0.005, 0.05, 0.2, 1.0)], 12)
FULL = (8, 112, 112)


def rebuilt(brdf):
    """F^ on the grid: (H, n, n)."""
    tensor = np.einsum("hi,oj,lk,ijk->hol", brdf.reflectance, brdf.view, brdf.light, brdf.core, optimize=True)
    return tensor + lobes_on_grid(brdf.grid, brdf.lobes)


@pytest.mark.parametrize("degrees", [LOBES, MIRROR, ()])
@pytest.mark.parametrize("ranks", [(1, 1, 1), (4, 8, 8), FULL])
def test_error_is_the_reconstructions(degrees, ranks):
    brdf = factorise_dataset(CT, ranks, degrees)
    difference = ((CT.values - rebuilt(brdf)) ** 2).sum() / (CT.values**2).sum()
    # |X|^2 - |G|^2 cancels to round-off of the whole.
    assert brdf.error == pytest.approx(difference, abs=1e-12)
    # Full ranks drop what is below 1e-7 of the largest singular value.
    assert brdf.error < (1e-10 if ranks == FULL else 1)


def test_lobes_lower_the_error_of_shiny_sets():
    shiny = cook_torrance_set([(0.5, m) for m in (0.005, 0.01, 0.02, 0.04)], 12)
    # Without lobes this is nearly a set of mirrors: the identity, of which 8 of 112 directions are 7 %.
    assert factorise_dataset(shiny, degrees=()).error > 0.8
    assert factorise_dataset(shiny, degrees=MIRROR).error < 0.05
    assert factorise_dataset(shiny).error < 0.01


@lru_cache
def smooth():
    return blinn_phong_set([1.0, 2.0, 5.0, 10.0, 20.0, 35.0], 16)


def turned(directions, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return directions @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


VIEW, LIGHT = random_directions(3000, 1, 0.25), random_directions(3000, 2, 0.25)
WEIGHTS = np.array([0.0, 0.2, 0.0, 0.3, 0.0, 0.5])


def change(read, degrees):
    """Relative RMS change of read(view, light) when both are turned."""
    before, after = read(VIEW, LIGHT), read(turned(VIEW, degrees), turned(LIGHT, degrees))
    return np.linalg.norm(after - before) / np.linalg.norm(before)


def data(view, light):
    """The set itself, interpolated bilinearly."""
    mixed = np.tensordot(WEIGHTS, smooth().values, 1)
    (o, v), (i, w) = bilinear(smooth().grid, view), bilinear(smooth().grid, light)
    return np.einsum("sa,sb,sab->s", v, w, mixed[o[:, :, None], i[:, None, :]])


@pytest.mark.parametrize("n", range(4, 12))
def test_turning_both_directions_changes_only_by_the_grid(n):
    brdf = factorise_dataset(smooth(), (4, n, n), ())

    def read(view, light):
        return remainder_at(brdf, WEIGHTS, view, light)

    assert brdf.view.shape[1] in (n, n + 1)
    assert (brdf.view.shape[1] > n) == (1 in brdf.closed)
    # A quarter turn is a symmetry of the grid: round-off, through eigenvectors that are pairs to 1e-10.
    assert change(read, 90) < 1e-8
    # 37 degrees is not: what is left is the grid's own anisotropy, which interpolating the data themselves shows too
    # (4.2 %, most of it at grazing angles), and which an approximation of lower order should show less.
    assert change(read, 37) < 1.1 * change(data, 37) < 0.05


@pytest.mark.parametrize("n", [5, 7, 9, 11])
def test_a_cut_pair_would_be_seen(n):
    kept = factorise_dataset(smooth(), (4, n, n), ())
    tucker = hooi(smooth().values, (4, n, n))
    reflectance, view, light = tucker.factors
    cut = replace(kept, reflectance=reflectance, view=view, light=light, core=tucker.core)

    def read(view, light):
        return remainder_at(cut, WEIGHTS, view, light)

    # 33, 21, 9 and 9 %. n = 5 cuts a pair of m = 2, to which a quarter turn is blind.
    assert change(read, 37) > 2 * change(data, 37)


@pytest.mark.parametrize("degrees", [LOBES, ()])
def test_evaluation_at_cells_of_entries_is_the_reconstruction(degrees):
    brdf = factorise_dataset(CT, (4, 8, 8), degrees)
    expected = rebuilt(brdf) - lobes_on_grid(brdf.grid, brdf.lobes)
    d = brdf.grid.direction
    for h in range(len(CT)):
        found = remainder_at(brdf, np.eye(len(CT))[h], d[:, None], d[None, :])
        np.testing.assert_allclose(found, expected[h], atol=1e-11 * np.abs(expected).max())


def test_evaluation_is_linear_in_the_weights():
    brdf = factorise_dataset(CT)
    view, light = random_directions(100, 3, 0.1), random_directions(100, 4, 0.1)
    weights = np.linspace(0, 1, len(CT))
    each = np.stack([evaluate(brdf, w, view, light) for w in np.eye(len(CT))])
    np.testing.assert_allclose(evaluate(brdf, weights, view, light), weights @ each, atol=1e-12 * np.abs(each).max())


def test_lobes_carry_their_energy():
    brdf = factorise_dataset(cook_torrance_set([(1.0, 0.02), (0.5, 0.1)], 16))
    weights = np.array([0.5, 0.5])
    view = direction(0.5, 0.3)
    # A fine grid about the mirror direction, far from the horizon.
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 801), np.linspace(-0.4, 0.4, 801))
    p = np.stack([x, y], -1) - view[:2]
    light = np.concatenate([p, np.sqrt(np.maximum(1 - (p**2).sum(-1, keepdims=True), 0))], -1)
    found = lobes_at(brdf, weights, view, light).sum() * 0.001**2  # dA
    # The edge of the disc that stands for the delta, in steps of 1/1000.
    assert found == pytest.approx(brdf.lobes.at(weights, np.sin(0.5)).sum(), rel=2e-3)


def test_lobes_are_isotropic_and_nothing_is_below_the_surface():
    brdf = factorise_dataset(CT)
    weights = np.ones(len(CT))

    def read(view, light):
        return lobes_at(brdf, weights, view, light)

    near = random_directions(3000, 5, 0.25)
    view, light = near, turned(near * (-1, -1, 1), 1.0)
    np.testing.assert_allclose(read(turned(view, 37), turned(light, 37)), read(view, light), rtol=1e-9)
    assert not evaluate(brdf, weights, -view, light).any()
    assert not evaluate(brdf, weights, view, -light).any()
    assert (read(view, light) > 0).any()


def test_reciprocity_of_the_tensor():
    # Without lobes F is symmetric in o and i, and so is its approximation, but for the order in which HOOI updates
    # them: it stops at changes of 1e-6 in error^2, 1e-3 in the norm.
    brdf = factorise_dataset(CT, degrees=())
    near = rebuilt(brdf)
    assert np.linalg.norm(near - np.swapaxes(near, 1, 2)) < 1e-3 * np.linalg.norm(near)


def test_full_ranks_return_the_data_interpolated():
    brdf = factorise_dataset(CT, FULL, ())
    weights = np.linspace(1, 2, len(CT))
    view, light = random_directions(500, 6, 0.0), random_directions(500, 7, 0.0)
    (o, v), (i, w) = bilinear(CT.grid, view), bilinear(CT.grid, light)
    mixed = np.tensordot(weights, CT.values, 1)
    expected = np.einsum("sa,sb,sab->s", v, w, mixed[o[:, :, None], i[:, None, :]])
    # What is below 1e-7 of the largest singular value is dropped.
    np.testing.assert_allclose(evaluate(brdf, weights, view, light), expected, atol=1e-5 * expected.max())


@pytest.mark.parametrize(
    "brdfs",
    [
        blinn_phong_set([20.0], 8),
        blinn_phong_set([1e6], 8),
        cook_torrance_set([(0.0, 0.005)], 8),
        cook_torrance_set([(1.0, 1.0), (1.0, 1.0)], 8),
        blinn_phong_set([5.0, 6.0], 2),
        table_set(np.zeros((2, 12, 12)), 4),
        table_set(np.ones((1, 12, 12)), 4),
    ],
    ids=["one", "1e6", "0.005", "twice the same", "four cells", "black", "constant"],
)
@pytest.mark.parametrize("degrees", [LOBES, ()])
def test_hard_sets(brdfs, degrees):
    brdf = factorise_dataset(brdfs, (1000, 1000, 1000), degrees)
    assert brdf.error < 1e-10  # ranks beyond the data: everything comes back, to the square root of round-off
    view = direction(0.5 * np.pi - np.array([0, 1e-12, 1e-6, 1e-3, 0.5, 0.5 * np.pi]), 0.7)
    found = evaluate(brdf, np.ones(len(brdfs)) / len(brdfs), view[:, None], view[None, :] * (-1, -1, 1))
    assert np.isfinite(found).all()
    np.testing.assert_allclose(rebuilt(brdf), brdfs.values, atol=1e-5 * max(brdfs.values.max(), 1e-300))
