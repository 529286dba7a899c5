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


def test_cells_that_do_not_tile_are_refused():
    leaves = random_leaves(16, 1)
    with pytest.raises(ValueError, match="no leaf holds texel"):
        quadtree.build_tree(leaves[:-1], 16)
    inner = next(cell for cell in leaves if quadtree.lights(cell) > 1)
    with pytest.raises(ValueError, match="lie in others"):
        quadtree.build_tree([*leaves, quadtree.children(inner)[0]], 16)
    with pytest.raises(ValueError, match="no nodes of the tree"):
        quadtree.build_tree([*leaves, (0, 1, 4, 2, 3)], 16)
