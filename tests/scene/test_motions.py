"""Captured motion in scene files: keys, maps, and what is refused."""

import numpy as np
import pytest

from relightcli.core.pose.rig import joint_matrices, skin
from relightcli.errors import InputError
from relightcli.scene.build import build_geometry
from relightcli.scene.parse import load_scene
from relightcli.stages.inputs import scene_inputs
from tests.stages.pose_files import SCENE, pose_scene

BVH = """HIERARCHY
ROOT Low
{
OFFSET 0 0 0
CHANNELS 3 Xposition Yposition Zposition
JOINT High
{
OFFSET 0 3 0
CHANNELS 1 Zrotation
}
}
MOTION
Frames: 3
Frame Time: 0.5
0 0 0 0
0 0 0 90
3 0 0 90
"""
MAP = "[joints]\nlow = 'Low'\nhigh = 'High'\n"
KEYS = 'motion_files = ["turn.bvh"]\njoint_map = "map.toml"\n'


def scene(folder, keys=KEYS, joint_map=MAP, text=SCENE):
    path = pose_scene(folder, text.replace('motion = "skinned"\n', 'motion = "skinned"\n' + keys))
    (folder / "turn.bvh").write_text(BVH)
    (folder / "map.toml").write_text(joint_map)
    return path


def test_a_motion_file_is_a_clip_of_its_name(tmp_path):
    loaded = load_scene(scene(tmp_path))
    rig = build_geometry(loaded).rigs["bar"]
    assert [c.name for c in rig.clips] == ["bend", "still", "turn"]
    top = np.argmax(rig.position[:, 1])
    place = skin(rig, joint_matrices(rig, rig.clips[2], 0.5))[0][top]
    x, _, z = rig.position[top]
    assert np.allclose(place, [-1, 1 + x, z], atol=1e-6)  # a quarter about (0, 1, 0)
    later = skin(rig, joint_matrices(rig, rig.clips[2], 1.0))[0][top]
    assert np.allclose(later - place, [1, 0, 0], atol=1e-6)  # the way, at a third of the size
    assert {"turn.bvh", "map.toml"} <= set(scene_inputs(loaded))


@pytest.mark.parametrize(
    ("keys", "joint_map", "message"),
    [
        ('motion_files = ["turn.bvh"]\n', MAP, "objects.bar.joint_map: expected a string, found nothing"),
        ('joint_map = "map.toml"\n', MAP, "motion_files: expected a list of BVH files, found nothing"),
        ('motion_files = []\njoint_map = "map.toml"\n', MAP, "motion_files: expected a list of BVH files"),
        (
            'motion_files = ["no.bvh"]\njoint_map = "map.toml"\n',
            MAP,
            "motion_files: expected a BVH file, found 'no.bvh'",
        ),
        (KEYS, "joints = 3", r"map.toml: expected one table \[joints\]"),
        (KEYS, MAP + "[more]\n", r"map.toml: expected one table \[joints\].*found more"),
        (KEYS, "[joints", "map.toml: is not valid TOML"),
        (KEYS, "[joints]\nheigh = 'High'", "joints.heigh: the mesh has no node 'heigh'.*Did you mean 'high'"),
        (KEYS, "[joints]\nhigh = 'Hihg'", "joints.high: no joint 'Hihg' in turn.bvh; it has Low, High.*'High'"),
        (KEYS, "[joints]\nhigh = 3", "joints.high: expected a captured joint's name, found 3"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, keys, joint_map, message):
    with pytest.raises(InputError, match=message):
        build_geometry(load_scene(scene(tmp_path, keys, joint_map)))


def test_only_skinned_objects_have_motion(tmp_path):
    text = SCENE.replace('mesh = "floor.obj"\n', 'mesh = "floor.obj"\njoint_map = "map.toml"\n')
    with pytest.raises(InputError, match=r"objects.floor.joint_map: expected it beside motion"):
        load_scene(scene(tmp_path, "", MAP, text))


def test_a_name_that_a_clip_has(tmp_path):
    path = scene(tmp_path, KEYS.replace("turn", "bend"))
    (tmp_path / "bend.bvh").write_text(BVH)
    with pytest.raises(InputError, match="has a clip 'bend' already"):
        build_geometry(load_scene(path))
