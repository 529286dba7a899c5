"""Poses of rigs small enough to work out by hand, and what must hold of any."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from relightcli.core.pose.clip import sample
from relightcli.core.pose.rig import feature_names, joint_matrices, pose_features, skin
from tests.core.pose.rigs import arm, channel, clip, turn_z

BEND = clip(channel(2, "rotation", [0.0, 1.0, 2.0], [turn_z(0), turn_z(90), turn_z(90)]))


def frames_are_orthonormal(normal, tangent):
    assert np.allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-14)
    assert np.allclose(np.linalg.norm(tangent, axis=1), 1, atol=1e-14)
    assert np.abs((normal * tangent).sum(axis=1)).max() < 1e-14


def test_the_rest_pose_is_the_bind_pose():
    rig = arm(BEND)
    position, normal, tangent = skin(rig, joint_matrices(rig, None))
    assert np.array_equal(position, rig.position)
    assert np.array_equal(normal, rig.normal)
    assert np.array_equal(tangent, rig.tangent)


def test_a_bent_elbow():
    rig = arm(BEND)
    position, normal, tangent = skin(rig, joint_matrices(rig, BEND, 1.0))
    # A quarter turn about (0, 1, 0), from y towards -x.
    assert np.allclose(position, [[0, 0, 0], [0.5, 0.5, 0], [-0.5, 1.5, 0], [-1, 1, 0]], atol=1e-15)
    assert np.allclose(normal, [[0, -1, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0]], atol=1e-15)
    frames_are_orthonormal(normal, tangent)


def test_time_is_clamped_to_the_clip():
    rig = arm(BEND)
    assert np.array_equal(joint_matrices(rig, BEND, -5.0), joint_matrices(rig, BEND, 0.0))
    assert np.array_equal(joint_matrices(rig, BEND, 50.0), joint_matrices(rig, BEND, 2.0))


def test_weights_mix_matrices():
    rig = arm(BEND, weight=[[1, 0], [1, 0], [0.5, 0.5], [0.25, 0.75]])
    position, normal, tangent = skin(rig, joint_matrices(rig, BEND, 1.0))
    assert np.allclose(position[2], 0.5 * np.array([0.5, 1.5, 0]) + 0.5 * np.array([-0.5, 1.5, 0]), atol=1e-15)
    assert np.allclose(position[3], 0.25 * np.array([0, 2, 0]) + 0.75 * np.array([-1, 1, 0]), atol=1e-15)
    frames_are_orthonormal(normal, tangent)


def test_one_matrix_for_all_joints_moves_the_mesh_as_a_whole():
    rig = arm(BEND, weight=[[1, 0], [0.7, 0.3], [0.5, 0.5], [0.25, 0.75]])
    pose = joint_matrices(rig, BEND, 0.7)
    whole = np.eye(4)
    whole[:3, :3] = Rotation.from_rotvec([0.3, -1.1, 0.8]).as_matrix()
    whole[:3, 3] = (5, -3, 2)
    before, after = skin(rig, pose), skin(rig, whole @ pose)
    assert np.allclose(after[0], before[0] @ whole[:3, :3].T + whole[:3, 3], atol=1e-14)
    for a, b in zip(after[1:], before[1:], strict=True):
        assert np.allclose(a, b @ whole[:3, :3].T, atol=1e-14)


@pytest.mark.parametrize("scale", [(3.0, 1.0, 0.2), (1e-100, 1e-100, 3e-100), (1e90, 2e90, 1e90), (-1.0, 1.0, 1.0)])
def test_normals_stay_right_under_scales_that_differ_by_axis(scale):
    rig = arm()
    slanted = np.array([[0.6, 0.8, 0.0], [0.0, 0.6, -0.8], [1.0, 0.0, 0.0], [0.48, 0.64, 0.6]])
    rig = type(rig)(**{**rig.__dict__, "normal": slanted, "tangent": np.cross(slanted, [0.1, 0.2, 0.97])})
    matrices = np.array([np.diag([*scale, 1.0])] * 2)
    _, normal, tangent = skin(rig, matrices)
    expected = slanted / np.array(scale) * abs(scale[0])  # the inverse transpose of a diagonal matrix
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.allclose(normal, expected, atol=1e-14)
    frames_are_orthonormal(normal, tangent)


def test_a_skin_that_collapses_still_has_frames():
    rig = arm()
    for matrices in (np.zeros((2, 4, 4)), np.array([np.diag([1.0, 0.0, 0.0, 1.0])] * 2)):
        position, normal, tangent = skin(rig, matrices)
        assert np.isfinite(position).all()
        frames_are_orthonormal(normal, tangent)


def test_features_are_what_turns_a_part_of_the_skin():
    whole = channel(1, "rotation", [0.0, 1.0], [turn_z(0), turn_z(90)])  # joint 0: all of the skin hangs on it
    above = channel(0, "translation", [0.0, 1.0], [[0, 0, 0], [5, 0, 0]])
    walk = clip(whole, above, *BEND.channels)
    rig = arm(walk)
    assert feature_names(rig) == ("upper.rotation.x", "upper.rotation.y", "upper.rotation.z")
    assert np.allclose(pose_features(rig, walk, 0.5), [0, 0, np.pi / 4], atol=1e-14)
    assert np.array_equal(pose_features(rig, None), [0, 0, 0])


def test_what_never_moves_is_no_feature():
    still = clip(channel(2, "rotation", [0.0, 1.0], [turn_z(30)] * 2))
    assert pose_features(arm(still), still, 0.5).shape == (0,)
    # Still in each clip, but another in every one.
    other = clip(channel(2, "rotation", [0.0], [turn_z(40)]), name="other")
    rig = arm(still, other)
    assert np.allclose(pose_features(rig, still, 0.5), [0, 0, np.radians(30)], atol=1e-14)
    assert np.allclose(pose_features(rig, other, 0.0), [0, 0, np.radians(40)], atol=1e-14)


def test_a_clip_of_one_frame_poses():
    one = clip(channel(2, "rotation", [0.0], [turn_z(90)]))
    rig = arm(one)
    assert np.allclose(skin(rig, joint_matrices(rig, one, 3.0))[0][3], [-1, 1, 0], atol=1e-15)
    assert one.seconds == 0


def test_translations_and_scales_of_parts_are_features():
    stretch = clip(
        channel(2, "translation", [0.0, 1.0], [[0, 1, 0], [0, 2, 0]]),
        channel(2, "scale", [0.0, 1.0], [[1, 1, 1], [1, 3, 1]]),
    )
    rig = arm(stretch)
    size = np.linalg.norm([0.5, 2.0, 0.0])
    assert np.allclose(pose_features(rig, stretch, 0.5), [0, 0.5 / size, 0, 0, 1, 0], atol=1e-15)


@pytest.mark.parametrize("interpolation", ["LINEAR", "CUBICSPLINE"])
def test_features_are_continuous_through_two_full_turns(interpolation):
    keys = np.array([turn_z(a) for a in np.arange(0, 721, 120)])
    if interpolation == "CUBICSPLINE":
        keys = np.stack([0 * keys, keys, 0 * keys], axis=1)
    spin = clip(channel(2, "rotation", np.arange(7.0), keys, interpolation))
    rig = arm(spin)
    at = np.linspace(-0.5, 6.5, 500)
    found = np.array([pose_features(rig, spin, t) for t in at])
    # A third of a turn a second; Hermite with no tangents runs 1.5 times as fast in the middle, and the chord's
    # projection on the sphere twice that at most.
    assert np.abs(np.diff(found, axis=0)).max() < 3.0 * np.radians(120) * (at[1] - at[0])
    assert np.allclose(found[-1], [0, 0, 4 * np.pi], atol=1e-12)
    again = Rotation.from_rotvec(found)
    true = Rotation.from_quat(sample(spin.channels[0], at))
    assert (again.inv() * true).magnitude().max() < 1e-12
