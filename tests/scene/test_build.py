import numpy as np
import pytest

from relightcli.adapters.images import write_image
from relightcli.errors import InputError
from relightcli.scene.build import build_geometry
from relightcli.scene.parse import load_scene

HEAD = "format = 1\n[materials.m]\n[materials.wood]\ndiffuse_texture = 'wood.png'\n"


def build(folder, objects):
    path = folder / "scene.toml"
    path.write_text(HEAD + objects)
    return build_geometry(load_scene(path))


def face_normals(geometry):
    p = geometry.positions[geometry.faces]
    n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def test_objects_follow_one_another(scene_folder):
    (scene_folder / "square.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    g = build(
        scene_folder,
        "[objects.z]\nmesh = 'triangle.obj'\nmaterial = 'm'\n"
        "[objects.a]\nmesh = 'square.obj'\nmaterial = 'wood2'\ntwo_sided = true\ntranslate = [0, 0, 5]\n"
        "[materials.wood2]\n",
    )
    assert g.object_names == ("z", "a")
    assert g.positions.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5], [1, 0, 5], [1, 1, 5], [0, 1, 5]]
    assert g.vertex_object.tolist() == [0, 0, 0, 1, 1, 1, 1]
    assert g.face_object.tolist() == [0, 1, 1]
    assert g.faces.min(axis=1).tolist() == [0, 3, 3]
    assert g.material.tolist() == [0, 2]
    assert g.two_sided.tolist() == [False, True]
    assert g.textures == {}
    assert [
        a.dtype.name for a in (g.positions, g.normals, g.uvs, g.faces, g.vertex_object, g.face_object, g.material)
    ] == [
        "float64",
        "float32",
        "float32",
        "int32",
        "int32",
        "int32",
        "int32",
    ]


def test_scale_then_rotate_then_translate(scene_folder):
    g = build(
        scene_folder,
        "[objects.a]\nmesh = 'triangle.obj'\nmaterial = 'm'\n"
        "scale = [2, 3, 1]\nrotate = [0, 0, 1, 90]\ntranslate = [10, 0, 0]\n",
    )
    # (1,0,0) -> (2,0,0) -> (0,2,0) -> (10,2,0); (0,1,0) -> (0,3,0) -> (-3,0,0) -> (7,0,0). Quarter turns are exact.
    assert g.positions.tolist() == [[10, 0, 0], [10, 2, 0], [7, 0, 0]]


@pytest.mark.parametrize(
    "transform", ["scale = [-1, 1, 1]", "scale = [1, 1, -2]", "scale = -3", "rotate = [0, 1, 0, 180]"]
)
def test_fronts_stay_fronts(scene_folder, transform):
    g = build(scene_folder, f"[objects.a]\nmesh = 'triangle.obj'\nmaterial = 'm'\n{transform}\n")
    # A vertex normal (the front) and its face's counter-clockwise side must agree after any transform.
    assert np.allclose(face_normals(g), g.normals[g.faces[:, 0]], atol=1e-7)  # float32 normals


def test_a_mirrored_closed_mesh_keeps_a_positive_volume(scene_folder):
    import trimesh

    (scene_folder / "ball.ply").write_bytes(trimesh.creation.icosphere(subdivisions=2).export(file_type="ply"))
    g = build(scene_folder, "[objects.a]\nmesh = 'ball.ply'\nmaterial = 'm'\nscale = [1, -2, 1]\n")
    p = g.positions[g.faces]
    volume = np.einsum("fi,fi->", p[:, 0], np.cross(p[:, 1], p[:, 2])) / 6
    # An inscribed icosphere of two subdivisions has 95 % or more of 4/3 pi.
    assert 0.95 * 2 < volume / (4 / 3 * np.pi) < 2
    # n is the gradient of x^2 + (y/2)^2 + z^2; 0.02 covers the tessellation's own error of the normals.
    gradient = g.positions * [1, 0.25, 1]
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    assert np.abs(g.normals - gradient).max() < 0.02


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_normals_do_not_depend_on_scale(scene_folder, scale):
    g = build(scene_folder, f"[objects.a]\nmesh = 'triangle.obj'\nmaterial = 'm'\nscale = {scale}\n")
    assert np.array_equal(g.normals, [[0, 0, 1]] * 3)


def test_textures_come_by_material_index(scene_folder):
    picture = np.linspace(0, 1, 12).reshape(2, 2, 3).astype(np.float32)
    write_image(scene_folder / "wood.png", picture)
    g = build(scene_folder, "[objects.a]\nmesh = 'textured.obj'\nmaterial = 'wood'\n")
    assert list(g.textures) == [1]
    # 8 bits of sRGB: half a step is at most 0.0045 in linear light.
    assert np.abs(g.textures[1] - picture).max() < 0.005
    assert g.uvs.tolist() == [[0, 0], [1, 0], [0, 1]]


def test_a_texture_needs_texture_coordinates(scene_folder):
    write_image(scene_folder / "wood.png", np.zeros((1, 1, 3), np.float32))
    with pytest.raises(InputError, match=r"objects\.a\.material: 'wood' has a diffuse_texture, but 1 of 1 faces"):
        build(scene_folder, "[objects.a]\nmesh = 'triangle.obj'\nmaterial = 'wood'\n")


def test_a_texture_that_is_none_is_refused(scene_folder):
    with pytest.raises(InputError, match=r"wood\.png"):
        build(scene_folder, "[objects.a]\nmesh = 'textured.obj'\nmaterial = 'wood'\n")


def test_untextured_meshes_have_nan_coordinates(scene_folder):
    g = build(scene_folder, "[objects.a]\nmesh = 'triangle.obj'\nmaterial = 'm'\n")
    assert np.isnan(g.uvs).all()


def test_notes_name_the_object_and_the_mesh(scene_folder):
    (scene_folder / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 1 2\n")
    g = build(scene_folder, "[objects.a]\nmesh = 'flat.obj'\nmaterial = 'm'\n")
    assert g.notes == ("objects.a: flat.obj: 1 of 2 faces have no area and were dropped",)


@pytest.mark.parametrize(
    "transform", ["scale = 1e200", "translate = [0, 1e200, 0]", "scale = 1e308\ntranslate = [1, 1e308, 1]"]
)
def test_transforms_that_leave_the_numbers_are_refused(scene_folder, transform):
    with pytest.raises(InputError, match=r"objects\.a: its transform takes the mesh beyond 1e\+30"):
        build(scene_folder, f"[objects.a]\nmesh = 'triangle.obj'\nmaterial = 'm'\n{transform}\n")


def test_a_broken_mesh_is_named(scene_folder):
    (scene_folder / "broken.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"broken\.obj"):
        build(scene_folder, "[objects.a]\nmesh = 'broken.obj'\nmaterial = 'm'\n")
