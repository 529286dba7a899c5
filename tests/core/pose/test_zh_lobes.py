"""Lobes fitted to visibility: exact cases, slopes, identity along motions, degenerate visibility."""

import math

import numpy as np
import pytest

from relightcli.core.pose import zh_lobes
from relightcli.core.pose.zh_lobes import RIDGE, Lobes, fit_lobes, unit_harmonics, unit_norms, visibility_of
from relightcli.core.sphere import sh
from tests.core.pose.caps import caps, swing


def _fit(visibility: np.ndarray, count: int, threads: int = 1) -> Lobes:
    return fit_lobes(visibility, count, threads)


def _error(visibility: np.ndarray, lobes: Lobes) -> float:
    return float(np.linalg.norm(visibility_of(lobes) - visibility) / np.linalg.norm(visibility))


@pytest.mark.parametrize("order", [1, 2, 4, 7])
def test_unit_harmonics_are_harmonics_over_their_length(order: int) -> None:
    rng = np.random.default_rng(1)
    out = np.empty(order**2)
    for s in (*rng.normal(size=(5, 3)), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)):
        s = np.asarray(s) / np.linalg.norm(s)
        unit_harmonics(*s, unit_norms(order), out)
        band = np.repeat(np.arange(order), 2 * np.arange(order) + 1)
        np.testing.assert_allclose(
            out, sh.harmonics(s[None], order)[0] * np.sqrt(4 * math.pi / (2 * band + 1)), atol=1e-13
        )


@pytest.mark.parametrize("count", [1, 2, 3])
def test_slopes_of_the_explained_energy(count: int) -> None:
    """Central differences of step h err by h^2 and by round-off / h: 1e-7 at h = 1e-5 for numbers of size 1."""
    order = 5
    rng = np.random.default_rng(count)
    a, z, room = np.zeros((order, order, 2)), np.zeros((order, count)), zh_lobes._room(count, order)
    zh_lobes._load(rng.normal(size=order**2), unit_norms(order), a)
    s = rng.normal(size=(count, 3))
    s /= np.linalg.norm(s, axis=1, keepdims=True)
    zh_lobes._explain(a, order, s, z, room)
    zh_lobes.tangents(s, room.e)
    zh_lobes._slopes(order, s, z, room)
    ours = 2.0 * room.gradient.copy()
    e = room.e.copy()
    for i in range(2 * count):
        found = []
        for h in (1e-5, -1e-5):
            moved = s.copy()
            moved[i // 2] += h * e[i // 2, i % 2]
            moved[i // 2] /= np.linalg.norm(moved[i // 2])
            found.append(zh_lobes._explain(a, order, moved, z, room))
        assert ours[i] == pytest.approx((found[0] - found[1]) / 2e-5, abs=1e-7 * np.abs(ours).max() + 1e-7)


@pytest.mark.parametrize("count", [1, 2])
def test_lobes_are_found_again(count: int) -> None:
    """Axes 80 degrees apart: the Gram matrices' least eigenvalue is 0.55, so the ridge costs RIDGE / 0.55 at most."""
    axis = np.zeros((1, 30, count, 3), np.float32)
    turn = np.random.default_rng(5).uniform(0, 2 * math.pi, (30, 1))
    tilt = np.radians(np.array([70.0, -10.0])[:count])
    axis[0, ..., 0] = np.sin(tilt) * np.cos(turn)
    axis[0, ..., 1] = np.sin(tilt) * np.sin(turn)
    axis[0, ..., 2] = np.cos(tilt)
    zonal = np.tile(np.array([[1.3, -0.4, -0.6], [-0.7, 0.5, 0.3]], np.float32)[:count], (1, 30, 1, 1))
    truth = visibility_of(Lobes(np.full((1, 30), 0.8, np.float32), axis, zonal))
    assert _error(truth, _fit(truth, count)) < RIDGE / 0.55


def test_swinging_blocker() -> None:
    """The digest's numbers: one lobe leaves 38 % at best, two .39 %; the ridge adds to the latter."""
    _, visibility = swing(0.0)
    assert _error(visibility, _fit(visibility, 1)) == pytest.approx(0.384, abs=0.002)
    assert _error(visibility, _fit(visibility, 2)) < 0.0039 + RIDGE


def test_lobes_keep_their_identity() -> None:
    """A blocker that swings 60 degrees in 40 frames: no axis jumps. It follows its blocker, at twice its speed at most.
    Frames in another order have the same lobes."""
    for centre in (0.0, 180.0):
        _, visibility = swing(centre)
        lobes = _fit(visibility, 2)
        cosine = (lobes.axis[1:, 0] * lobes.axis[:-1, 0]).sum(-1)
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 3.0
    order = np.random.default_rng(0).permutation(41)
    shuffled = _fit(visibility[order], 2)
    # The mean is another sum of the same numbers: 1e-16, up to steps that end 1e-5 of the energy before the minimum.
    np.testing.assert_allclose(shuffled.axis, lobes.axis[order], atol=1e-2)


def test_open_and_blocked() -> None:
    """An open hemisphere is one lobe about the normal; one ridge is its error. Darkness is no lobe at all."""
    open_ = caps(np.zeros(2), np.zeros(2), -1.0)
    visibility = np.stack([open_, np.zeros_like(open_)], 1)
    visibility = np.concatenate([visibility, visibility[:, ::-1]], 1)  # and light going out
    for count in (1, 2):
        lobes = _fit(visibility, count)
        assert np.isfinite(lobes.axis).all()
        np.testing.assert_allclose(np.linalg.norm(lobes.axis, axis=-1), 1.0, atol=1e-6)
        assert _error(visibility, lobes) < RIDGE
        assert not lobes.zonal[:, 1].any()
        # Steps end when they gain 1e-5 of the energy, which falls with the square of the axis's angle: 3e-3.
        np.testing.assert_allclose(lobes.axis[:, 0, 0], [[0, 0, 1]] * 2, atol=4e-3)


def test_neither_threads_nor_neighbours_matter() -> None:
    rng = np.random.default_rng(2)
    visibility = np.tile(swing(20.0, 9)[1], (1, 40, 1)) + 0.1 * rng.normal(size=(9, 40, 16)).astype(np.float32)
    one, two = _fit(visibility, 2), _fit(visibility, 2, 3)
    alone = _fit(visibility[:, 7:8], 2)
    for a, b, c in zip(one, two, alone, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a[:, 7:8], c)


def test_two_lobes_that_are_one() -> None:
    """More lobes than the data has: coefficients stay of the data's size."""
    lobes = _fit(caps(np.zeros(1), np.zeros(1), -1.0)[:, None], 3)
    assert np.abs(lobes.zonal).max() < 2.0


def test_bad_input() -> None:
    with pytest.raises(ValueError, match="lobes"):
        _fit(np.zeros((1, 1, 16), np.float32), 0)
    with pytest.raises(ValueError, match="finite"):
        _fit(np.full((1, 1, 16), np.nan, np.float32), 1)
