"""Texels that bands of visibility take for seen, against shapes that are known."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.pose.seen import seen_bits
from relightcli.core.pose.visibility import hemisphere_harmonics
from relightcli.core.sphere import cube, sh
from relightcli.core.transport.visibility import horizon_bits

RESOLUTION = 32
DIRECTIONS = cube.texel_directions(RESOLUTION).reshape(-1, 3)
SHARE = np.tile(cube.solid_angles(RESOLUTION).reshape(-1), 6)


def bands(mask, order=4):
    """Coefficients (1, n^2) of a function of texels."""
    return ((mask * SHARE) @ sh.harmonics(DIRECTIONS, order))[None].astype(np.float32)


def unpacked(bits):
    return np.unpackbits(bits.reshape(len(bits), -1), axis=1, bitorder="little").astype(bool)


@pytest.mark.parametrize("order", [2, 3, 4, 5, 6, 8])
def test_an_open_hemisphere_comes_back_whole(order):
    """Its series is above 1/2 all over it, whatever its order: 1/2 plus odd terms, which rise from 0 at the horizon."""
    normals = np.random.default_rng(order).normal(size=(20, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    zonal = hemisphere_harmonics(order)
    band = np.arange(order)
    length = zonal[band * (band + 1)] * np.sqrt(4 * np.pi / (2 * band + 1))
    turned = np.repeat(length, 2 * band + 1) * sh.harmonics(normals.astype(float), order)
    found = unpacked(seen_bits(turned.astype(np.float32), normals, RESOLUTION, threads=2))
    expected = unpacked(horizon_bits(normals, RESOLUTION))
    height = np.abs(normals @ DIRECTIONS.T)
    assert (found == expected)[height > 1e-3].all()  # texels that a rounding of 1e-7 cannot move over the horizon


def test_a_wall_comes_back_where_it_stands():
    """A wall that hides x < a: its edge is found within the width of a texel (0.05) and a half, at any height but near
    where it meets the horizon."""
    up = np.array([[0.0, 0.0, 1.0]], np.float32)
    for a in (-0.3, 0.0, 0.3):
        wall = (DIRECTIONS[:, 2] > 0) & (DIRECTIONS[:, 0] > a * np.maximum(DIRECTIONS[:, 2], 1e-9))
        found = unpacked(seen_bits(bands(wall), up, RESOLUTION))[0]
        wrong = ((found != wall) * SHARE).sum()
        assert wrong < 0.1 * (wall * SHARE).sum()


def test_nothing_seen_is_no_texel_and_order_one_is_all_or_none():
    up = np.array([[0.0, 0.0, 1.0]], np.float32)
    assert not seen_bits(np.zeros((1, 16), np.float32), up, RESOLUTION).any()
    # A mean of 1/2 over the sphere is one of all of the hemisphere.
    for share, expected in ((0.45, 0.0), (0.55, 0.5)):
        v = np.array([[share * np.sqrt(4 * np.pi)]], np.float32)
        assert unpacked(seen_bits(v, up, RESOLUTION)).mean() == expected
