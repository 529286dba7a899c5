"""Light of a map shared out over leaves: exact totals, the right places, and edits that stay where they are."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relightcli.core.lights import quadtree
from relightcli.core.lights.environment import latlong_to_cube
from relightcli.core.lights.leaf_light import Splitter, leaf_light
from relightcli.core.sphere import cube as sphere
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


def test_a_map_taken_off_another():
    rng = np.random.default_rng(4)
    one, other = rng.random((2, 40, 80, 3)).astype(np.float32)
    splitter = Splitter(quadtree.build_tree(random_leaves(64, 5), 64), 40, 80, 20.0)
    rows = np.sort(rng.integers(0, 41, (80, 2)), axis=1)
    found = splitter.light(one, 2, rows, other)
    for part, first, second in zip(found, splitter.light(one, 1, rows), splitter.light(other, 1, rows), strict=True):
        np.testing.assert_allclose(part, first - second, rtol=1e-10, atol=1e-13)
    assert not splitter.light(one, 2, rows, one).moment.any()


def _spot():
    spot = np.zeros((32, 64, 3), np.float32)
    spot[4:6, 7:9] = 1
    return spot


def test_threads_give_the_same_bits():
    tree = quadtree.build_tree(random_leaves(64, 7), 64)
    one, three = (leaf_light(patchy_map(3), tree, 5.0, threads=n) for n in (1, 3))
    np.testing.assert_array_equal(one.flux, three.flux)
    np.testing.assert_array_equal(one.moment, three.moment)


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (3, 5), (64, 128)])
@pytest.mark.parametrize("rotate", [0.0, 77.0, -200.0, 360.0])
@pytest.mark.parametrize("resolution", [1, 7, 50])
def test_moments_are_exact_too(shape, rotate, resolution):
    # What the table says of a border's latitude is added to one leaf and taken off its neighbour.
    radiance = np.random.default_rng(8).random((*shape, 3)).astype(np.float32)
    found = leaf_light(radiance, quadtree.build_tree(random_leaves(resolution, 8), resolution), rotate)
    flux, moment = exact(radiance, rotate)
    np.testing.assert_allclose(found.flux.sum(0), flux, rtol=1e-12)
    np.testing.assert_allclose(found.moment.sum(0), moment, atol=1e-12 * flux.max())


@pytest.mark.parametrize("rotate", [0.0, 33.0])
def test_single_texels_of_a_noisy_map(rotate):
    noise = np.random.default_rng(1).random((64, 128, 3)).astype(np.float32)
    # Measured: 3.0e-4 and 1.4e-3.
    for sky, bound in ((smooth_map(64, 128), 6e-4), (noise, 3e-3)):
        cube = latlong_to_cube(sky, 16, rotate)
        found = leaf_light(sky, full_tree(16), rotate)
        assert np.abs(found.flux - cube.flux).sum() < bound * cube.flux.sum()


@pytest.mark.parametrize("rotate", [0.0, 77.0])
def test_suns_stay_whole(rotate):
    height = 1024
    tree = quadtree.build_tree(random_leaves(16, 9), 16)
    rng = np.random.default_rng(10)
    for _ in range(20):
        # Not within a texel of the pole, where pixels are wedges.
        row, column = rng.integers(60, height - 60), rng.integers(2 * height)
        a, b = np.meshgrid([-0.01, 0.5, 1.01], [-0.01, 0.5, 1.01])
        lat = math.pi * (0.5 - (row + a.ravel()) / height)
        lon = math.pi * (1 - (column + b.ravel()) / height) + math.radians(rotate)
        d = np.stack([np.sin(lon) * np.cos(lat), np.sin(lat), np.cos(lon) * np.cos(lat)], -1)
        leaves = set(quadtree.leaves_at(tree, d).tolist())
        sky = np.zeros((height, 2 * height, 3), np.float32)
        sky[row, column] = (1e6, 2e6, 3e6)
        rows = np.zeros((2 * height, 2), np.int64)
        rows[column] = (row, row + 1)
        found = leaf_light(sky, tree, rotate, rows=rows)
        lit = set(np.flatnonzero(found.flux.any(axis=1)).tolist())
        assert lit
        assert lit <= leaves
        if len(leaves) == 1:
            np.testing.assert_allclose(found.flux[leaves.pop()], exact(sky)[0], rtol=1e-10)


def test_no_rows_no_light():
    found = leaf_light(patchy_map(4), quadtree.build_tree(random_leaves(8, 1), 8), rows=np.full((64, 2), 7))
    assert not found.flux.any()
    assert not found.moment.any()


def test_splitting_a_leaf_keeps_its_light():
    sky = np.random.default_rng(1).random((64, 128, 3)).astype(np.float32)
    resolution = 50
    leaves = random_leaves(resolution, 2, 200)
    tree = quadtree.build_tree(leaves, resolution)
    before = leaf_light(sky, tree, 20.0)
    same, other = [], []
    for k, cell in enumerate(leaves):
        parts = quadtree.children(cell)
        if not parts or k % 3:
            continue
        finer = quadtree.build_tree(leaves[:k] + leaves[k + 1 :] + parts, resolution)
        after = leaf_light(sky, finer, 20.0)
        rest = len(leaves) - 1
        change = np.concatenate(
            [after.flux[rest:].sum(0) - before.flux[k], (after.moment[rest:].sum(0) - before.moment[k]).ravel()]
        )
        change = np.abs(change).max() / before.flux[k].max()
        if set(finer.meridian) == set(tree.meridian):
            same.append(change)
            np.testing.assert_array_equal(after.flux[:rest], np.delete(before.flux, k, 0))
        else:
            other.append(change)
            np.testing.assert_allclose(after.flux.sum(0), before.flux.sum(0), rtol=1e-12)
    # A border has in all of a strip the latitude of its middle. The strips are the same where no side face gets a new
    # meridian, and then the parts are the whole; a new one cuts a strip in two, whose middles lie elsewhere.
    assert len(same) > 10
    assert len(other) > 3
    assert max(same) < 1e-12
    assert 1e-12 < max(other) < 1e-5  # measured: 4.3e-6 of the leaf's flux


def quadrature(cell, resolution):
    """Solid angle of a cell and the integral of the direction over it: (4,), by 40 x 40 Gauss points."""
    face, r0, r1, c0, c1 = cell
    x, w = np.polynomial.legendre.leggauss(40)
    (s, ws), (t, wt) = (
        ((a + b + (b - a) * x) / resolution - 1, w * (b - a) / resolution) for a, b in ((c0, c1), (r0, r1))
    )
    d = sphere.face_directions(face, s[None, :], t[:, None])
    solid = wt[:, None] * ws[None, :] * (1 + s[None, :] ** 2 + t[:, None] ** 2) ** -1.5
    return np.concatenate([[solid.sum()], np.einsum("ij,ijx->x", solid, d)])


# Measured, of flux: 2.4e-6, 2.4e-6, 1.2e-5, 2.2e-4. The last are leaves of the pole faces: a corner within a strip.
@pytest.mark.parametrize(("resolution", "bound"), [(1, 5e-6), (2, 5e-6), (3, 2.5e-5), (8, 4.4e-4)])
def test_even_light_of_single_leaves(resolution, bound):
    leaves = full_tree(resolution).cell
    found = leaf_light(np.ones((1, 1, 3), np.float32), quadtree.build_tree(map(tuple, leaves.tolist()), resolution))
    expected = np.array([quadrature(cell, resolution) for cell in leaves.tolist()])
    np.testing.assert_allclose(found.flux[:, 0], expected[:, 0], rtol=bound)
    np.testing.assert_allclose(found.moment[:, 2], expected[:, 1:], atol=bound * expected[:, 0].max())
