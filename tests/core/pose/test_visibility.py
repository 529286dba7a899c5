"""Visibility of posed vertices against solid angles that are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from relightcli.adapters.rays import Tracer
from relightcli.core.pose.rig import any_tangents
from relightcli.core.pose.visibility import both_sides, hemisphere_directions, hemisphere_harmonics, trace_visibility
from relightcli.core.sphere.sh import harmonics

ORDER = 4
# The lattice's discrepancy with 1024 directions: 0.25 to 0.53 % of the coefficients' norm, measured on these shapes.
LATTICE = 0.008


def zonal(height, order):
    """Integral of K_l P_l over a cap z > height."""
    z, weight = np.polynomial.legendre.leggauss(24)
    z = height + (1 - height) * (z + 1) / 2
    values = harmonics(np.stack([np.sqrt(1 - z * z), 0 * z, z], axis=1), order)
    bands = np.arange(order)
    return 2 * np.pi * (1 - height) / 2 * (weight[:, None] * values[:, bands * (bands + 1)]).sum(axis=0)


def one(positions, faces, normal=(0, 0, 1), tangent=(1, 0, 0), count=1024, order=ORDER):
    """Coefficients of a vertex at the origin."""
    tracer = Tracer(np.asarray(positions, float), np.asarray(faces, np.int32))
    frame = (np.zeros((1, 3)), np.array([normal], float), np.array([tangent], float))
    found, rays = trace_visibility(tracer, *frame, hemisphere_directions(count), order)
    assert rays == count
    return found[0]


def ball(center, radius):
    from tests.core.transport.scenes import sphere_grid

    corners, faces = sphere_grid(96, 192)[:2]
    return np.asarray(corners) * radius + center, faces


def close(found, expected):
    return np.linalg.norm(found - expected) < LATTICE * np.linalg.norm(hemisphere_harmonics(ORDER))


def test_directions_share_the_hemisphere():
    d = hemisphere_directions(1000)
    assert np.allclose(np.linalg.norm(d, axis=1), 1, atol=1e-15)
    assert d[:, 2].min() > 0
    assert 2 * np.pi * d[:, 2].mean() == pytest.approx(np.pi, rel=1e-12)  # heights are midpoints: z integrates exactly
    assert np.abs(d[:, :2].mean(axis=0)).max() < 1e-3


def test_the_whole_hemisphere():
    for order in range(1, 9):
        expected = np.zeros(order * order)
        bands = np.arange(order)
        expected[bands * (bands + 1)] = zonal(0.0, order)
        assert np.allclose(hemisphere_harmonics(order), expected, atol=1e-14)
    # Printed in many places: sqrt(pi), sqrt(3 pi) / 2, 0, -sqrt(7 pi) / 8.
    assert hemisphere_harmonics(4)[[0, 2, 6, 12]] == pytest.approx(
        np.sqrt(np.pi) * np.array([1, np.sqrt(3) / 2, 0, -np.sqrt(7) / 8]), abs=1e-14
    )


def test_a_vertex_that_nothing_blocks_has_no_error():
    far_below = [[-1, -1, -5], [1, -1, -5], [0, 1, -5]]
    assert np.array_equal(one(far_below, [[0, 1, 2]], count=50), hemisphere_harmonics(ORDER).astype(np.float32))


@pytest.mark.parametrize("height", [0.4, 0.9])
@pytest.mark.parametrize("azimuth", [0.3, 3.1, 5.0])
def test_a_ball_takes_a_cap_away(height, azimuth):
    away = np.array([np.sqrt(1 - height**2) * np.cos(azimuth), np.sqrt(1 - height**2) * np.sin(azimuth), height])
    sine = 0.35  # of half the cap's angle
    corners, faces = ball(2.0 * away, 2.0 * sine)
    bands = np.arange(ORDER)
    cap = zonal(np.sqrt(1 - sine**2), ORDER) * np.sqrt(4 * np.pi / (2 * bands + 1))  # [Funk-Hecke]
    expected = hemisphere_harmonics(ORDER) - np.repeat(cap, 2 * bands + 1) * harmonics(away, ORDER)
    assert close(one(corners, faces), expected)


@pytest.mark.parametrize("azimuth", [0.3, 5.0])
def test_a_ball_behind_is_seen_from_the_back_alone(azimuth):
    """The back's frame is half a turn about the tangent away: (x, y, z) is (x, -y, -z) there."""
    height, sine = 0.6, 0.35
    away = np.array([np.sqrt(1 - height**2) * np.cos(azimuth), np.sqrt(1 - height**2) * np.sin(azimuth), -height])
    corners, faces = ball(2.0 * away, 2.0 * sine)
    tracer = Tracer(np.asarray(corners, float), np.asarray(faces, np.int32))
    skin = both_sides(np.zeros((1, 3)), np.array([[0.0, 0, 1]]), np.array([[1.0, 0, 0]]))
    (front, back), rays = trace_visibility(tracer, *skin, hemisphere_directions(1024), ORDER)
    assert rays == 2 * 1024
    assert np.array_equal(front, hemisphere_harmonics(ORDER).astype(np.float32))
    bands = np.arange(ORDER)
    cap = zonal(np.sqrt(1 - sine**2), ORDER) * np.sqrt(4 * np.pi / (2 * bands + 1))  # [Funk-Hecke]
    seen = np.repeat(cap, 2 * bands + 1) * harmonics(away * [1, -1, -1], ORDER)
    assert close(back, hemisphere_harmonics(ORDER) - seen)


