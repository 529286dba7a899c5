"""Moves of objects and lights: what the numbers mean, how they are interpolated, and what is refused."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from relightcli.core.affine import compose
from relightcli.errors import InputError
from relightcli.scene.build import build_geometry
from relightcli.scene.moving import angles, apply_moves, between, move_geometry, parse_move, polar, rotation
from relightcli.scene.parse import load_scene

SCENE = """format = 1
[objects.wall]
mesh = "tetra.obj"
material = "m"
[objects.ball]
mesh = "tetra.obj"
material = "m"
motion = "rigid"
translate = [1, 2, 3]
rotate = [0, 1, 0, 30]
scale = [1, 2, 3]
[materials.m]
[lights.lamp]
shape = "sphere"
center = [0, 5, 0]
radius = 0.1
radiance = [1, 1, 1]
[lights.panel]
shape = "rectangle"
center = [0, 5, 0]
edge_u = [1, 0, 0]
edge_v = [0, 0, 1]
radiance = [1, 1, 1]
"""
TETRA = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "tetra.obj").write_text(TETRA)
    (tmp_path / "scene.toml").write_text(SCENE)
    return load_scene(tmp_path / "scene.toml")


def test_three_numbers_are_the_new_translation(scene):
    moved = apply_moves(scene, ["ball=7,8,9", "lamp=1,1,1"])
    np.testing.assert_array_equal(moved.objects["ball"].transform[:3, 3], (7, 8, 9))
    np.testing.assert_array_equal(moved.objects["ball"].transform[:3, :3], scene.objects["ball"].transform[:3, :3])
    assert moved.lights["lamp"].center == (1.0, 1.0, 1.0)
    assert moved.objects["wall"] is scene.objects["wall"]


def test_six_numbers_replace_the_rotation_and_keep_the_scale(scene):
    moved = apply_moves(scene, ["ball=0,0,0,10,20,30"])
    wanted = Rotation.from_euler("xyz", (10, 20, 30), degrees=True).as_matrix() * (1, 2, 3)
    np.testing.assert_allclose(moved.objects["ball"].transform[:3, :3], wanted, atol=1e-14)
    panel = apply_moves(scene, ["panel=1,2,3,90,0,0"]).lights["panel"]
    assert (panel.center, panel.edge_u) == ((1.0, 2.0, 3.0), (1.0, 0.0, 0.0))
    np.testing.assert_array_equal(panel.edge_v, (0, -1, 0))  # +Z about +X by 90 degrees


def test_later_moves_go_on_top_of_earlier_ones(scene):
    moved = apply_moves(scene, ["ball=0,0,0,10,20,30", "ball=4,5,6"]).objects["ball"].transform
    turned = apply_moves(scene, ["ball=4,5,6,10,20,30"]).objects["ball"].transform
    np.testing.assert_array_equal(moved, turned)


@pytest.mark.parametrize("numbers", ["5,-3,2", "5,-3,2,40,50,60", "-1,0,0,1,0,2,0,2,0,0,1,3,0,0,0,1"])
def test_stored_geometry_moves_as_the_scene_would_be_built(scene, numbers):
    moved = apply_moves(scene, [f"ball={numbers}"])
    found = move_geometry(build_geometry(scene), scene, moved)
    wanted = build_geometry(moved)
    # The way back and forth costs a few roundings of coordinates below 10.
    np.testing.assert_allclose(found.positions, wanted.positions, atol=1e-14)
    np.testing.assert_allclose(found.normals, wanted.normals, atol=1e-6)
    np.testing.assert_array_equal(found.faces, wanted.faces)  # mirrored: turned round in both


@pytest.mark.parametrize("degrees", [(10, 20, 30), (-170, 80, 179), (0, 90, 25), (33, -90, 0), (180, 0, 0)])
def test_angles_are_the_inverse_of_rotation(degrees):
    turn = rotation(degrees)
    np.testing.assert_allclose(turn, Rotation.from_euler("xyz", degrees, degrees=True).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(rotation(angles(turn)), turn, atol=2e-8)  # arcsin near 1 has half the digits


def test_polar_parts_of_a_mirror():
    linear = compose(np.zeros(3), np.array([1.0, 2, 3]), 50.0, np.array([1.0, 2, -3]))[:3, :3]
    turn, scale = polar(linear)
    np.testing.assert_allclose(turn @ scale, linear, atol=1e-14)
    assert np.linalg.det(turn) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(scale, scale.T, atol=1e-14)


def test_rotations_between_keys_turn_at_an_even_pace():
    a, b = (0.0, 0, 0, 10, 20, 30), (4.0, 0, 0, -60, 70, 110)
    turns = [rotation(between(a, b, t)[3:]) for t in (0.0, 0.25, 0.5, 0.75, 1.0)]
    steps = [Rotation.from_matrix(p.T @ q).as_rotvec() for p, q in itertools.pairwise(turns)]
    np.testing.assert_allclose(steps, np.tile(steps[0], (4, 1)), atol=1e-12)
    np.testing.assert_allclose(turns[-1], rotation(b[3:]), atol=1e-14)
    half = np.array(between(*(tuple(np.diag(d).reshape(-1)) for d in ((1.0, 1, 1, 1), (3.0, 3, 5, 1))), 0.5))
    np.testing.assert_allclose(half.reshape(4, 4), np.diag([2.0, 2, 3, 1]), atol=1e-14)


@pytest.mark.parametrize(
    ("move", "message"),
    [
        ("ball", "expected NAME=x,y,z"),
        ("=1,2,3", "expected NAME=x,y,z"),
        ("ball=1,2", "expected NAME=x,y,z"),
        ("ball=1,2,nan", "expected NAME=x,y,z"),
        ("bal=1,2,3", "no object or light 'bal'; what can be moved: ball, lamp, panel. Did you mean 'ball'"),
        ("wall=1,2,3", "objects.wall.motion is 'static'; expected 'rigid'"),
        ("ball=1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,2", "last row of 0,0,0,1"),
        ("ball=1,0,0,0,0,1,0,0,0,0,0,0,0,0,0,1", "flatten"),
        ("lamp=1,2,3,4,5,6", "'lamp' is a sphere light; expected 3 numbers"),
        ("panel=1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1", "'panel' is a rectangle light; expected 3 or 6 numbers"),
        ("lamp=1e300,0,0", "within"),
    ],
)
def test_refusals(scene, move, message):
    with pytest.raises(InputError, match=message):
        apply_moves(scene, [move])


def test_a_move_out_of_range_is_refused(scene):
    with pytest.raises(InputError, match="takes its mesh beyond"):
        move_geometry(build_geometry(scene), scene, apply_moves(scene, ["ball=1e300,0,0"]))


def test_names_may_hold_an_equals_sign():
    assert parse_move("a=b=1,2,3") == ("a=b", (1.0, 2.0, 3.0))
