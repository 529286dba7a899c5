"""Texts of `--pose`, and what they do to a scene's geometry."""

import numpy as np
import pytest

from relightcli.core.affine import compose
from relightcli.errors import InputError
from relightcli.scene.build import build_geometry
from relightcli.scene.parse import load_scene
from relightcli.scene.posing import Pose, apply_poses, parse_pose, resolve_poses
from tests.adapters.test_gltf import Builder
from tests.adapters.test_rigs import animate, skinned

SCENE = """format = 1
[objects.bar]
mesh = "bar.gltf"
material = "grey"
motion = "skinned"
scale = [-2, 1, 1]
rotate = [0, 1, 0, 90]
translate = [0, 0, 3]
[objects.floor]
mesh = "floor.obj"
material = "grey"
[materials.grey]
"""


@pytest.fixture
def scene(tmp_path):
    b = skinned(Builder(), weights=[[1, 0, 0, 0], [0, 1, 0, 0], [0.5, 0.5, 0, 0]])
    half = np.sqrt(0.5)
    animate(b, "rotation", [1, 3], [[0, 0, 0, 1], [0, 0, half, half]], name="bend")
    b.gltf(tmp_path / "bar.gltf")
    (tmp_path / "floor.obj").write_text("v 0 0 0\nv 0 0 1\nv 1 0 0\nf 1 2 3\n")
    (tmp_path / "scene.toml").write_text(SCENE)
    return load_scene(tmp_path / "scene.toml")


def test_texts():
    assert parse_pose("man=walk@1.5") == Pose("man", "walk", 1.5)
    assert parse_pose("man=a=b@c@-2") == Pose("man", "a=b@c", -2.0)


@pytest.mark.parametrize(
    "text", ["", "man", "man=walk", "man=@1", "=walk@1", "man=walk@", "man=walk@x", "man=walk@nan"]
)
def test_texts_that_say_nothing(text):
    with pytest.raises(InputError, match="expected OBJECT=CLIP@SECONDS"):
        parse_pose(text)


def test_a_posed_object_moves_and_the_others_do_not(scene):
    rest = build_geometry(scene)
    posed, notes = apply_poses(scene, rest, ["bar=bend@3"])
    assert notes == []
    # The second vertex, (1, 0, 0), hangs on the joint at (0, 1, 0), which turns by a quarter about z: (1, 2, 0); the
    # third, half on it, from (0, 1, 0): where it is.
    place = compose(np.array([0.0, 0, 3]), np.array([0.0, 1, 0]), 90, np.array([-2.0, 1, 1]))
    local = np.array([[0, 0, 0], [1, 2, 0], [0, 1, 0]])
    assert np.allclose(posed.positions[:3], local @ place[:3, :3].T + place[:3, 3], atol=1e-6)
    assert np.array_equal(posed.positions[3:], rest.positions[3:])
    assert np.array_equal(posed.faces, rest.faces)
    for geometry in (rest, posed):  # fronts are still fronts, under the mirroring scale too
        corner = geometry.positions[geometry.faces[0]]
        assert np.cross(corner[1] - corner[0], corner[2] - corner[0]) @ geometry.normals[0] > 0


def test_the_start_of_the_clip_is_the_rest_pose_here(scene):
    rest = build_geometry(scene)
    assert np.allclose(apply_poses(scene, rest, ["bar=bend@1"])[0].positions, rest.positions, atol=1e-7)
    assert apply_poses(scene, rest, [])[0] is rest


def test_seconds_outside_the_clip_are_its_ends(scene):
    geometry = build_geometry(scene)
    for text, seconds in (("bar=bend@0", 1.0), ("bar=bend@9", 3.0)):
        resolved, notes = resolve_poses(scene, geometry, [text])
        assert resolved["bar"][1] == seconds
        assert notes == [f"--pose {text}: 'bend' lasts from 1 to 3 s; {seconds:g} s is taken"]
    assert resolve_poses(scene, geometry, ["bar=bend@9", "bar=bend@2"])[1] == []  # the last one counts


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("floor=bend@1", "'floor' is static; expected one with motion = \"skinned\".*bar"),
        ("baz=bend@1", "no object 'baz'; skinned are: bar. Did you mean 'bar'"),
        ("bar=bent@1", "no clip 'bent'; it has: bend. Did you mean 'bend'"),
    ],
)
def test_what_cannot_be_posed(scene, text, message):
    with pytest.raises(InputError, match=message):
        resolve_poses(scene, build_geometry(scene), [text])