def test_inside_a_ball_nothing_is_seen():
    corners, faces = ball(np.zeros(3), 1.0)
    assert np.abs(one(corners, faces)).max() < 1e-2  # the whole less the lattice's sum over all of it


def test_a_wall_takes_half():
    big = 1e4
    wall = [[0.01, -big, -big], [0.01, big, -big], [0.01, big, big], [0.01, -big, big]]
    found = one(wall, [[0, 1, 2], [0, 2, 3]])
    # The quarter sphere x < 0, z > 0, by a product rule over azimuth and height.
    z, weight = np.polynomial.legendre.leggauss(20)
    phi, more = np.polynomial.legendre.leggauss(20)
    z, phi = 0.5 * (z + 1), np.pi + 0.5 * np.pi * phi
    radius = np.sqrt(1 - z * z)[:, None]
    points = np.stack(np.broadcast_arrays(radius * np.cos(phi), radius * np.sin(phi), z[:, None]), axis=-1)
    expected = np.einsum("i,j,ijk->k", 0.5 * weight, 0.5 * np.pi * more, harmonics(points, ORDER))
    assert close(found, expected)


def test_coefficients_belong_to_the_frame_and_not_to_the_world():
    corners, faces = ball(np.array([1.0, 0.5, 1.5]), 0.8)
    expected = one(corners, faces)
    turn = Rotation.from_rotvec([0.7, -2.0, 0.4]).as_matrix()
    found = one(corners @ turn.T, faces, normal=turn[:, 2], tangent=turn[:, 0])
    # Rounding moves a few rays across the ball's outline: 3 of 1024.
    assert np.abs(found - expected).max() < 3 * 2 * np.pi / 1024 * np.sqrt(7 / (4 * np.pi)) * 2
    # Another tangent turns the coefficients about the normal: bands keep their energy.
    other = one(corners, faces, tangent=any_tangents(np.array([[0.0, 0.6, 0.8]]))[0] * 0 + [0, 1, 0])
    for band in range(ORDER):
        rows = slice(band * band, (band + 1) ** 2)
        assert np.linalg.norm(other[rows]) == pytest.approx(np.linalg.norm(expected[rows]), abs=2 * LATTICE)
    assert np.abs(other - expected).max() > 0.1


def test_more_directions_come_closer():
    corners, faces = ball(np.array([1.0, 0.5, 1.5]), 0.8)
    truth = one(corners, faces, count=60_000)
    errors = [np.linalg.norm(one(corners, faces, count=n) - truth) for n in (64, 512, 4096)]
    assert errors[0] > 2 * errors[1] > 4 * errors[2]  # measured: 0.068, 0.020, 0.0045
