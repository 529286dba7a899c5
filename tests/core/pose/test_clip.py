"""Key frames between keys, against values worked out by hand or by SciPy."""

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from relightcli.core.pose.clip import (
    multiply,
    quaternion_of,
    rotation_matrix,
    rotation_vector,
    sample,
    tracks,
    unit_quaternion,
    unwrap_vectors,
)
from tests.core.pose.rigs import channel, clip, turn_z


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def test_step_holds_the_last_key_and_linear_mixes():
    values = [[0, 0, 0], [2, 4, 6], [10, 10, 10]]
    at = np.array([-1.0, 0.0, 0.5, 1.0, 1.5, 2.0, 9.0])
    step = sample(channel(0, "translation", [0, 1, 2], values, "STEP"), at)[:, 0]
    assert step.tolist() == [0, 0, 0, 2, 2, 10, 10]
    linear = sample(channel(0, "translation", [0, 1, 2], values), at)[:, 0]
    assert linear.tolist() == [0, 0, 1, 2, 6, 10, 10]


def test_cubic_spline_is_hermites(rng):
    times = np.array([0.5, 1.0, 3.0])
    values = rng.normal(size=(3, 3, 3))
    values[:, 0] = values[:, 2]  # SciPy has one tangent per key
    at = np.linspace(0.5, 3.0, 40)
    found = sample(channel(0, "scale", times, values, "CUBICSPLINE"), at)
    # Two evaluations of one cubic: rounding alone.
    assert np.allclose(found, CubicHermiteSpline(times, values[:, 1], values[:, 2])(at), atol=1e-13)


def test_linear_rotations_are_slerp_along_the_shorter_arc(rng):
    keys = Rotation.random(5, random_state=1)
    quaternions = keys.as_quat() * np.array([1, -1, 1, -1, -1])[:, None]
    at = np.linspace(0, 4, 50)
    found = sample(channel(0, "rotation", np.arange(5.0), quaternions), at)
    expected = Slerp(np.arange(5.0), keys)(at)
    assert (Rotation.from_quat(found) * expected.inv()).magnitude().max() < 1e-12
    assert np.allclose(np.linalg.norm(found, axis=1), 1, atol=1e-15)


def test_spline_rotations_stay_unit(rng):
    values = rng.normal(size=(4, 3, 4))
    found = sample(channel(0, "rotation", np.arange(4.0), values, "CUBICSPLINE"), np.linspace(0, 3, 30))
    assert np.allclose(np.linalg.norm(found, axis=1), 1, atol=1e-15)


@pytest.mark.parametrize("interpolation", ["STEP", "LINEAR", "CUBICSPLINE"])
def test_one_key_is_that_key_always(interpolation):
    value = [[[9, 9, 9], [1, 2, 3], [9, 9, 9]]] if interpolation == "CUBICSPLINE" else [[1, 2, 3]]
    found = sample(channel(0, "translation", [2.0], value, interpolation), np.array([0.0, 2.0, 5.0]))
    assert found.tolist() == [[1, 2, 3]] * 3


def test_frames_of_a_clip_are_all_its_keys():
    c = clip(channel(0, "translation", [0.5, 1], [[0] * 3] * 2), channel(1, "scale", [0.25, 1], [[1] * 3] * 2))
    assert c.frames().tolist() == [0.25, 0.5, 1.0]
    assert (c.start, c.stop, c.seconds) == (0.25, 1.0, 0.75)


def test_quaternions_agree_with_scipy():
    a, b = Rotation.random(20, random_state=2), Rotation.random(20, random_state=3)
    product = Rotation.from_quat(multiply(a.as_quat(), b.as_quat()))
    assert ((a * b).inv() * product).magnitude().max() < 1e-14
    assert np.allclose(rotation_matrix(a.as_quat()), a.as_matrix(), atol=1e-15)
    assert np.allclose(quaternion_of(a.as_matrix()), a.as_quat(canonical=True), atol=1e-14)
    assert np.allclose(rotation_vector(a.as_quat()), a.as_rotvec(), atol=1e-14)


def test_small_rotations_keep_their_digits():
    for angle in (0.0, 1e-200, 1e-15, 1e-8):
        found = rotation_vector(np.array([0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)]))
        assert found[2] == pytest.approx(angle, rel=1e-12, abs=0)


def test_turns_are_counted_through_several_rounds():
    angles = np.arange(0, 1500, 25.0)
    vectors = rotation_vector(np.array([turn_z(a) for a in angles]))
    assert np.abs(np.diff(vectors[:, 2])).max() > 5  # as they come, they jump
    assert np.allclose(unwrap_vectors(vectors), np.radians(angles)[:, None] * [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize("interpolation", ["STEP", "LINEAR", "CUBICSPLINE"])
def test_tracks_are_their_channels(rng, interpolation):
    def one(node, times):
        path, width = ("scale", 3) if node % 2 else ("rotation", 4)
        values = rng.normal(size=(len(times), 3, width))
        if path == "rotation":
            values = unit_quaternion(values)
        return channel(node, path, times, values if interpolation == "CUBICSPLINE" else values[:, 1], interpolation)

    same, other = [0.0, 1.0, 2.0], [0.0, 1.5, 2.0]
    c = clip(*(one(node, same if node < 4 else other) for node in range(6)))
    assert [t.nodes.tolist() for t in tracks(c)] == [[0, 2], [1, 3], [4], [5]]
    at = np.linspace(-0.5, 2.5, 13)
    for track in tracks(c):
        together = sample(track, at)
        for k, node in enumerate(track.nodes):
            assert np.array_equal(together[:, k], sample(c.channels[node], at))
