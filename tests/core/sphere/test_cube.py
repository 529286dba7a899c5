"""Cube maps: OpenGL's orientation, exact solid angles, indices and neighbours."""

import math

import numpy as np
import pytest

from relightcli.core.sphere import cube

RESOLUTIONS = [1, 2, 3, 16, 64]


@pytest.mark.parametrize("resolution", [*RESOLUTIONS, 256])
def test_solid_angles_sum_to_the_sphere(resolution):
    # interface.md promises 1e-12 of 4 pi; the formula reaches a few roundings.
    assert 6 * cube.solid_angles(resolution).sum() == pytest.approx(4 * math.pi, rel=1e-12)


def test_solid_angles_against_quadrature():
    # dOmega = ds dt / (1 + s^2 + t^2)^(3/2), by 20 x 20 Gauss points per texel: exact to rounding.
    x, w = np.polynomial.legendre.leggauss(20)
    r = 5
    s = cube.texel_centers(r)[:, None] + x / r
    density = (1 + s[None, :, None, :] ** 2 + s[:, None, :, None] ** 2) ** -1.5
    expected = np.einsum("ijab,a,b->ij", density, w, w) / r**2
    np.testing.assert_allclose(cube.solid_angles(r), expected, rtol=1e-13)


def test_corner_texels_are_smaller_by_three_root_three():
    ratio = cube.solid_angles(64)[32, 32] / cube.solid_angles(64)[0, 0]
    assert ratio == pytest.approx(5.03, abs=0.005)  # the limit for small texels is 3^1.5 = 5.196


# (face, s, t) and the direction by the table of the OpenGL specification (section "Cube Map Texture Selection"):
# +X: sc = -rz, tc = -ry; -X: +rz, -ry; +Y: +rx, +rz; -Y: +rx, -rz; +Z: +rx, -ry; -Z: -rx, -ry.
@pytest.mark.parametrize(
    ("face", "direction"),
    [
        (0, (1, -0.5, -0.25)),
        (1, (-1, -0.5, 0.25)),
        (2, (0.25, 1, 0.5)),
        (3, (0.25, -1, -0.5)),
        (4, (0.25, -0.5, 1)),
        (5, (-0.25, -0.5, -1)),
    ],
)
def test_orientation_is_that_of_opengl(face, direction):
    found = cube.face_directions(face, np.array(0.25), np.array(0.5))
    np.testing.assert_allclose(found, np.array(direction) / np.linalg.norm(direction), atol=1e-15)


def test_first_texel_of_a_face_is_its_top_left():
    # Looking along +Z with +Y up, right is +X in OpenGL's cube, which is seen from inside and left-handed.
    first = cube.texel_directions(4)[4, 0, 0]
    assert first[0] < 0 < first[1]
    np.testing.assert_allclose(first / first[2], [-0.75, 0.75, 1])


@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_index_of_a_texels_direction_is_its_own(resolution):
    d = cube.texel_directions(resolution)
    assert d.shape == (6, resolution, resolution, 3)
    np.testing.assert_allclose(np.linalg.norm(d, axis=-1), 1, rtol=1e-15)
    np.testing.assert_array_equal(cube.texel_index(d, resolution).reshape(-1), np.arange(6 * resolution**2))
    np.testing.assert_array_equal(cube.texel_index(1e-30 * d, resolution), cube.texel_index(d, resolution))


def test_index_is_the_texel_that_holds_the_direction():
    d = np.random.default_rng(0).normal(size=(20000, 3))
    r = 16
    index = cube.texel_index(d, r)
    face, row, column = index // r**2, index // r % r, index % r
    along = np.einsum("nx,nx->n", d, cube.FACE_AXIS[face])
    s = np.einsum("nx,nx->n", d, cube.FACE_RIGHT[face]) / along
    t = np.einsum("nx,nx->n", d, cube.FACE_DOWN[face]) / along
    assert (abs(s - cube.texel_centers(r)[column]) <= 1 / r + 1e-12).all()
    assert (abs(t - cube.texel_centers(r)[row]) <= 1 / r + 1e-12).all()
    # The share of uniform directions in a texel is its solid angle: chi-square over 1536 texels, 5 standard deviations.
    expected = np.tile(cube.solid_angles(r).reshape(-1), 6) / (4 * math.pi) * len(d)
    chi2 = ((np.bincount(index, minlength=6 * r * r) - expected) ** 2 / expected).sum()
    dof = 6 * r * r - 1
    assert abs(chi2 - dof) < 5 * math.sqrt(2 * dof)


def test_index_at_edges_and_corners_is_in_range():
    grid = np.array([-1.0, -0.0, 0.0, 1.0])
    d = np.stack(np.meshgrid(grid, grid, grid), -1).reshape(-1, 3)
    d = d[np.abs(d).max(axis=1) > 0]
    index = cube.texel_index(d, 8)
    assert ((index >= 0) & (index < 6 * 64)).all()
    # The chosen texel touches the direction: its centre is no farther than a texel's diagonal.
    near = cube.texel_directions(8).reshape(-1, 3)[index]
    cosine = np.einsum("nx,nx->n", near, d) / np.linalg.norm(d, axis=1)
    assert (np.arccos(np.minimum(cosine, 1)) < math.sqrt(2) / 8 + 1e-9).all()


@pytest.mark.parametrize("resolution", [2, 4, 16])
def test_neighbours_are_near_and_mutual(resolution):
    neighbours = cube.neighbours(resolution)
    d = cube.texel_directions(resolution).reshape(-1, 3)
    pairs = {(i, int(j)) for i, row in enumerate(neighbours) for j in row}
    assert all(i != j for i, j in pairs)
    # Edge neighbours (the 4-neighbourhood) see each other; corner ones do as well except around the cube's corners,
    # where the continuation of a face's plane is not the texel that continues back.
    edge = neighbours[:, [1, 3, 4, 6]]
    assert all((int(j), i) in pairs for i, row in enumerate(edge) for j in row)
    angle = np.arccos(np.clip(np.einsum("tx,tkx->tk", d, d[neighbours]), -1, 1))
    # Two diagonal steps of 2/R in the face plane are at most 2 sqrt(2)/R apart, a little more across an edge.
    assert angle.max() < 2 * math.sqrt(2) / resolution * 1.3
    distinct = np.array([len(set(row)) for row in neighbours.tolist()])
    corner = np.zeros((6, resolution, resolution), bool)
    corner[:, :: resolution - 1, :: resolution - 1] = True
    np.testing.assert_array_equal(distinct, np.where(corner.reshape(-1), 7, 8) if resolution > 2 else distinct)


def test_block_sums():
    values = np.random.default_rng(0).random((6 * 16 * 16, 2))
    expected = values.reshape(6, 4, 4, 4, 4, 2).sum((2, 4)).reshape(-1, 2)
    np.testing.assert_allclose(cube.block_sums(values, 16, 4), expected)
    np.testing.assert_array_equal(cube.block_sums(values, 16, 1), values)
