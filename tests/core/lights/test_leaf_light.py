"""Light of a map shared out over leaves: exact totals, the right places, and edits that stay where they are."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relightcli.core.lights import quadtree
from relightcli.core.lights.environment import latlong_to_cube
from relightcli.core.lights.leaf_light import leaf_light
from tests.core.lights.test_quadtree import random_leaves
from tests.core.shade.skies import patchy_map, smooth_map


def full_tree(resolution):
    every = [(f, i, i + 1, j, j + 1) for f in range(6) for i in range(resolution) for j in range(resolution)]
    return quadtree.build_tree(every, resolution)


def exact(radiance, rotate=0.0):
    """Flux (3,) and moment (3, 3) of a map, pixel by pixel in closed form."""
    height, width = radiance.shape[:2]
    lat = math.pi * (0.5 - np.arange(height + 1) / height)
    lon = math.pi * (1 - 2 * np.arange(width + 1) / width) + math.radians(rotate)
    area = np.outer(np.sin(lat[:-1]) - np.sin(lat[1:]), lon[:-1] - lon[1:])
    half = 0.5 * (lat + np.sin(lat) * np.cos(lat))
    x = np.outer(half[:-1] - half[1:], np.cos(lon[1:]) - np.cos(lon[:-1]))
    z = np.outer(half[:-1] - half[1:], np.sin(lon[:-1]) - np.sin(lon[1:]))
    y = np.outer(0.5 * (np.sin(lat[:-1]) ** 2 - np.sin(lat[1:]) ** 2), lon[:-1] - lon[1:])
    pixels = radiance.astype(np.float64)
    flux = np.einsum("ij,ijc->c", area, pixels)
    return flux, np.stack([np.einsum("ij,ijc->c", m, pixels) for m in (x, y, z)], axis=1)


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (3, 5), (64, 128)])
@pytest.mark.parametrize("rotate", [0.0, 77.0])
def test_all_light_arrives(shape, rotate):
    radiance = np.random.default_rng(0).random((*shape, 3)).astype(np.float32)
    tree = quadtree.build_tree(random_leaves(50, 3), 50)
    found = leaf_light(radiance, tree, rotate)
    flux, moment = exact(radiance, rotate)
    np.testing.assert_allclose(found.flux.sum(0), flux, rtol=1e-12)
    # The middle of a strip stands for its longitudes exactly, of the latitudes' antiderivative a table does.
    np.testing.assert_allclose(found.moment.sum(0), moment, atol=1e-8 * flux.max())


@pytest.mark.parametrize("sky", [smooth_map(), patchy_map(1)], ids=["smooth", "patchy"])
@pytest.mark.parametrize("rotate", [0.0, 33.0])
def test_single_texels_as_the_sky_cube_has_them(sky, rotate):
    cube = latlong_to_cube(sky, 16, rotate)
    found = leaf_light(sky, full_tree(16), rotate)
    # Corners of texels lie within strips here; the sky cube has a border at every one.
    assert np.abs(found.flux - cube.flux).sum() < 8e-3 * cube.flux.sum()
    assert np.abs(found.moment - cube.moment).sum() < 1.2e-2 * cube.flux.sum()


def test_a_sun_arrives_in_its_leaf():
    sky = np.zeros((512, 1024, 3), np.float32)
    sky[100, 300] = (1e6, 2e6, 3e6)
    tree = quadtree.build_tree(random_leaves(64, 4), 64)
    found = leaf_light(sky, tree)
    lat, lon = math.pi * (0.5 - 100.5 / 512), math.pi * (1 - 300.5 / 512)
    d = np.array([[math.sin(lon) * math.cos(lat), math.sin(lat), math.cos(lon) * math.cos(lat)]])
    leaf = int(quadtree.leaves_at(tree, d)[0])
    np.testing.assert_allclose(found.flux[leaf], exact(sky)[0], rtol=1e-10)
    np.testing.assert_allclose(found.moment[leaf, 0] / found.flux[leaf, 0], d[0], atol=1e-4)


def test_rows_part_the_light_and_edits_stay_within_them():
    rng = np.random.default_rng(2)
    sky = rng.random((40, 80, 3)).astype(np.float32)
    tree = quadtree.build_tree(random_leaves(64, 5), 64)
    rows = np.sort(rng.integers(0, 41, (80, 2)), axis=1)
    above, below = rows.copy(), rows.copy()
    above[:, 0], above[:, 1] = 0, rows[:, 0]
    below[:, 0], below[:, 1] = rows[:, 1], 40
    whole = leaf_light(sky, tree, 20.0)
    parts = [leaf_light(sky, tree, 20.0, rows=r) for r in (above, rows, below)]
    np.testing.assert_allclose(sum(p.flux for p in parts), whole.flux, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(sum(p.moment for p in parts), whole.moment, rtol=1e-8, atol=1e-12)
    edited = sky.copy()
    for j, (a, b) in enumerate(rows):
        edited[:a, j] += 1
        edited[b:, j] += 1
    np.testing.assert_array_equal(leaf_light(edited, tree, 20.0, rows=rows).moment, parts[1].moment)


def test_leaves_that_an_edit_does_not_touch_keep_their_bits():
    sky = smooth_map()
    tree = quadtree.build_tree(random_leaves(64, 6), 64)
    before = leaf_light(sky, tree, 10.0)
    sky[4:6, 7:9] += 3
    after = leaf_light(sky, tree, 10.0)
    changed = (before.moment != after.moment).any(axis=(1, 2))
    only = leaf_light(_spot(), tree, 10.0)
    np.testing.assert_array_equal(changed, (only.flux != 0).any(axis=1))


def _spot():
    spot = np.zeros((32, 64, 3), np.float32)
    spot[4:6, 7:9] = 1
    return spot


def test_threads_give_the_same_bits():
    tree = quadtree.build_tree(random_leaves(64, 7), 64)
    one, three = (leaf_light(patchy_map(3), tree, 5.0, threads=n) for n in (1, 3))
    np.testing.assert_array_equal(one.flux, three.flux)
    np.testing.assert_array_equal(one.moment, three.moment)
