"""The linear model of numbers as functions of poses, on systems with known solutions and degenerate ones."""

import numpy as np
import pytest

from relightcli.core.pose.linear_model import distance, gap, pose_space, regress, segments


def _problem(frames: int, features: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(frames, features))
    x = rng.normal(size=(features, 6))
    b = (a @ x + rng.normal(size=6)).reshape(frames, 2, 3).astype(np.float32)
    return a, x, b


def _predicted(a: np.ndarray, b: np.ndarray, new: np.ndarray, ridge: float = 0.0) -> np.ndarray:
    space = pose_space(a, 100)
    found = regress(space.scores(a), space.share, b, ridge)
    return found.intercept + np.einsum("fk,vpk->fvp", space.scores(new), found.slope)


def test_an_exact_linear_relation_is_recovered() -> None:
    """At new poses too. Targets are float32, 6e-8 each; the system's condition is some 10."""
    a, x, b = _problem(40, 7)
    new = np.random.default_rng(9).normal(size=(5, 7))
    intercept = b.reshape(40, 6) - a @ x
    np.testing.assert_allclose(_predicted(a, b, new).reshape(5, 6), new @ x + intercept[0], atol=2e-5)


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_fewer_frames_than_features(frames: int) -> None:
    """Training frames come out again; the space has one dimension less than there are frames."""
    a, _, b = _problem(frames, 20)
    space = pose_space(a)
    assert space.rank == space.directions.shape[1] == frames - 1
    np.testing.assert_allclose(_predicted(a, b, a), b, atol=2e-5)


def test_constant_and_collinear_features() -> None:
    a, _, b = _problem(30, 4)
    wide = np.concatenate([a, a[:, :2] * 3.0 - 1.0, np.full((30, 2), 0.7)], 1)
    space = pose_space(wide)
    assert space.rank == 4
    np.testing.assert_allclose(_predicted(wide, b, wide), b, atol=2e-5)
    # A joint that never moved in training changes nothing when it moves.
    moved = wide.copy()
    moved[:, -1] += 5.0
    np.testing.assert_allclose(_predicted(wide, b, moved), b, atol=2e-5)


def test_ridge_draws_to_the_mean() -> None:
    a, _, b = _problem(30, 4)
    mean = b.mean(0, keepdims=True)
    errors = [np.abs(_predicted(a, b, a, ridge) - mean).max() for ridge in (0.0, 1.0, 1e6)]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1e-5


def test_weights_leave_frames_out() -> None:
    """Frames without weight count as if they were not there; without any weight the mean is left, here 0 slope."""
    a, _, b = _problem(30, 4)
    spoiled = b.copy()
    spoiled[20:, :, 1] = 1e3
    weights = np.ones((30, 2, 1), np.float32)
    weights[20:] = 0.0
    space = pose_space(a)
    found = regress(space.scores(a), space.share, spoiled, 0.0, weights, np.array([-1, 0, -1]))
    clean = regress(space.scores(a), space.share, b, 0.0)
    # Normal equations: 1e-7 of the targets times the condition of 20 frames.
    np.testing.assert_allclose(found.slope[:, 1], clean.slope[:, 1], atol=1e-5)
    np.testing.assert_array_equal(found.slope[:, 0], clean.slope[:, 0])
    nothing = regress(space.scores(a), space.share, b, 0.0, np.zeros((30, 2, 1), np.float32), np.array([0, 0, 0]))
    np.testing.assert_allclose(nothing.slope, clean.slope, atol=1e-9)  # all alike


def test_a_component_that_weighted_frames_do_not_show() -> None:
    a = np.zeros((10, 2))
    a[:5, 0] = np.arange(5)
    a[5:, 1] = np.arange(5)
    weights = np.ones((10, 1, 1), np.float32)
    weights[5:] = 0.0
    b = np.where(np.arange(10) < 5, a[:, 0], 77.0).astype(np.float32)[:, None, None]
    space = pose_space(a)
    found = regress(space.scores(a), space.share, b, 0.0, weights, np.array([0]))
    there = found.intercept + np.einsum("fk,vpk->fvp", space.scores(a), found.slope)
    assert np.isfinite(there).all()
    np.testing.assert_allclose(there[:5], b[:5], atol=1e-4)


def test_threads_do_not_matter() -> None:
    a, _, _ = _problem(20, 5)
    b = np.random.default_rng(1).normal(size=(20, 50, 3)).astype(np.float32)
    one = regress(a, np.ones(5), b, 1e-3)
    np.testing.assert_array_equal(one.slope, regress(a, np.ones(5), b, 1e-3, threads=3).slope)


def test_segments_stay_within_clips() -> None:
    clip = np.repeat(np.array([0, 1, 2], np.int32), [30, 2, 10])
    part = segments(clip)
    for k in range(part.max() + 1):
        rows = np.flatnonzero(part == k)
        assert len(np.unique(clip[rows])) == 1
        assert (np.diff(rows) == 1).all()
    assert part.max() + 1 == 6
    assert segments(np.zeros(1, np.int32)).tolist() == [0]
    assert len(np.unique(segments(np.zeros(3, np.int32)))) == 3


def test_distance_from_the_training_poses() -> None:
    a = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 3.0]])
    assert distance(a, np.array([1.0, 1.0])) == 1.0
    assert distance(a, a[2]) == 0.0
    assert gap(a) == 3.0
    assert gap(a[:1]) == 0.0
    assert distance(np.zeros((3, 0)), np.zeros(0)) == 0.0


def test_bad_input() -> None:
    with pytest.raises(ValueError, match="frame"):
        pose_space(np.zeros((0, 3)))
    with pytest.raises(ValueError, match="finite"):
        pose_space(np.full((2, 3), np.inf))
