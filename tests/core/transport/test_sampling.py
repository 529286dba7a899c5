"""Sample points: stratified within a pass, independent between pixels, passes, dimensions and seeds."""

import numpy as np
import pytest
from numba import njit
from scipy import stats

from relightcli.core.transport.sampling import point, stream_key


@njit
def points(seed, pixel, replicate, dimension, count):
    out = np.empty((count, 2))
    key = stream_key(seed, pixel, replicate)
    for i in range(count):
        out[i] = point(key, i, dimension)
    return out


@njit
def first_points(count, seed, vary):
    out = np.empty((count, 2))
    for i in range(count):
        if vary == 0:
            out[i] = point(stream_key(seed, i, 0), 0, 0)
        elif vary == 1:
            out[i] = point(stream_key(seed, 0, i), 0, 0)
        else:
            out[i] = point(stream_key(seed, 0, 0), 0, i)
    return out


@pytest.mark.parametrize("pixel", [0, 1, 123456789])
@pytest.mark.parametrize("columns", [1, 2, 8, 32, 256])
def test_every_elementary_interval_holds_one_point(pixel, columns):
    # A (0, 8, 2)-net: 256 points, one in each of the 256 boxes of any power-of-two shape.
    p = points(7, pixel, 3, 5, 256)
    box = (p[:, 0] * columns).astype(int) * (256 // columns) + (p[:, 1] * (256 // columns)).astype(int)
    assert len(np.unique(box)) == 256


def test_later_stretches_are_stratified_too():
    p = points(0, 0, 0, 0, 192)[128:]
    assert len(np.unique((p[:, 0] * 8).astype(int) * 8 + (p[:, 1] * 8).astype(int))) == 64


def test_points_lie_inside_the_open_square():
    p = points(1, 2, 3, 4, 1 << 16)
    assert (p > 0).all()
    assert (p < 1).all()


@pytest.mark.parametrize("vary", [0, 1, 2], ids=["pixels", "passes", "dimensions"])
@pytest.mark.parametrize("seed", [0, 1])
def test_streams_are_uniform_and_independent(vary, seed):
    n = 1 << 18
    p = first_points(n, seed, vary)
    # 32 x 32 boxes, and 32 x 32 of each point's x with the next one's x.
    for a, b in ((p[:, 0], p[:, 1]), (p[:-1, 0], p[1:, 0]), (p[:-1, 1], p[1:, 0])):
        seen = np.bincount((a * 32).astype(int) * 32 + (b * 32).astype(int), minlength=1024)
        # Significance 0.01 over 3 x 6 tests (Sidak).
        assert stats.chisquare(seen).pvalue > 1 - 0.99 ** (1 / 18)


def test_the_key_holds_everything():
    base = points(0, 0, 0, 0, 4)
    for other in ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)):
        assert (points(*other, 4) != base).all()
