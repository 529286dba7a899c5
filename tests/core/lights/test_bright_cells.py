"""Cells that hold much of a map's light: which ones are cut, and that their parts hold what the cells did."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.lights.bright_cells import LEAST, MOST, PARTS, bright_cells, cut
from relightcli.core.lights.environment import latlong_to_cube
from relightcli.core.sphere import cube

SIDE = 64


def test_cells_are_chosen_by_their_share_of_the_error():
    flux = np.ones((1000, 3))
    flux[7], flux[500] = 400.0, 300.0
    error = np.full(1000, 0.05)
    total = 998.0 + 700.0
    assert 0.05 * 300.0 / total > LEAST
    assert bright_cells(flux, error).tolist() == [7, 500]
    error[7] = 0.5 * LEAST * total / 400.0
    assert bright_cells(flux, error).tolist() == [500]
    assert len(bright_cells(np.zeros((5, 3)), np.ones(5))) == 0
    # No more than MOST, and no tie is decided by a rounding.
    rising = 1.0 + 0.1 * np.arange(100.0)
    assert bright_cells(np.ones((100, 3)), rising).tolist() == list(range(100 - MOST, 100))
    rising[-MOST - 1] = rising[-MOST] * (1.0 - 1e-9)
    assert bright_cells(np.ones((100, 3)), rising).tolist() == list(range(101 - MOST, 100))
    assert len(bright_cells(np.ones((100, 3)), np.ones(100))) == 0
    # Whatever the light is scaled by, and for light that was taken away.
    assert bright_cells(-1e9 * flux, error).tolist() == [500]


@pytest.mark.parametrize("face", range(6))
@pytest.mark.parametrize("turn", [0.0, 73.0])
def test_parts_hold_the_light_of_the_texels_that_they_cover(face, turn):
    """A map whose radiance is linear in the direction: against the exact flux of the texels, to what pixels
    that lie on a part's border make of it."""
    height = 256
    latitude = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    longitude = np.pi * (1.0 - 2.0 * (np.arange(2 * height) + 0.5) / (2 * height))
    d = np.stack(
        [np.sin(longitude) * np.cos(latitude)[:, None], np.sin(latitude)[:, None] + 0 * longitude,
         np.cos(longitude) * np.cos(latitude)[:, None]], -1,
    )  # fmt: skip
    sky = (1.0 + 0.9 * d).astype(np.float32)
    texels = latlong_to_cube(sky, SIDE, turn).flux.reshape(6, SIDE, SIDE, 3)
    cell = np.array([[face, 16, 32, 40, 48]])
    inside = texels[face, 16:32, 40:48]
    whole = inside.sum(axis=(0, 1))
    found = cut(cell, whole[None], SIDE, sky, turn)
    parts = inside.reshape(PARTS, 4, PARTS, 2, 3).sum(axis=(1, 3)).reshape(-1, 3)
    np.testing.assert_allclose(found.flux.sum(axis=0), whole, rtol=1e-12)
    np.testing.assert_allclose(found.flux, parts, rtol=0.01)  # radiance is linear, lights are 16 along a side
    np.testing.assert_allclose(
        found.direction.reshape(PARTS, PARTS, 3),
        cube.face_directions(
            face,
            (2.0 * (40 + 2 * np.arange(PARTS)[None, :] + 1.0) / SIDE) - 1.0,
            (2.0 * (16 + 4 * np.arange(PARTS)[:, None] + 2.0) / SIDE) - 1.0,
        ),
        atol=1e-15,
    )


def test_only_lit_parts_are_kept_and_single_texels_stay_whole():
    sky = np.zeros((128, 256, 3), np.float32)
    sky[60:64, 126:130] = 5.0  # about +Z
    cells = np.array([[4, 0, SIDE, 0, SIDE], [4, 32, 33, 32, 33]])
    flux = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    found = cut(cells, flux, SIDE, sky)
    assert 1 < len(found.flux) < PARTS * PARTS + 1
    np.testing.assert_allclose(found.flux[-1], flux[1], rtol=1e-12)
    np.testing.assert_allclose(found.flux.sum(axis=0), flux.sum(axis=0), rtol=1e-12)
    assert (found.direction[:, 2] > 0.9).all()
    assert len(cut(cells[:0], flux[:0], SIDE, sky).flux) == 0


@pytest.mark.parametrize("size", [(1, 2), (3, 5), (16, 32), (64, 128)])
@pytest.mark.parametrize("turn", [0.0, 200.0])
def test_no_pixel_is_missed(size, turn):
    """A map of one bright pixel after the other: each lies in the cells that it overlaps, wherever that is."""
    faces = np.array([[f, 0, SIDE, 0, SIDE] for f in range(6)])
    rng = np.random.default_rng(7)
    for _ in range(12):
        sky = np.full((*size, 3), 1e-3, np.float32)
        bright = rng.integers(0, size[0]), rng.integers(0, size[1])
        sky[bright] = 1e6
        texels = latlong_to_cube(sky, SIDE, turn).flux.reshape(6, SIDE, SIDE, 3)
        parts = texels.reshape(6, PARTS, SIDE // PARTS, PARTS, SIDE // PARTS, 3).sum(axis=(2, 4)).reshape(-1, 3)
        found = cut(faces, texels.sum(axis=(1, 2)), SIDE, sky, turn)
        assert len(found.flux) == len(parts)
        # What lies across a border goes to one side: less than half of the light of 2 x 2 lights, or more, a pixel.
        assert np.abs(found.flux - parts).sum() < parts.sum()
        well_lit = parts[:, 0] > 0.5 * parts[:, 0].max()
        assert (found.flux[well_lit, 0] > 0.4 * parts[well_lit, 0]).all()


def test_light_that_is_below_nothing_is_spread_evenly():
    cells, flux = np.array([[0, 0, SIDE, 0, SIDE]]), np.array([[1.0, 0.0, 2.0]])
    for sky in (np.zeros((8, 16, 3), np.float32), np.full((8, 16, 3), -1.0, np.float32)):
        found = cut(cells, flux, SIDE, sky)
        assert len(found.flux) == PARTS * PARTS
        np.testing.assert_allclose(found.flux, np.tile(flux / PARTS**2, (PARTS**2, 1)), rtol=1e-12)


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (5, 7), (32, 64)])
def test_even_light_stays_even(size):
    """However the map is cut into pixels, and however small the cell: to the roundings of a mean of equal numbers."""
    cells = np.array([[2, 0, SIDE, 0, SIDE], [0, 3, 19, 8, 24], [5, 32, 36, 0, 4], [3, 32, 33, 32, 33]])
    sky = np.ones((*size, 3), np.float32)
    flux = np.ones((4, 3))
    once, again = cut(cells, flux, SIDE, sky, 17.0), cut(cells, flux, SIDE, np.ones((64, 128, 3), np.float32))
    np.testing.assert_allclose(once.flux, again.flux, rtol=1e-12)
    np.testing.assert_allclose(once.flux.sum(axis=0), 4.0, rtol=1e-12)
    np.testing.assert_array_equal(once.direction, again.direction)
