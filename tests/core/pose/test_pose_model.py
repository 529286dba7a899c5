"""Models of visibility by pose: the digest's swinging blocker, and motions that a model must survive."""

import numpy as np
import pytest

from relightcli.core.pose.pose_model import Settings, fit_model, predict
from tests.core.pose.caps import caps, swing


def _fit(centre: float, **settings: object) -> float:
    """Relative error at the training frames."""
    features, visibility = swing(centre)
    _, report = fit_model(features, visibility, np.zeros(41, np.int32), Settings(ridge=0.0, **settings))  # type: ignore[arg-type]
    return report.training.bands


@pytest.mark.parametrize("centre", [0.0, 180.0])
def test_swinging_blocker_by_logarithms(centre: float) -> None:
    """1.8 % wherever the cut lies; the coefficients themselves 5.2 %, and 5.3 % by this quadrature."""
    assert _fit(centre) == pytest.approx(0.018, abs=0.001)
    assert _fit(centre, kind="sh") == pytest.approx(0.052, abs=0.002)
    assert _fit(centre, kind="reduced") == pytest.approx(0.052, abs=0.002)


def test_swinging_blocker_by_angles() -> None:
    """.39 % where no angle wraps (and the ridge of lobes), 57 % where one does: the paper's numbers for an axis."""
    assert _fit(90.0, axes="angles") < 0.0049
    assert _fit(180.0, axes="angles") == pytest.approx(0.57, abs=0.02)


def test_one_lobe_is_worse_than_two() -> None:
    assert _fit(0.0, lobes=1) == pytest.approx(0.384, abs=0.003)


def _check(features: np.ndarray, visibility: np.ndarray, clip: np.ndarray, **settings: object) -> np.ndarray:
    model, report = fit_model(features, visibility, clip, Settings(**settings))  # type: ignore[arg-type]
    values = predict(model, features, str(settings.get("axes", "log")))
    assert np.isfinite(values).all()
    assert np.isfinite(model.slope).all()
    for errors in (report.training, report.held_out):
        if errors is not None:
            assert np.isfinite(errors.bands)
    return values


@pytest.mark.parametrize("kind", ["lobes", "sh", "reduced"])
def test_degenerate_training(kind: str) -> None:
    features, visibility = swing(0.0, 7)
    clip = np.zeros(7, np.int32)
    # One frame: it comes out again; two lobes leave .4 % of a norm of 1.9.
    one = _check(features[:1], visibility[:1], clip[:1], kind=kind)
    np.testing.assert_allclose(one, visibility[:1], atol=0.008)
    # Fewer frames than joints, joints that never move.
    # They all say the same as the one that does: so does the model. The ridge that is chosen is of their own scale.
    many = np.concatenate([features * np.arange(1.0, 30.0), np.full((7, 3), 0.4)], 1)
    few = _check(features, visibility, clip, kind=kind, ridge=0.0)
    np.testing.assert_allclose(_check(many, visibility, clip, kind=kind, ridge=0.0), few, atol=1e-4)
    assert np.linalg.norm(_check(many, visibility, clip, kind=kind) - visibility) < 0.2 * np.linalg.norm(visibility)
    # No visibility, all of it, none of the features.
    open_ = np.tile(caps(np.zeros(1), np.zeros(1), -1.0), (7, 1))[:, None]
    np.testing.assert_allclose(_check(features, open_, clip, kind=kind), open_, atol=0.005)
    assert not _check(features, 0.0 * visibility, clip, kind=kind).any()
    # Without a feature all frames look alike: as far from the truth as their mean, of lobes a little farther.
    flat = _check(features[:, :0], visibility, clip, kind=kind)
    assert np.abs(np.diff(flat, axis=0)).max() == 0
    spread = np.linalg.norm(visibility - visibility.mean(0))
    assert np.linalg.norm(flat - visibility) < (1.2 if kind == "lobes" else 1.0 + 1e-5) * spread


def test_two_clips_with_opposite_poses() -> None:
    """One swings to the left, one to the right: as good as the whole swing in one clip."""
    features, visibility = swing(0.0)
    clip = (np.arange(41) > 20).astype(np.int32)
    values = _check(features, visibility, clip, ridge=0.0)
    error = np.linalg.norm(values - visibility) / np.linalg.norm(visibility)
    assert error < 0.025


def test_axis_through_the_pole() -> None:
    """A blocker of 20 degrees over the zenith, where it meets the other lobe: there lobes are no linear function, to
    the logarithm less than to the angles."""
    tilt = np.linspace(-50.0, 50.0, 41)
    visibility = caps(np.where(tilt < 0, 180.0, 0.0), 90.0 - np.abs(tilt), 20.0)[:, None]
    features, clip = np.radians(tilt)[:, None], np.zeros(41, np.int32)
    log, angles = (
        np.linalg.norm(_check(features, visibility, clip, ridge=0.0, axes=axes) - visibility)
        / np.linalg.norm(visibility)
        for axes in ("log", "angles")
    )
    assert log < 0.08
    assert angles > 1.2 * log


def test_ridge_is_chosen_by_held_out_frames() -> None:
    """Features that are noise: only a strong ridge keeps held-out frames from being worse than the mean."""
    rng = np.random.default_rng(0)
    _, visibility = swing(0.0)
    shuffled = visibility[rng.permutation(41)]
    features = rng.normal(size=(41, 12))
    clip = np.zeros(41, np.int32)
    _, free = fit_model(features, shuffled, clip, Settings(kind="sh", ridge=0.0))
    _, chosen = fit_model(features, shuffled, clip, Settings(kind="sh"))
    assert chosen.ridge > 0.0
    assert chosen.held_out is not None
    assert free.held_out is not None
    assert chosen.held_out.bands < free.held_out.bands


def test_cosine_weighted_visibility_is_lit_as_lambert() -> None:
    """Its l = 0 coefficient is the share of even light that arrives: 1 of the open hemisphere, as the bands have it."""
    open_ = np.tile(caps(np.zeros(1), np.zeros(1), -1.0), (3, 1))[:, None]
    model, report = fit_model(np.arange(3.0)[:, None], open_, np.zeros(3, np.int32), Settings(weight="cosine"))
    values = predict(model, np.array([[1.0]]))
    assert values[0, 0, 0] * np.sqrt(4 * np.pi) / np.pi == pytest.approx(1.0, abs=1e-5)
    assert report.training.projection is None
