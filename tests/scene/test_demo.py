import numpy as np
import pytest

from relightcli.adapters.images import read_environment
from relightcli.scene.build import build_geometry
from relightcli.scene.demo import write_demo_scene
from relightcli.scene.parse import load_scene
from relightcli.scene.shapes import arc_beam, lathe, patch, rounded, torus_knot, tube


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    scene = load_scene(write_demo_scene(tmp_path_factory.mktemp("demo") / "scene"))
    return scene, build_geometry(scene)


def volume(positions, faces):
    p = positions[faces]
    return np.einsum("fi,fi->", p[:, 0], np.cross(p[:, 1], p[:, 2])) / 6


def test_the_demo_loads_without_a_remark(demo):
    scene, geometry = demo
    assert geometry.notes == ()
    assert set(scene.environments) == {"sky-noon", "sky-morning", "sky-overcast"}
    assert {m.model for m in scene.materials.values()} == {"lambert", "blinn-phong", "cook-torrance"}
    # About 30,000 vertices: small enough for the two-core demo, fine enough for its shadows.
    assert 25_000 < len(geometry.positions) < 40_000
    assert len(np.unique(geometry.faces)) == len(geometry.positions)


def test_fronts_look_outwards_and_agree_with_the_normals(demo):
    _, geometry = demo
    for index, name in enumerate(geometry.object_names):
        faces = geometry.faces[geometry.face_object == index]
        p = geometry.positions[faces]
        face_normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        assert (np.einsum("fi,fi->f", face_normal, geometry.normals[faces[:, 0]]) > 0).all(), name
        if name == "court":
            assert (geometry.normals[faces] == (0, 1, 0)).all()
        else:
            assert volume(geometry.positions, faces) > 0, name


def test_nothing_sinks_into_the_ground(demo):
    _, geometry = demo
    # Heights go through float32 in the files.
    assert geometry.positions[:, 1].min() > -1e-6


def test_texture_coordinates_follow_the_ground(demo):
    scene, geometry = demo
    court = geometry.vertex_object == geometry.object_names.index("court")
    uv, p = geometry.uvs[court], geometry.positions[court]
    middle = np.argmin(np.abs(p[:, [0, 2]]).sum(axis=1))
    assert uv[middle].tolist() == [0.5, 0.5]
    # +X is to the right of the picture, +Z towards its lower edge.
    order = np.argsort(p[:, 0])
    assert (np.diff(uv[order, 0]) >= 0).all()
    order = np.argsort(p[:, 2])
    assert (np.diff(uv[order, 1]) <= 0).all()
    texture = geometry.textures[list(scene.materials).index("paving")]
    assert texture.shape == (1024, 1024, 3)
    assert 0 < texture.min() < texture.max() < 1


def test_the_skies_are_daylight(demo):
    scene, _ = demo
    for path in scene.environments.values():
        sky = read_environment(path)
        assert np.isfinite(sky).all()
        assert sky.min() >= 0
        assert sky.max() > 0


def test_the_same_version_writes_the_same_bytes(tmp_path):
    one, other = write_demo_scene(tmp_path / "a").parent, write_demo_scene(tmp_path / "b").parent
    write_demo_scene(tmp_path / "b")  # over what is there
    names = sorted(p.name for p in one.iterdir())
    assert names == sorted(p.name for p in other.iterdir())
    for name in names:
        assert (one / name).read_bytes() == (other / name).read_bytes(), name


def test_shapes_have_the_volumes_of_their_formulas():
    # Tessellation takes a share of the volume that falls with the square of the step; 2 % covers the coarsest.
    assert np.isclose(volume(*rounded((2, 2, 2), power=2)), 4 / 3 * np.pi, rtol=0.02)
    assert np.isclose(volume(*rounded((2, 4, 6), power=60)), 2 * 4 * 6, rtol=0.1)  # p = 60 still rounds the edges
    assert np.isclose(volume(*rounded((2, 4, 2), power=60, round_plan=True)), np.pi * 4, rtol=0.1)
    angle = 2 * np.pi * np.arange(100) / 100
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    assert np.isclose(volume(*tube(circle, 0.2, 40)), 2 * np.pi**2 * 0.04, rtol=0.02)
    assert np.isclose(volume(*arc_beam(2, 0.5, 1, 2, 0, np.pi, 200)), np.pi * 2 * 0.5 * 1, rtol=0.02)


def test_the_knot_keeps_off_the_origin_and_from_itself():
    curve = torus_knot(2, 3, 0.34, 0.15, 240)
    assert np.linalg.norm(curve, axis=1).min() > 0.15
    gap = np.linalg.norm(curve[:, None] - curve[None], axis=2)
    apart = np.abs((np.arange(240)[:, None] - np.arange(240) + 120) % 240 - 120) > 20
    assert gap[apart].min() > 2 * 0.085  # the tube's diameter


def test_patches_wrap_and_face_along_u_cross_v():
    u, v = np.meshgrid(np.arange(3.0), np.arange(4.0), indexing="ij")
    positions, faces = patch(np.stack([u, v, 0 * u], axis=-1))
    p = positions[faces]
    assert (np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]) == (0, 0, 1)).all()
    assert len(faces) == 2 * 2 * 3
    _, closed = lathe([(1, 0), (1, 1)], 8)
    assert len(closed) == 16
    assert closed.max() == 15
