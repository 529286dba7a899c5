"""BRDF sets: values, energy of narrow lobes, symmetries, extremes."""

import numpy as np
import pytest

from relightcli.core.brdf.dataset import blinn_phong_set, cook_torrance_set, table_set
from relightcli.core.brdf.disc import disc_grid
from relightcli.errors import InputError
from tests.core.brdf.reflectances import N, hemisphere, value, white

GRID = disc_grid(16)


def albedo(brdfs):
    """Sum of f dA over light cells: (H, view cells)."""
    return brdfs.values.sum(2) * brdfs.grid.area


def at_centres(m, grid):
    light, view = grid.direction[None, :, :], grid.direction[:, None, :]
    return value(m, light, view)[..., 0] / light[..., 2]


@pytest.mark.parametrize(
    ("brdfs", "m"),
    [
        (blinn_phong_set([0.0, 3.0], 16), white("blinn-phong", shininess=3.0)),
        (cook_torrance_set([(1.0, 1.0), (0.3, 3.0)], 16), white("cook-torrance", f0=0.3, roughness=3.0)),
    ],
)
def test_wide_lobes_are_the_models_values(brdfs, m):
    wide = GRID.direction[:, 2] > 0.4  # beyond, they are narrower than 1.5 cells
    both = np.ix_(wide, wide)
    np.testing.assert_allclose(brdfs.values[1][both], at_centres(m, GRID)[both], rtol=1e-12)


def test_default_exponents_are_the_papers():
    brdfs = blinn_phong_set(resolution=4)
    np.testing.assert_array_equal(brdfs.parameters[:, 0], np.arange(1, 201))
    assert brdfs.values.shape == (200, 12, 12)


SETS = [
    blinn_phong_set([0.0, 1.0, 30.0, 200.0, 1e6], 16),
    cook_torrance_set([(f, m) for f in (0.0, 0.5, 1.0) for m in (1e-7, 0.005, 0.05, 0.3, 1.0, 50.0)], 16),
]


@pytest.mark.parametrize("brdfs", SETS, ids=["blinn-phong", "cook-torrance"])
def test_reciprocity_and_isotropy_on_the_grid(brdfs):
    np.testing.assert_array_equal(brdfs.values, np.swapaxes(brdfs.values, 1, 2))
    for image in brdfs.grid.images:
        # Sums of up to 8 terms in another order.
        np.testing.assert_allclose(brdfs.values[:, image][:, :, image], brdfs.values, rtol=1e-13)


@pytest.mark.parametrize("brdfs", SETS, ids=["blinn-phong", "cook-torrance"])
def test_extremes_are_finite_and_not_negative(brdfs):
    assert np.isfinite(brdfs.values).all()
    assert (brdfs.values >= 0).all()


@pytest.mark.parametrize("resolution", [8, 16, 32])
@pytest.mark.parametrize("roughness", [1e-6, 0.001, 0.005])
def test_narrow_lobes_keep_their_energy_at_every_angle(roughness, resolution):
    # A mirror of f0 = 1 reflects everything. The V-cavity takes nothing from it, and the horizon less than the lobe's
    # width over the last cell's cosine, 0.005 / 0.15 of a lobe; swapping view and light cells moves as little.
    found = albedo(cook_torrance_set([(1.0, roughness)], resolution))
    np.testing.assert_allclose(found, 1, atol=5e-3)


def test_a_narrow_lobe_reflects_by_its_fresnel_term():
    grid = disc_grid(32)
    found = albedo(cook_torrance_set([(0.0, 0.002), (0.4, 0.002)], 32))
    cosine = grid.direction[:, 2]
    for f0, row in zip((0.0, 0.4), found, strict=True):
        steep = cosine > 0.6
        # Means over a cell of (1 - cos)^5, which curves by about 1 % of a cell there, and lobes of 0.2 % width.
        np.testing.assert_allclose(row[steep], (f0 + (1 - f0) * (1 - cosine) ** 5)[steep], atol=2e-3)


