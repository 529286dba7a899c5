"""Skinned glTF files: Khronos' samples, and files made here."""

import numpy as np
import pytest

from relightcli.adapters.meshes import load_mesh
from relightcli.adapters.rigs import load_rig
from relightcli.core.pose.rig import clip_features, feature_names, joint_matrices, pose_features, skin
from relightcli.errors import InputError
from tests.adapters.test_gltf import TRIANGLE, Builder

IDENTITY = np.eye(4, dtype="<f4").reshape(1, 16)


def skinned(b, weights=((1, 0, 0, 0),) * 3, joints=((0, 1, 0, 0),) * 3, positions=TRIANGLE, weight_type="<f4"):
    """A triangle on two joints, nodes 1 and 2, node 2 below node 1 at (0, 1, 0); the mesh is node 0."""
    weights = np.array(weights, weight_type)
    extra = {"normalized": True} if weight_type != "<f4" else {}
    b.mesh(
        {
            "attributes": {
                "POSITION": b.accessor(positions),
                "JOINTS_0": b.accessor(np.array(joints, "<u1")),
                "WEIGHTS_0": b.accessor(weights, **extra),
            }
        }
    )
    b.node(mesh=0, skin=0, translation=[7, 7, 7])  # has no say
    b.node(name="low", children=[2])
    b.node(name="high", translation=[0, 1, 0])
    inverse = np.repeat(IDENTITY, 2, axis=0)
    inverse[1, 13] = -1
    b.header["skins"] = [{"joints": [1, 2], "inverseBindMatrices": b.accessor(inverse, type="MAT4")}]
    return b


def animate(b, path, times, values, node=2, interpolation=None, name=None):
    sampler = {"input": b.accessor(np.array(times, "<f4")), "output": b.accessor(np.array(values, "<f4"))}
    if interpolation:
        sampler["interpolation"] = interpolation
    entry = {"samplers": [sampler], "channels": [{"sampler": 0, "target": {"node": node, "path": path}}]}
    b.header.setdefault("animations", []).append({**entry, **({"name": name} if name else {})})
    return b


def test_a_skin_made_by_hand(tmp_path):
    b = animate(
        skinned(Builder(), weights=[[1, 0, 0, 0], [0, 1, 0, 0], [0.5, 0.5, 0, 0]]),
        "translation",
        [0, 2],
        [[0, 1, 0], [0, 3, 0]],
    )
    mesh, rig = load_rig(b.gltf(tmp_path / "a.gltf"))
    assert mesh.notes == ()
    assert rig.joint_names == ("low", "high")
    assert np.array_equal(skin(rig, joint_matrices(rig, None))[0], TRIANGLE)
    up = skin(rig, joint_matrices(rig, rig.clips[0], 1.0))[0]
    assert np.allclose(up, [[0, 0, 0], [1, 1, 0], [0, 1.5, 0]], atol=1e-15)


def test_weights_that_do_not_add_up_are_scaled_with_a_note(tmp_path):
    b = skinned(Builder(), weights=[[0.2, 0.6, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0]])
    mesh, rig = load_rig(b.glb(tmp_path / "a.glb"))
    assert rig.weight[0, :2] == pytest.approx([0.25, 0.75], rel=1e-6)
    assert np.allclose(rig.weight.sum(axis=1), 1, atol=1e-15)
    assert rig.weight[2, 0] == 1
    assert any("1 of 3 vertices do not add up to 1 (0.8 to 0.8)" in note for note in mesh.notes)
    assert any("1 vertices have no weights" in note for note in mesh.notes)


def test_normalised_bytes_are_weights(tmp_path):
    b = skinned(Builder(), weights=[[255, 0, 0, 0], [51, 204, 0, 0], [0, 255, 0, 0]], weight_type="<u1")
    mesh, rig = load_rig(b.glb(tmp_path / "a.glb"))
    assert rig.weight[1, :2] == pytest.approx([0.2, 0.8])
    assert mesh.notes == ()


def test_several_primitives_skins_and_a_mesh_without_one(tmp_path):
    b = skinned(Builder())
    b.header["meshes"][0]["primitives"] *= 2
    b.header["skins"].append({"joints": [2]})
    plain = b.mesh({"attributes": {"POSITION": b.accessor(TRIANGLE)}})
    only = {**b.header["meshes"][0]["primitives"][0]["attributes"]}
    only["JOINTS_0"] = b.accessor(np.zeros((3, 4), "<u1"))
    b.mesh({"attributes": only})
    b.node(mesh=plain, translation=[0, 0, 5])
    b.node(mesh=2, skin=1)
    mesh, rig = load_rig(b.gltf(tmp_path / "a.gltf"))
    assert len(mesh.positions) == 12
    placed = skin(rig, joint_matrices(rig, None))[0]
    moved = [[0, 0, 0], [0, 0, 0], [0, 0, 5], [0, 1, 0]]
    assert np.array_equal(placed, np.concatenate([np.add(TRIANGLE, by) for by in moved]))


def test_a_skin_that_mirrors_turns_faces_around(tmp_path):
    b = skinned(Builder())
    b.header["nodes"][1]["scale"] = [-1, 1, 1]
    mesh, rig = load_rig(b.gltf(tmp_path / "a.gltf"))
    position, normal, _ = skin(rig, joint_matrices(rig, None))
    corner = position[mesh.faces[0]]
    up = np.cross(corner[1] - corner[0], corner[2] - corner[0])
    assert up @ normal[0] > 0


