"""Geometry that breaks renderers: every picture stays finite, not negative, and where a bound is known, within it."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.cli.main import run
from relightcli.scene.model import Camera
from tests.core.transport.scenes import Part, lambert, sphere, square
from tests.stages.scene_files import make_store, picture, write_scene

GREY = lambert(0.5)
CAMERA = Camera("main", (0.3, 2.0, 3.0), (0.0, 0.3, 0.0), fov=40, size=(24, 16))
SKY = np.random.default_rng(7).random((8, 16, 3)) + 0.05
WHITE = np.ones((4, 8, 3))


def moved(camera, scale, shift):
    def place(point):
        return tuple(float(x) * scale + s for x, s in zip(point, shift, strict=True))

    return Camera(camera.name, place(camera.eye), place(camera.target), camera.up, camera.fov, camera.size)


def placed(part, scale, shift):
    return Part(part.corners * scale + np.array(shift), part.triangles, part.normals, part.uvs, part.material)


def shot(folder, parts, camera=CAMERA, sky=SKY, two_sided=False, **settings):
    """Precomputes and relights; RGB and alpha, after the checks that hold for every picture."""
    for part in parts.values():
        part.two_sided = part.two_sided or two_sided
    scene = write_scene(folder, parts, [camera], {"sky": sky}, adjustable=True)
    store = make_store(scene, light_resolution=16, **{"subdivide": False, **settings})
    rgb, alpha = picture(store)
    need_sane(rgb, alpha, 0.5 * sky.max())
    return rgb, alpha


def need_sane(rgb, alpha, most):
    """Finite, not negative, and no brighter than `most`: a convex mean of the sky times the albedo cannot be.

    The allowance is that of float32 sums over 16 x 16 x 6 texels, each off by at most 2^-24 of the total: 1e-4."""
    assert np.isfinite(rgb).all()
    assert rgb.min() >= 0
    assert rgb.max() <= most * (1 + 1e-4)
    assert alpha.min() >= 0
    assert alpha.max() <= 1 + 1e-6


def scene_parts():
    return {"ground": square(4, material=GREY), "ball": sphere(0.5, (0, 0.6, 0), rings=12, material=GREY)}


@pytest.mark.parametrize("scale", [2.0**-20, 2.0**20, 1e-6, 1e6])
def test_scale(tmp_path, scale):
    """One scene in micrometres and in megametres. Powers of two leave every mantissa as it is, so that the picture is
    the same; others round each vertex by 2^-24, which may move a vertex's shadow by single texels (of 1536)."""
    one, alpha_one = shot(tmp_path / "one", scene_parts())
    parts = {name: placed(part, scale, (0, 0, 0)) for name, part in scene_parts().items()}
    other, alpha = shot(tmp_path / "other", parts, moved(CAMERA, scale, (0, 0, 0)))
    if np.log2(scale) % 1 == 0:
        np.testing.assert_array_equal(other, one)
        np.testing.assert_array_equal(alpha, alpha_one)
    else:
        # At most 4 texels per vertex, each below 4 pi / 1536 * 2 sr under a sky of at most 1.05, times albedo over pi.
        np.testing.assert_allclose(other, one, atol=4 * (8 / 1536) * 1.05 * 0.5)
        np.testing.assert_allclose(alpha, alpha_one, atol=1 / 16 + 1e-6)  # a sample of a pixel's 16 at an edge


@pytest.mark.parametrize("shift", [1e3, 1e6])
def test_far_from_the_origin(tmp_path, shift):
    """A scene of size 1 at 1e3 and 1e6: float64 coordinates keep 10 digits and more, and rays are traced about the
    scene's own middle. Same bound as for odd scales."""
    one, _ = shot(tmp_path / "one", scene_parts())
    far = (shift, -shift, shift)
    parts = {name: placed(part, 1.0, far) for name, part in scene_parts().items()}
    other, _ = shot(tmp_path / "other", parts, moved(CAMERA, 1.0, far))
    assert np.mean(np.abs(other - one) > 4 * (8 / 1536) * 1.05 * 0.5) < 0.02  # pixels of the silhouette may flip


def test_furnace_over_anything_convex(tmp_path):
    """A white sky over a convex body gives albedo exactly, whatever the mesh: 0.5 within the texels' quadrature.

    16 texels a side integrate a clamped cosine to 1 % at worst (the horizon crosses texels of 6 degrees)."""
    rgb, alpha = shot(tmp_path, {"ball": sphere(0.5, (0, 0.3, 0), rings=16, material=GREY)}, sky=WHITE)
    full = alpha > 1 - 1e-6
    assert full.any()
    np.testing.assert_allclose(rgb[full], 0.5, rtol=0.01)


def test_one_triangle(tmp_path):
    """Facing an even sky it is as bright as its albedo; from behind it is black and opaque."""
    corners = np.array([[-1.0, 0, 1], [1, 0, 1], [0, 0, -1]])
    part = Part(corners, np.array([[0, 1, 2]]), material=GREY)
    above = Camera("main", (0, 3, 0.1), (0, 0, 0), fov=20, size=(8, 8))
    rgb, alpha = shot(tmp_path / "above", {"one": part}, above, WHITE)
    np.testing.assert_allclose(rgb[alpha > 1 - 1e-6], 0.5, rtol=0.01)
    below = Camera("main", (0, -3, 0.1), (0, 0, 0), fov=20, size=(8, 8))
    rgb, alpha = shot(tmp_path / "below", {"one": part}, below, WHITE)
    assert (alpha > 0).any()
    assert (rgb == 0).all()


