"""Haar wavelets on cube faces: round trip, Parseval, truncation."""

import math

import numpy as np
import pytest

from relightcli.core.sphere import cube, haar
from relightcli.core.transport.visibility import horizon_bits
from tests.core.brdf.reflectances import random_directions

R = 16


def transfer(seed, count=5):
    """Random half-blocked receivers: bits, normals, and V (n.w)+ dOmega / pi per texel in float64."""
    rng = np.random.default_rng(seed)
    normals = random_directions(count, seed).astype(np.float32)
    # Blocked in squares of 4 x 4 texels, as by geometry: white noise would not compress.
    keep = np.kron(rng.random((count, 6, R // 4, R // 4)) < 0.5, np.ones((4, 4), bool))
    bits = horizon_bits(normals, R) & np.packbits(keep, axis=-1, bitorder="little")
    seen = np.unpackbits(bits, axis=-1, bitorder="little")
    cosine = cube.texel_directions(R) @ normals.astype(np.float64).T
    values = np.moveaxis(cosine, -1, 0) * seen * cube.solid_angles(R) / math.pi
    return bits, normals, values


def truncated(bits, normals, count, by_area=True, tolerance=0.0):
    directions = cube.texel_directions(R).reshape(-1, 3).astype(np.float32)
    solid_angle = cube.solid_angles(R).reshape(-1).astype(np.float32)
    return haar.truncated_cosine_transfer(
        bits, normals, directions, solid_angle, count, by_area=by_area, tolerance=tolerance
    )


@pytest.mark.parametrize("size", [1, 2, 4, 64])
def test_round_trip_and_parseval(size):
    faces = np.random.default_rng(0).normal(size=(3, 6, size, size))
    kept = faces.copy()
    coefficients = haar.forward(faces)
    np.testing.assert_array_equal(faces, kept)  # not changed in place
    np.testing.assert_allclose(haar.inverse(coefficients), faces, atol=1e-13)
    np.testing.assert_allclose((coefficients**2).sum((-1, -2)), (faces**2).sum((-1, -2)), rtol=1e-13)
    other = np.random.default_rng(1).normal(size=faces.shape)
    np.testing.assert_allclose((coefficients * haar.forward(other)).sum(), (faces * other).sum(), rtol=1e-11)


def test_layout():
    # The mean times R at (0, 0); a vertical edge in the middle is the coarsest horizontal detail, at (0, 1).
    faces = np.zeros((8, 8))
    faces[:, :4] = 1.0
    expected = np.zeros((8, 8))
    expected[0, 0] = expected[0, 1] = 0.5 * 8
    np.testing.assert_allclose(haar.forward(faces), expected, atol=1e-15)
    np.testing.assert_allclose(haar.forward(faces.T), expected.T, atol=1e-15)


def test_support_areas_are_those_of_the_basis_functions():
    size = 8
    unit = np.eye(size * size).reshape(-1, size, size)
    support = (np.abs(haar.inverse(unit)) > 0).sum((1, 2)).reshape(size, size)
    np.testing.assert_array_equal(haar.support_areas(size), support)


def test_all_coefficients_are_the_transform():
    bits, normals, values = transfer(2)
    index, value, dropped = truncated(bits, normals, 6 * R * R)
    np.testing.assert_array_equal(np.sort(index, axis=1), np.tile(np.arange(6 * R * R), (len(bits), 1)))
    exact = np.take_along_axis(haar.forward(values).reshape(len(bits), -1), index, 1)
    # float32 sums of 4 values over 4 levels, next to coefficients of up to 0.1.
    np.testing.assert_allclose(value, exact, atol=2e-8)
    np.testing.assert_allclose(dropped, 0, atol=1e-12)


def test_all_coefficients_are_the_dot_product():
    bits, normals, values = transfer(3)
    light = np.random.default_rng(4).random((3, 6, R, R)) ** 8 * 1e3
    index, value, _ = truncated(bits, normals, 6 * R * R)
    coefficients = haar.forward(light).reshape(3, -1).T.astype(np.float32)
    found = haar.gather(index, value, np.ascontiguousarray(coefficients))
    np.testing.assert_allclose(found, np.einsum("nfij,cfij->nc", values, light), rtol=1e-5)  # float32 coefficients


@pytest.mark.parametrize("count", [1, 7, 64])
def test_truncation_keeps_the_largest_and_says_what_it_dropped(count):
    bits, normals, values = transfer(5)
    exact = haar.forward(values).reshape(len(bits), -1)
    index, value, dropped = truncated(bits, normals, count, by_area=False)
    assert all(len(set(row)) == count for row in index.tolist())
    assert (np.diff(np.abs(value), axis=1) <= 0).all()  # strongest first
    np.testing.assert_allclose(value, np.take_along_axis(exact, index, 1), atol=2e-8)
    rest = np.sort(np.abs(exact), axis=1)[:, :-count]
    np.testing.assert_allclose(dropped, (rest**2).sum(1) / (exact**2).sum(1), atol=1e-6)
    # Parseval: the dropped energy is the squared error of the truncated function.
    kept = np.zeros_like(exact)
    np.put_along_axis(kept, index, value.astype(np.float64), 1)
    back = haar.inverse(kept.reshape(-1, 6, R, R))
    error = ((back - values) ** 2).sum((1, 2, 3)) / (values**2).sum((1, 2, 3))
    np.testing.assert_allclose(dropped, error, atol=1e-6)


def test_ranking_by_area_prefers_broad_support():
    bits, normals, values = transfer(6)
    exact = haar.forward(values).reshape(len(bits), -1)
    area = np.tile(haar.support_areas(R).reshape(-1), 6)
    count = 32
    index, _, _ = truncated(bits, normals, count)
    by_area = np.argsort(-np.abs(exact) * area, axis=1)[:, :count]
    by_magnitude, _, _ = truncated(bits, normals, count, by_area=False)
    # Ties in rank may fall either way.
    assert np.mean([len(set(a) & set(b)) for a, b in zip(index.tolist(), by_area.tolist(), strict=True)]) > 0.97 * count
    assert area[index].mean() > area[by_magnitude].mean()


@pytest.mark.parametrize("tolerance", [0.3, 0.1, 0.02])
@pytest.mark.parametrize("by_area", [False, True])
def test_tolerance_leaves_out_what_it_may_and_no_more(by_area, tolerance):
    bits, normals, values = transfer(7)
    total = 6 * R * R
    exact = haar.forward(values).reshape(len(bits), -1)
    index, value, dropped = truncated(bits, normals, total, by_area, tolerance)
    relative = np.sqrt(dropped)
    assert (relative <= tolerance * (1 + 1e-4)).all()
    kept = np.zeros_like(exact)
    for i in range(len(bits)):
        n = np.flatnonzero(value[i])[-1] + 1
        assert n < total
        assert not index[i, n:].any()
        kept[i, index[i, :n]] = value[i, :n]
        # One coefficient fewer would be too few.
        last = value[i, n - 1] ** 2 / (exact[i] ** 2).sum()
        assert dropped[i] + last > tolerance**2 * (1 - 1e-4)
    error = np.linalg.norm(kept - exact, axis=1) / np.linalg.norm(exact, axis=1)
    np.testing.assert_allclose(error, relative, atol=1e-5)


def test_a_blocked_receiver_has_no_transfer():
    bits = np.zeros((2, 6, R, R // 8), np.uint8)
    for tolerance in (0.0, 0.1):
        _, value, dropped = truncated(bits, np.array([[0, 1, 0], [0, 0, 1]], np.float32), 8, tolerance=tolerance)
        assert not value.any()
        assert not dropped.any()
