"""Quadtrees of lights: cells, their samples, and which leaf a direction falls into."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relightcli.core.lights import quadtree
from relightcli.core.sphere import cube


def random_leaves(resolution, seed, most=400):
    """A tree split at random, its leaves in the order of the descent."""
    rng = np.random.default_rng(seed)
    leaves, stack = [], quadtree.roots(resolution)[::-1]
    while stack:
        cell = stack.pop()
        parts = quadtree.children(cell)
        if parts and len(leaves) + len(stack) < most and rng.random() < 0.75:
            stack += parts[::-1]
        else:
            leaves.append(cell)
    return leaves


def texels_of(cell, resolution):
    face, r0, r1, c0, c1 = cell
    return {(face * resolution + i) * resolution + j for i in range(r0, r1) for j in range(c0, c1)}


@pytest.mark.parametrize("resolution", [1, 2, 3, 5, 7, 16, 33])
def test_children_tile_their_parent(resolution):
    stack = quadtree.roots(resolution)
    while stack:
        cell = stack.pop()
        parts = quadtree.children(cell)
        if quadtree.lights(cell) == 1:
            assert parts == []
            continue
        assert 2 <= len(parts) <= 4
        found = [t for part in parts for t in texels_of(part, resolution)]
        assert len(found) == len(set(found)) == quadtree.lights(cell)
        assert set(found) == texels_of(cell, resolution)
        stack += parts


def test_nine_samples_at_corners_edges_and_middle():
    texels, directions = quadtree.samples((2, 4, 12, 16, 24), 32)
    rows, columns = np.divmod(texels - 2 * 32 * 32, 32)
    assert sorted(set(rows)) == [4, 7, 11]
    assert sorted(set(columns)) == [16, 19, 23]
    assert len(texels) == 9
    np.testing.assert_allclose(directions, cube.texel_directions(32).reshape(-1, 3)[texels], atol=1e-15)


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (1, 2), (2, 2), (3, 3), (1, 7), (2, 4), (1, 20)])
def test_all_lights_of_a_small_cell_are_samples(rows, columns):
    cell = (5, 3, 3 + rows, 1, 1 + columns)
    texels, _ = quadtree.samples(cell, 40)
    assert set(texels.tolist()) <= texels_of(cell, 40)
    assert len(texels) == len(set(texels.tolist())) == (rows * columns if rows * columns <= 9 else 3 * min(rows, 3))


@pytest.mark.parametrize("resolution", [1, 2, 3, 7, 16, 100, 300])
def test_solid_angles_and_places_of_leaves(resolution):
    leaves = random_leaves(resolution, resolution)
    solid = quadtree.solid_angles(np.array(leaves), resolution)
    assert solid.sum() == pytest.approx(4 * math.pi, rel=1e-12)
    texel = np.tile(cube.solid_angles(resolution)[None], (6, 1, 1))
    sums = [texel[f, r0:r1, c0:c1].sum() for f, r0, r1, c0, c1 in leaves]
    np.testing.assert_allclose(solid, sums, rtol=1e-10)

    tree = quadtree.build_tree(leaves, resolution)
    d = np.random.default_rng(0).normal(size=(5000, 3))
    d[:3] = np.eye(3)
    d[3] = (1, 1, 1)
    own = cube.texel_index(d, resolution)
    face, row, column = own // resolution**2, own // resolution % resolution, own % resolution
    f, r0, r1, c0, c1 = np.array(leaves)[quadtree.leaves_at(tree, d)].T
    assert ((f == face) & (r0 <= row) & (row < r1) & (c0 <= column) & (column < c1)).all()


def test_a_cell_given_twice_is_refused():
    with pytest.raises(ValueError, match="given twice"):
        quadtree.build_tree([quadtree.roots(4)[0], *quadtree.roots(4)], 4)


def test_cells_that_do_not_tile_are_refused():
    leaves = random_leaves(16, 1)
    with pytest.raises(ValueError, match="no leaf holds texel"):
        quadtree.build_tree(leaves[:-1], 16)
    inner = next(cell for cell in leaves if quadtree.lights(cell) > 1)
    with pytest.raises(ValueError, match="lie in others"):
        quadtree.build_tree([*leaves, quadtree.children(inner)[0]], 16)
    with pytest.raises(ValueError, match="no nodes of the tree"):
        quadtree.build_tree([*leaves, (0, 1, 4, 2, 3)], 16)


def label_map(leaves, resolution):
    """Leaf of every texel (6, R, R), painted; each exactly once."""
    label = np.full((6, resolution, resolution), -1)
    for k, (f, r0, r1, c0, c1) in enumerate(leaves):
        assert (label[f, r0:r1, c0:c1] == -1).all()
        label[f, r0:r1, c0:c1] = k
    assert (label >= 0).all()
    return label


def test_children_of_a_fine_face_and_of_strips():
    resolution = 100
    painted = np.zeros((resolution, resolution), int)
    stack = quadtree.roots(resolution)[:1]
    while stack:
        cell = stack.pop()
        parts = quadtree.children(cell)
        assert sum(quadtree.lights(p) for p in parts) == (quadtree.lights(cell) if parts else 0)
        stack += parts
        if not parts:
            painted[cell[1], cell[3]] += 1
    assert (painted == 1).all()
    # Strips part in two; rows of children: upper left, upper right, lower left, lower right.
    assert quadtree.children((3, 4, 5, 2, 7)) == [(3, 4, 5, 2, 4), (3, 4, 5, 4, 7)]
    assert quadtree.children((3, 2, 7, 4, 5)) == [(3, 2, 4, 4, 5), (3, 4, 7, 4, 5)]
    assert quadtree.children((1, 0, 3, 4, 7)) == [(1, 0, 1, 4, 5), (1, 0, 1, 5, 7), (1, 1, 3, 4, 5), (1, 1, 3, 5, 7)]


@pytest.mark.parametrize("resolution", [7, 16, 100])
def test_samples_are_texel_centres_of_their_cell(resolution):
    centres = cube.texel_directions(resolution).reshape(-1, 3)
    stack = quadtree.roots(resolution)
    for cell in stack:
        texels, directions = quadtree.samples(cell, resolution)
        np.testing.assert_allclose(directions, centres[texels], atol=1e-15)
        face, r0, r1, c0, c1 = cell
        row, column = np.divmod(texels - face * resolution**2, resolution)
        count = quadtree.lights(cell)
        assert len(set(texels.tolist())) == len(texels) == (count if count <= 9 else min(3, r1 - r0) * min(3, c1 - c0))
        # All four corners take part, and nothing from outside.
        assert (row.min(), row.max(), column.min(), column.max()) == (r0, r1 - 1, c0, c1 - 1)
        if len(stack) < 300:
            stack += quadtree.children(cell)


@pytest.mark.parametrize("resolution", [1, 2, 3, 7, 255, 256, 257, 300, 511, 600])
def test_every_texel_finds_its_leaf(resolution):
    # More than 256 places a side: the descent then starts above the texels.
    leaves = random_leaves(resolution, resolution + 1, 2000)
    tree = quadtree.build_tree(leaves, resolution)
    label = label_map(leaves, resolution).reshape(-1)
    rng = np.random.default_rng(1)
    texel = rng.permutation(6 * resolution**2)[:200_000]
    face, row, column = texel // resolution**2, texel // resolution % resolution, texel % resolution
    # Anywhere in the texel, its corners left out.
    s, t = (2 * (x + rng.uniform(0.001, 0.999, len(texel))) / resolution - 1 for x in (column, row))
    d = cube.FACE_AXIS[face] + s[:, None] * cube.FACE_RIGHT[face] + t[:, None] * cube.FACE_DOWN[face]
    np.testing.assert_array_equal(quadtree.leaves_at(tree, d), label[texel])
    np.testing.assert_array_equal(tree.cell, leaves)


@pytest.mark.parametrize("resolution", [5, 16, 33])
def test_any_one_missing_leaf_is_noticed(resolution):
    leaves = random_leaves(resolution, 2, 60)
    for k in range(len(leaves)):
        with pytest.raises(ValueError, match="no leaf holds texel"):
            quadtree.build_tree(leaves[:k] + leaves[k + 1 :], resolution)
    quadtree.build_tree(leaves[::-1], resolution)
