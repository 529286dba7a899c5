"""Captured motion on a rig of other proportions, in another rest pose, turned another way."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from relightcli.core.pose.clip import rotation_matrix
from relightcli.core.pose.retarget import Motion, retarget
from relightcli.core.pose.rig import Rig, node_matrices
from tests.core.pose.rigs import translation


def motion(rotations):
    """Hip with two legs and a back; each leg with a foot. rotations (F, 6, 4)."""
    names = ("hip", "left", "left foot", "right", "right foot", "back")
    parent = np.array([-1, 0, 1, 0, 3, 0], np.int32)
    offset = np.array([[0, 0, 0], [1, -0.2, 0], [0, -3, 0], [-1, -0.2, 0], [0, -3, 0], [0, 2, 0]], float)
    way = np.tile(offset, (len(rotations), 1, 1))
    way[:, 0] = [[t, 5, 0] for t in range(len(rotations))]
    return Motion(names, parent, offset, np.arange(len(rotations)) / 10.0, rotations, way)


def rig():
    """The same body at half the size, facing x, its legs spread, below a node that is turned and scaled by 2."""
    turn = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    top = np.eye(4)
    top[:3, :3] = 2.0 * turn
    rest = [top, translation(0, 1.5, 0)]
    # In the top node's frame, in its units: half of the half.
    for side in (1, -1):
        leg = translation(0.25 * side, -0.05, 0)
        leg[:3, :3] = Rotation.from_euler("z", 40.0 * side, degrees=True).as_matrix()
        rest += [leg, translation(0, -0.75, 0)]
    rest.append(translation(0, 0.5, 0))
    rest = np.array(rest)
    rotation = Rotation.from_matrix(rest[:, :3, :3] / np.linalg.norm(rest[:, :3, :3], axis=1)[:, None]).as_quat()
    return Rig(
        position=np.zeros((1, 3)),
        normal=np.array([[0.0, 0.0, 1.0]]),
        tangent=np.array([[1.0, 0.0, 0.0]]),
        joint=np.zeros((1, 1), np.int32),
        weight=np.ones((1, 1)),
        inverse_bind=np.eye(4)[None],
        parent=np.array([-1, 0, 1, 2, 1, 4, 1], np.int32),
        rest=rest,
        translation=rest[:, :3, 3],
        rotation=rotation,
        scale=np.linalg.norm(rest[:, :3, :3], axis=1),
        joint_node=np.array([1], np.int32),
        node_names=("top", "Hip", "LegL", "FootL", "LegR", "FootR", "Back"),
    )


MAP = {"Hip": "hip", "LegL": "left", "FootL": "left foot", "LegR": "right", "FootR": "right foot", "Back": "back"}
STILL = np.tile([0.0, 0.0, 0.0, 1.0], (4, 6, 1))


def bones(places, names, pairs):
    out = np.array([places[..., names.index(b), :] - places[..., names.index(a), :] for a, b in pairs])
    return out / np.linalg.norm(out, axis=-1, keepdims=True)


def world(clip, seconds):
    return node_matrices(rig(), clip, seconds)[:, :3, 3]


def test_at_rest_bones_point_as_the_captured_ones_do():
    clip = retarget(rig(), motion(STILL), MAP, "still")
    found = bones(world(clip, 0.0), rig().node_names, [("LegL", "FootL"), ("LegR", "FootR"), ("Hip", "Back")])
    assert np.allclose(found, [[0, -1, 0], [0, -1, 0], [0, 1, 0]], atol=1e-12)
    # The left leg is on the captured left, whichever way the rig faced.
    side = bones(world(clip, 0.0), rig().node_names, [("LegR", "LegL")])
    assert np.allclose(side, [[1, 0, 0]], atol=1e-12)


def test_moving_bones_follow():
    turns = Rotation.random(24, random_state=4).as_quat().reshape(4, 6, 4)
    captured = motion(turns)
    clip = retarget(rig(), captured, MAP, "any")
    for frame, seconds in enumerate(captured.seconds):
        hip = rotation_matrix(turns[frame, 0])
        left = hip @ rotation_matrix(turns[frame, 1])
        expected = [left @ [0, -1, 0], hip @ [0, 1, 0]]
        found = bones(world(clip, float(seconds)), rig().node_names, [("LegL", "FootL"), ("Hip", "Back")])
        assert np.allclose(found, expected, atol=1e-12)
    for channel in clip.channels:
        if channel.path == "rotation":
            assert (np.einsum("fi,fi->f", channel.values[1:], channel.values[:-1]) >= 0).all()


def test_the_way_is_scaled_to_the_body():
    clip = retarget(rig(), motion(STILL), MAP, "walk")
    start, later = world(clip, 0.0)[1], world(clip, 0.3)[1]
    assert np.allclose(start, [0, 3, 0], atol=1e-12)  # where the rig stands
    assert np.allclose(later - start, [1.5, 0, 0], atol=1e-12)  # 3 at half the size


def test_nodes_that_are_not_mapped_keep_still():
    clip = retarget(rig(), motion(STILL), {k: v for k, v in MAP.items() if k != "LegR"}, "some")
    assert sorted({c.node for c in clip.channels}) == [1, 2, 3, 5, 6]


@pytest.mark.parametrize("captured", [[0, -1, 0], [0, 1, 0], [0.6, 0, 0.8], [0, 1, 1e-9]])
def test_one_bone_turns_the_shortest_way(captured):
    from relightcli.core.pose.retarget import _nearest_rotation

    captured = np.array(captured, float)
    q = _nearest_rotation(np.array([[0.0, 1.0, 0.0]]), captured[None])
    assert np.allclose(rotation_matrix(q) @ [0, 1, 0], captured, atol=1e-8)
    angle = 2 * np.arccos(np.clip(abs(q[3]), 0, 1))
    assert angle == pytest.approx(np.arccos(captured[1] / np.linalg.norm(captured)), abs=1e-7)