def test_several_clips_and_interpolations(tmp_path):
    b = skinned(Builder(), weights=[[0.5, 0.5, 0, 0]] * 3)
    half = np.sqrt(0.5)
    animate(b, "rotation", [0, 1], [[0, 0, 0, 1], [0, 0, half, half]], name="bend")
    animate(b, "rotation", [0, 1], [[0, 0, 0, 1], [0, 0, half, half]], interpolation="STEP", name="bend")
    zero = [0, 0, 0, 0]
    spline = [zero, [0, 0, 0, 1], zero, zero, [0, 0, half, half], zero]
    animate(b, "rotation", [0, 1], spline, interpolation="CUBICSPLINE")
    animate(b, "translation", [1.5], [[0, 4, 0]], name="pose")
    _, rig = load_rig(b.glb(tmp_path / "a.glb"))
    assert [c.name for c in rig.clips] == ["bend", "bend_2", "clip2", "pose"]
    linear, step, spline, pose = rig.clips
    assert feature_names(rig)[2] == "high.rotation.z"
    at = [pose_features(rig, clip, 0.5)[2] for clip in (linear, step, spline)]
    assert at == pytest.approx([np.pi / 4, 0, np.pi / 4], abs=1e-7)
    assert (pose.start, pose.seconds) == (1.5, 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda h: h.pop("skins"), "no skin"),
        (lambda h: h["skins"][0].update(joints=[1, 9]), "skins[0].joints"),
        (lambda h: h["skins"][0].update(joints=[1]), "joints 0 to 0"),
        (lambda h: h["animations"][0]["samplers"][0].update(interpolation="CUBIC"), "CUBICSPLINE"),
        (lambda h: h["animations"][0]["samplers"][0].update(interpolation="CUBICSPLINE"), "3 values for each"),
        (lambda h: h["animations"][0]["channels"][0].update(sampler=3), "sampler"),
        (lambda h: h["animations"][0]["channels"][0]["target"].update(path="colour"), "colour"),
        (lambda h: h["nodes"][2].update(matrix=np.eye(4).reshape(-1).tolist()), "matrix"),
        (lambda h: h["skins"].__setitem__(0, 5), "skins[0]"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, change, words):
    b = skinned(Builder(), weights=[[0.5, 0.5, 0, 0]] * 3)
    animate(b, "translation", [0, 1], [[0, 1, 0], [0, 2, 0]])
    change(b.header)
    with pytest.raises(InputError) as caught:
        load_rig(b.gltf(tmp_path / "a.gltf"))
    assert words in str(caught.value)
    assert "a.gltf" in str(caught.value)


def test_falling_times_and_empty_quaternions_are_refused(tmp_path):
    b = animate(skinned(Builder()), "translation", [1, 0], [[0, 1, 0], [0, 2, 0]])
    with pytest.raises(InputError, match="rising times"):
        load_rig(b.gltf(tmp_path / "a.gltf"))
    b = animate(skinned(Builder()), "rotation", [0], [[0, 0, 0, 0]])
    with pytest.raises(InputError, match="quaternions"):
        load_rig(b.gltf(tmp_path / "b.gltf"))


def test_other_formats_have_no_skin(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(InputError, match="skinned"):
        load_rig(tmp_path / "a.obj")


@pytest.mark.parametrize("name", ["CesiumMan/CesiumMan.gltf", "Fox/Fox.gltf", "CesiumMan.glb", "Fox.glb"])
def test_sample_characters_stand_at_rest_as_they_were_bound(shared_data, name):
    _, rig = load_rig(shared_data / "skinned" / name)
    raw = load_mesh(shared_data / "skinned" / name)  # under its node's matrix
    placed, normal, tangent = skin(rig, joint_matrices(rig, None))
    size = np.ptp(placed, axis=0).max()
    # float32 matrices and positions in the file.
    assert np.abs(placed - raw.positions).max() < 1e-6 * size
    assert (normal * raw.normals).sum(axis=1).min() > 1 - 1e-6
    assert np.abs((normal * tangent).sum(axis=1)).max() < 1e-14


def test_features_of_samples_move_little_from_frame_to_frame(shared_data):
    for name in ("CesiumMan.glb", "Fox.glb"):
        _, rig = load_rig(shared_data / "skinned" / name)
        for clip in rig.clips:
            at = np.linspace(clip.start, clip.stop, 400)
            features = clip_features(rig, clip, at)
            assert np.array_equal(features[7], pose_features(rig, clip, at[7]))
            speed = np.abs(np.diff(features, axis=0)).max() / (at[1] - at[0])
            # A jump by a turn would be 2 pi in one step, above 700 radians a second.
            assert 0.1 < speed < 60


def test_the_tutorials_bar_bends(shared_data):
    _, rig = load_rig(shared_data / "skinned" / "SimpleSkin.gltf")
    clip = rig.clips[0]
    # At 1 s the upper joint has turned a quarter about z, around (0, 1, 0); x is moved by its bind matrix's -0.5.
    top = skin(rig, joint_matrices(rig, clip, 1.0))[0][rig.position[:, 1] == 2]
    assert np.allclose(top, [[-1, 0.5, 0], [-1, 1.5, 0]], atol=2e-4)
