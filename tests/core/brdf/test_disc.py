"""The disc grid: measure, symmetries, interpolation."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relightcli.core.brdf.disc import bilinear, cell_of, disc_grid, fold, spread, sub_directions
from relightcli.errors import InputError
from tests.core.brdf.reflectances import direction, hemisphere

SIZES = [2, 4, 8, 16, 32]


@pytest.mark.parametrize("n", SIZES)
def test_cells_are_the_centres_inside_the_disc_and_share_its_area(n):
    grid = disc_grid(n)
    centre = (np.arange(n) + 0.5) * 2 / n - 1
    inside = np.hypot(*np.meshgrid(centre, centre)) < 1
    assert len(grid) == inside.sum()
    assert grid.area * len(grid) == pytest.approx(np.pi, rel=1e-15)
    assert np.linalg.norm(grid.direction, axis=1) == pytest.approx(1, rel=1e-15)
    # The square cells alone: within the 4 % (N >= 8) and 1 % (N = 32) that the module names.
    if n >= 8:
        assert len(grid) * 4 / n**2 == pytest.approx(np.pi, rel=0.01 if n == 32 else 0.04)


def test_sums_over_cells_are_cosine_integrals():
    light, weight = hemisphere(40, 40)
    for power in (0, 1, 2, 4):
        exact = (light[:, 2] ** power * light[:, 2] * weight).sum()
        # A midpoint rule with a ragged rim: second order, and 1/N of the rim's cells out of place.
        assert (disc_grid(32).direction[:, 2] ** power).sum() * disc_grid(32).area == pytest.approx(exact, rel=0.02)


@pytest.mark.parametrize("n", SIZES)
def test_symmetries(n):
    grid = disc_grid(n)
    x, y = grid.position.T
    expected = [(x, y), (-y, x), (-x, -y), (y, -x), (y, x), (x, -y), (-y, -x), (-x, y)]
    for image, (a, b) in zip(grid.images, expected, strict=True):
        np.testing.assert_array_equal(grid.position[image], np.stack([a, b], -1))
    np.testing.assert_array_equal(grid.position[grid.mirror], -grid.position)
    assert set(grid.images[:, grid.octant].ravel()) == set(range(len(grid)))
    radius = (grid.position[grid.images[:, grid.octant]] ** 2).sum(-1)
    np.testing.assert_array_equal(radius, np.broadcast_to(radius[0], radius.shape))


@pytest.mark.parametrize("n", SIZES)
def test_directions_fall_into_their_cell_or_the_nearest(n):
    grid = disc_grid(n)
    np.testing.assert_array_equal(cell_of(grid, grid.direction), np.arange(len(grid)))
    light, _ = hemisphere(60, 60)
    distance = np.abs(light[:, :2] - grid.position[cell_of(grid, light)]).max(1)
    inner = np.linalg.norm(light[:, :2], axis=1) < 1 - 2 * np.sqrt(2) / n
    # Half a cell; at the rim one more at most.
    assert (distance[inner] <= 1 / n + 1e-12).all()
    assert (distance <= 3 / n + 1e-12).all()


def test_views_of_a_cell_stay_in_it_and_in_the_disc():
    grid = disc_grid(16)
    views = sub_directions(grid, np.arange(len(grid)))
    used = views[..., 2] > 0
    assert used.any(1).all()
    assert not views[~used].any()
    off = np.abs(views[..., :2] - grid.position[:, None, :]).max(-1)
    assert off[used].max() == pytest.approx(0.75 / 16)
    inner = np.linalg.norm(grid.position, axis=1) < 0.9
    np.testing.assert_allclose(views[inner, :, :2].mean(1), grid.position[inner], atol=1e-15)


@pytest.mark.parametrize("n", SIZES)
def test_interpolation_at_centres_returns_them(n):
    grid = disc_grid(n)
    values = np.random.default_rng(0).standard_normal(len(grid))
    index, weight = bilinear(grid, grid.direction)
    # p is found again from the unit direction to one rounding, times N/2.
    np.testing.assert_allclose((values[index] * weight).sum(-1), values, atol=1e-13 * n)


@pytest.mark.parametrize("n", SIZES)
@settings(max_examples=60, deadline=None, derandomize=True)
@given(u=st.floats(0, 1), phi=st.floats(0, 2 * np.pi))
def test_interpolation_weights_everywhere(n, u, phi):
    grid = disc_grid(n)
    at = np.array([np.sqrt(u) * np.cos(phi), np.sqrt(u) * np.sin(phi), np.sqrt(1 - u)])
    index, weight = bilinear(grid, at)
    assert weight.sum() == pytest.approx(1, rel=1e-14)
    assert (weight >= 0).all()
    value = (grid.position[index, 0] * weight).sum()
    # Inside, bilinear interpolation is exact for linear functions; at the rim it is within the cells it takes.
    assert value == pytest.approx(at[0], abs=1e-13 if u < (1 - 2 * np.sqrt(2) / n) ** 2 and n > 4 else 3 / n)


def test_interpolation_keeps_the_symmetries():
    grid = disc_grid(16)
    light = direction(np.linspace(0, 0.5 * np.pi, 50), 0.3 + np.arange(50))
    values = np.random.default_rng(1).standard_normal(len(grid))

    def read(v, p):
        index, weight = bilinear(grid, p)
        return (v[index] * weight).sum(-1)

    turned = light[:, [1, 0, 2]] * (-1, 1, 1)
    np.testing.assert_allclose(read(values[grid.images[1]], light), read(values, turned), atol=1e-13)


def test_spread_and_fold():
    grid = disc_grid(8)
    values = np.random.default_rng(2).uniform(size=(3, len(grid), len(grid)))
    rows = fold(grid, values)
    whole = spread(grid, rows)
    for image in grid.images:
        np.testing.assert_allclose(whole[:, image][:, :, image], whole, rtol=1e-14)
    np.testing.assert_allclose(fold(grid, whole), rows, rtol=1e-14)
    assert whole.sum() == pytest.approx(values.sum(), rel=1e-13)


@pytest.mark.parametrize("n", [-2, 0, 1, 7])
def test_other_resolutions_are_refused(n):
    with pytest.raises(InputError, match="even"):
        disc_grid(n)