def test_faces_without_area_and_loose_vertices_change_nothing(tmp_path):
    plain = scene_parts()
    expected, _ = shot(tmp_path / "plain", plain)
    littered = scene_parts()
    ball = littered["ball"]
    count = len(ball.corners)
    ball.corners = np.concatenate([ball.corners, [[0.1, 0.2, 0.3], [9, 9, 9]]])
    ball.normals = np.concatenate([ball.normals, [[0, 1, 0], [0, 0, 0]]])
    ball.uvs = None
    flat = np.array([[0, 0, 0], [1, 1, 2], [count, count, 3], [0, 0, 5]])
    ball.triangles = np.concatenate([flat, ball.triangles, flat])
    found, _ = shot(tmp_path / "littered", littered)
    np.testing.assert_array_equal(found, expected)


def test_duplicate_faces_change_nothing(tmp_path):
    """A second sheet in the same place blocks what the first blocks."""
    expected, _ = shot(tmp_path / "plain", scene_parts())
    doubled = scene_parts()
    for part in doubled.values():
        part.triangles = np.concatenate([part.triangles, part.triangles])
    found, _ = shot(tmp_path / "doubled", doubled)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_two_objects_in_one_place(tmp_path):
    """Which of the two is seen is open; with one material it does not matter, and neither shadows the other."""
    expected, _ = shot(tmp_path / "one", {"a": square(4, material=GREY)}, sky=WHITE)
    found, _ = shot(tmp_path / "two", {"a": square(4, material=GREY), "b": square(4, material=GREY)}, sky=WHITE)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_interpenetrating_objects(tmp_path):
    parts = scene_parts()
    parts["other"] = sphere(0.5, (0.3, 0.4, 0.2), rings=12, material=GREY)
    parts["sunk"] = sphere(1.0, (-0.5, -0.2, 0), rings=12, material=GREY)
    shot(tmp_path, parts)


def test_inconsistent_winding(tmp_path):
    """Every other triangle looks inwards, against its vertex normals. One-sided, those are black from outside, and the
    others as bright as before; what lies at their edges is between."""
    expected, _ = shot(tmp_path / "plain", scene_parts())
    mixed = scene_parts()
    for part in mixed.values():
        part.triangles = part.triangles.copy()
        part.triangles[::2] = part.triangles[::2, ::-1]
    found, _ = shot(tmp_path / "mixed", mixed)
    assert (found <= expected + 1e-5).all()
    assert 0 < found.sum() < expected.sum()
    shot(tmp_path / "both", mixed, two_sided=True)


def test_cameras_inside_and_away(tmp_path):
    inside = Camera("main", (0, 0.6, 0), (0, 0.6, 1), size=(8, 6))
    rgb, alpha = shot(tmp_path / "inside", scene_parts(), inside)
    assert (alpha == 1).all()
    assert (rgb == 0).all()  # backs of one-sided faces
    away = Camera("main", (0, 5, 0), (0, 9, 0.1), size=(8, 6))
    rgb, alpha = shot(tmp_path / "away", scene_parts(), away)
    assert (alpha == 0).all()
    assert (rgb == 0).all()


def hard_meshes(shared_data):
    folder = shared_data / "meshes" / "hard"
    skip = (".mtl", ".bin")
    return [path for path in sorted(folder.rglob("*")) if path.is_file() and path.suffix not in skip]


def hard_mesh(shared_data, tmp_path, monkeypatch, capsys, path, *more):
    """0 with a sane picture, or 2 with a message that names the file."""
    work = tmp_path / path.name
    work.mkdir()
    for beside in path.parent.glob("*.bin"):
        (work / beside.name).write_bytes(beside.read_bytes())
    (work / path.name).write_bytes(path.read_bytes())
    monkeypatch.chdir(work)
    scene = f'format = 1\n[objects.a]\nmesh = "{path.name}"\nmaterial = "m"\n[materials.m]\nmodel = "lambert"\n'
    (work / "scene.toml").write_text(scene)
    options = ["--light-resolution", "16", "--refine", "4", "--no-subdivide", "--workers", "1", "-q", *more]
    code = run(["precompute", "scene.toml", "-o", "t.zarr", *options])
    stderr = capsys.readouterr().err
    assert code in (0, 2), (path.name, stderr)
    if code == 2:
        assert path.name in stderr
        assert not list(work.glob("t.zarr*"))
        return code
    from relightcli.adapters.images import write_image

    write_image(work / "sky.exr", WHITE.astype(np.float32))
    assert run(["relight", "t.zarr", "-o", "out.zarr", "--env", "sky.exr", "-q"]) == 0
    import relight_formats as formats

    radiance = formats.open_store(work / "out.zarr").read("radiance")
    # Under a white sky no surface of albedo 0.5 is brighter than 0.5; quadrature as in the furnace above.
    need_sane(radiance, np.zeros(1), 0.5 * 1.01)
    return code


def test_hard_meshes(shared_data, tmp_path, monkeypatch, capsys):
    small = [path for path in hard_meshes(shared_data) if path.stat().st_size < 50_000]
    codes = [hard_mesh(shared_data, tmp_path, monkeypatch, capsys, path) for path in small]
    assert len(codes) > 40
    assert 0 < codes.count(2) < 15  # the empty ones, point clouds, and those of infinities


@pytest.mark.slow
def test_hard_meshes_large(shared_data, tmp_path, monkeypatch, capsys):
    for path in hard_meshes(shared_data):
        if path.stat().st_size >= 50_000:
            assert hard_mesh(shared_data, tmp_path, monkeypatch, capsys, path, "--bounces", "0") == 0