@pytest.mark.parametrize(
    ("brdfs", "m"),
    [
        (cook_torrance_set([(0.8, 0.1)], 32), white("cook-torrance", f0=0.8, roughness=0.1)),
        (cook_torrance_set([(0.8, 0.5)], 32), white("cook-torrance", f0=0.8, roughness=0.5)),
        (blinn_phong_set([200.0], 32), white("blinn-phong", shininess=200.0)),
    ],
)
def test_reflectance_is_the_models(brdfs, m):
    light, weight = hemisphere(200, 200)
    for cell in np.flatnonzero(brdfs.grid.direction[:, 2] > 0.4)[::50]:
        exact = (value(m, light, brdfs.grid.direction[cell])[:, 0] * weight).sum()
        # Lobes of 1.5 cells width summed at centres, or means over a view cell: a few parts in a thousand each.
        assert albedo(brdfs)[0, cell] == pytest.approx(exact, rel=0.015)


def test_means_over_cells_by_brute_force():
    brdfs = cook_torrance_set([(1.0, 0.08)], 16)
    grid = brdfs.grid
    view = grid.octant[5]
    rng = np.random.default_rng(0)
    lights = np.argsort(-brdfs.values[0, view])[:4]
    for light in lights:
        p = grid.position[[view, light]] + rng.uniform(-1, 1, (200_000, 2, 2)) / grid.resolution
        w = np.concatenate([p, np.sqrt(1 - (p**2).sum(-1, keepdims=True))], -1)
        f = value(white("cook-torrance", f0=1.0, roughness=0.08), w[:, 0], w[:, 1])[:, 0] / w[:, 0, 2]
        # A midpoint rule of 4 x 4 views for the overlap of lobe and cell, here half a cell wide: a relative error of
        # about (1/4)^2 / (2 * 0.5)^2 = 6 %. And five standard errors of the brute force.
        error = 5 * f.std() / np.sqrt(len(f))
        assert brdfs.values[0, view, light] == pytest.approx(f.mean(), rel=0.06, abs=error)


def test_normal_incidence_of_a_narrow_exponent():
    brdfs = blinn_phong_set([1e6], 32)
    # Reflectance of the model is 1 at normal incidence; the nearest cells are 2.5 degrees off it.
    nearest = brdfs.grid.direction[:, 2].argmax()
    assert albedo(brdfs)[0, nearest] == pytest.approx(1, abs=5e-3)
    assert value(white("blinn-phong", shininess=1e6), N, N)[0] > 100 * brdfs.values.max()


def test_a_table_is_taken_as_it_is():
    table = np.random.default_rng(3).uniform(size=(2, len(GRID), len(GRID))).astype(np.float32)
    brdfs = table_set(table, 16)
    np.testing.assert_array_equal(brdfs.values, table)
    assert brdfs.values.dtype == np.float64
    assert brdfs.parameters.shape == (2, 0)


@pytest.mark.parametrize("points", [[], [(1.1, 0.2)], [(-0.1, 0.2)], [(0.5, 0.0)], [(0.5, np.nan)], [(0.5, np.inf)]])
def test_impossible_cook_torrance_points(points):
    with pytest.raises(InputError, match="f0 from 0 to 1"):
        cook_torrance_set(points, 4)


@pytest.mark.parametrize("exponents", [[], [-1.0], [np.nan], [1e13]])
def test_impossible_exponents(exponents):
    with pytest.raises(InputError, match="exponents"):
        blinn_phong_set(exponents, 4)


def test_impossible_tables():
    good = np.ones((2, 12, 12))
    for shape in ((0, 12, 12), (12, 12), (2, 12, 11), (2, 13, 13)):
        with pytest.raises(InputError, match=r"\(entries, 12, 12\)"):
            table_set(np.ones(shape), 4)
    for bad in (-1.0, np.nan, np.inf):
        good[1, 2, 3] = bad
        with pytest.raises(InputError, match="negative or not finite"):
            table_set(good, 4)
