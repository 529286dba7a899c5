"""relight: against the path tracer, and every kind of output."""

from __future__ import annotations

import os

import numpy as np
import pytest

import relight_formats as formats
from relightcli.adapters.flip import flip_hdr
from relightcli.adapters.images import read_image, write_image
from relightcli.core.brdf.models import evaluate_many, pack_materials
from relightcli.core.measure.errors import relative_rmse
from relightcli.errors import InputError, NumericalError, StoreError
from relightcli.scene.model import Camera, Material
from relightcli.stages.outputs import numbered
from relightcli.stages.relight import Config, relight
from tests.core.shade.skies import smooth_map
from tests.core.transport.scenes import lambert, sphere, square
from tests.stages.scene_files import make_store, picture, read_layers, write_scene

CAMERA = Camera("main", (0.5, 1.6, 3), (0, 0.35, 0), fov=38, size=(64, 48))
SIDE = Camera("side", (3, 0.8, 0), (0, 0.3, 0), fov=30, size=(24, 24))
GOLD = Material("m", "cook-torrance", (0.1, 0.06, 0.02), (0.85, 0.6, 0.22), f0=0.9, roughness=0.3)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    parts = {
        "ground": square(3, material=lambert((0.5, 0.4, 0.3))),
        "ball": sphere(0.45, (-0.5, 0.5, 0), rings=20, material=lambert((0.2, 0.5, 0.7))),
        "gold": sphere(0.4, (0.5, 0.45, 0.2), rings=20, material=GOLD),
    }
    rng = np.random.default_rng(0)
    maps = {"smooth": smooth_map(), "patchy": np.kron(rng.random((8, 16, 3)) ** 3, np.ones((4, 4, 1)))}
    return write_scene(tmp_path_factory.mktemp("scene"), parts, [CAMERA, SIDE], maps, adjustable=True)


@pytest.fixture(scope="module")
def store(scene):
    return make_store(scene, workers=2)


def run(store, output, **settings):
    return relight(Config(store=store, output=str(output), quiet=True, **{"workers": 1, "env": "smooth", **settings}))


@pytest.mark.parametrize("receivers", ["vertices", "pixels:main"])
def test_against_the_path_tracer(scene, store, tmp_path, receivers):
    # Promised: 2 % relative RMS under a smooth sky, and FLIP 0.03. The path tracer's own error is known from its
    # variance and independent: its square is taken off (1.5 % at 256 samples).
    made = store if receivers == "vertices" else make_store(scene, "pixels.zarr", receivers=receivers, workers=2)
    run(made, tmp_path / "a.exr")
    run(store, tmp_path / "b.exr", reference=True, spp=256, workers=2)
    a, b = read_layers(tmp_path / "a.exr"), read_layers(tmp_path / "b.exr")
    noise = np.sqrt(b["variance"].mean() / (b[""] ** 2).mean())
    assert noise < 0.02
    assert relative_rmse(a[""], b[""]) ** 2 - noise**2 < 0.02**2
    assert flip_hdr(a[""], b[""]).mean() < 0.03
    assert np.abs(a["A"] - b["A"]).mean() < 5e-3


def test_reference_of_scene_file_and_of_store_are_the_same_picture(scene, store, tmp_path):
    run(store, tmp_path / "a.exr", reference=True, spp=16, camera="side", bounces=1, layers=True)
    run(scene, tmp_path / "b.exr", reference=True, spp=16, camera="side", bounces=1, layers=True, workers=2)
    a, b = read_layers(tmp_path / "a.exr"), read_layers(tmp_path / "b.exr")
    # The store's faces are cut, which moves hit points by roundings; random numbers are the same.
    np.testing.assert_allclose(a["A"], b["A"], atol=1e-3)
    assert relative_rmse(a[""], b[""]) < 0.05
    np.testing.assert_allclose(b["direct"] + b["specular"] + b["one_bounce"], b[""], rtol=2e-3, atol=1e-4)
    assert b["one_bounce"].max() > 0.01
    assert not list(tmp_path.glob("*.samples*"))


@pytest.mark.parametrize("background", [False, True])
def test_layers_add_up_to_the_beauty(store, tmp_path, background):
    run(store, tmp_path / "a.exr", layers=True, background=background)
    layers = read_layers(tmp_path / "a.exr")
    parts = [rgb for name, rgb in layers.items() if name not in ("", "A")]
    assert set(layers) == {"", "A", "direct", "specular"} | ({"background"} if background else set())
    np.testing.assert_allclose(sum(parts), layers[""], rtol=1e-5, atol=1e-6)
    if background:
        assert (layers["A"] == 1).all()


def test_background_is_the_environment_where_nothing_stands(store):
    plain, alpha = picture(store, "plain.exr", env="smooth")
    behind, _ = picture(store, "behind.exr", env="smooth", background=True)
    assert alpha.min() == 0
    assert alpha.max() == 1
    assert not plain[alpha == 0].any()
    np.testing.assert_array_equal(plain[alpha == 1], behind[alpha == 1])
    assert behind[alpha == 0].min() > 0.05


def test_rotating_the_map_is_rotating_the_environment(scene, store, tmp_path):
    # A map shifted by a quarter of its columns is the same environment turned: left is towards larger longitudes.
    pixels = read_image(scene.parent / "patchy-sky.exr").pixels
    write_image(tmp_path / "shifted.exr", np.roll(pixels, -pixels.shape[1] // 4, axis=1))
    a, _ = picture(store, "a.exr", env="patchy", env_rotate=90.0)
    b, _ = picture(store, "b.exr", env=str(tmp_path / "shifted.exr"))
    c, _ = picture(store, "c.exr", env="patchy")
    np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)
    assert relative_rmse(c, a) > 0.02


def test_set_changes_materials(store):
    a, _ = picture(store, "a.exr", env="smooth")
    b, _ = picture(
        store, "b.exr", env="smooth", settings=("ground.diffuse=0.25,0.2,0.15", "ball.diffuse=0.1,0.25,0.35")
    )
    gold, _ = picture(store, "g.exr", env="smooth", settings=("gold.diffuse=0,0,0", "gold.specular=0,0,0"))
    # Halving the albedo halves the radiance; what is left of the gold ball without a colour is nothing.
    lambert_only = gold.max(axis=2) > 0
    ratio = (
        b[lambert_only & (np.abs(gold - a).max(axis=2) == 0)] / a[lambert_only & (np.abs(gold - a).max(axis=2) == 0)]
    )
    np.testing.assert_allclose(ratio, 0.5, rtol=2e-3)
    assert (gold.max(axis=2) == 0).sum() > (a.max(axis=2) == 0).sum() + 50


@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".tif", ".png", ".jpg"])
def test_picture_formats(store, tmp_path, suffix):
    truth, _ = picture(store, "truth.exr", env="smooth", camera="side")
    run(store, tmp_path / f"a{suffix}", camera="side", exposure=-1.0 if suffix in (".png", ".jpg") else 0.0)
    image = read_image(tmp_path / f"a{suffix}")
    assert image.pixels.shape[:2] == (24, 24)
    found = image.pixels[..., :3]
    if suffix in (".png", ".jpg"):
        assert image.display
        # 8 bits of sRGB, and JPEG's own loss.
        assert np.abs(found - np.clip(0.5 * truth, 0, 1)).mean() < 0.02
    else:
        np.testing.assert_allclose(found, truth, atol=0.01 * truth.max())  # shared exponent, half


def test_exr_says_what_made_it(store, tmp_path):
    run(store, tmp_path / "a.exr", env_rotate=30.0, settings=("ball.diffuse=0.1,0.1,0.1",), camera="side")
    header = read_image(tmp_path / "a.exr").metadata
    assert header["relight:store_fingerprint"] == formats.open_store(store, "transfer").fingerprint
    assert header["relight:environment"].endswith("smooth-sky.exr")
    assert header["relight:env_rotate"] == pytest.approx(30.0)
    assert header["relight:camera"] == "side"
    assert header["relight:set"] == "ball.diffuse=0.1,0.1,0.1"


def test_ply_has_the_faces_of_the_meshes(store, tmp_path):
    import trimesh

    run(store, tmp_path / "a.ply")
    mesh = trimesh.load(tmp_path / "a.ply", process=False)
    # Each ball of 20 rings and 40 columns has 1600 triangles, 80 of them without area, at the poles; the ground has 2,
    # however precompute has cut it.
    assert len(mesh.faces) == 2 + 2 * (1600 - 80)
    assert len(mesh.visual.vertex_colors) == len(mesh.vertices)
    assert mesh.visual.vertex_colors[:, :3].max() > 100


def test_radiance_store(scene, store, tmp_path):
    run(store, tmp_path / "a.zarr")
    found = formats.open_store(tmp_path / "a.zarr", "radiance")
    radiance = found.read("radiance")
    assert radiance.shape[0] == 1
    assert radiance.shape[1:] == (len(found.read("receivers/position")), 3)
    assert (radiance >= 0).all()
    root = tmp_path / "a.zarr" / "zarr.json"
    os.utime(root, (0, 0))
    assert run(store, tmp_path / "a.zarr")["status"] == "up to date"
    assert root.stat().st_mtime > 0  # refreshed, for Make
    with pytest.raises(StoreError):
        run(store, tmp_path / "a.zarr", env_rotate=5.0)
    with pytest.raises(StoreError):
        run(store, tmp_path / "a.zarr", env="patchy")
    # Another sky under the same name is another input.
    sky = tmp_path / "own.exr"
    write_image(sky, smooth_map())
    run(store, tmp_path / "b.zarr", env=str(sky))
    write_image(sky, smooth_map() * np.float32(2))
    with pytest.raises(StoreError):
        run(store, tmp_path / "b.zarr", env=str(sky))
    run(store, tmp_path / "b.zarr", env=str(sky), overwrite=True)
    np.testing.assert_allclose(
        formats.open_store(tmp_path / "b.zarr", "radiance").read("radiance"), 2 * radiance, rtol=1e-5
    )


def test_sequence(store, tmp_path):
    shots = tmp_path / "shots.toml"
    shots.write_text(
        "format = 1\nframes = 3\nfirst = 9\n"
        "[[key]]\nframe = 9\nenv = 'patchy'\nenv_rotate = 0\nset = { 'ball.diffuse' = [0, 0, 0] }\n"
        "[[key]]\nframe = 11\nenv_rotate = 180\nset = { 'ball.diffuse' = [1, 1, 1] }\n"
    )
    result = run(store, tmp_path / "out.####.exr", frames=shots, camera="side")
    names = [str(tmp_path / f"out.{n:04d}.exr") for n in (9, 10, 11)]
    assert result["output"] == names
    assert len(result["frame_seconds"]) == 3
    single, _ = picture(
        store, "one.exr", env="patchy", env_rotate=90.0, settings=("ball.diffuse=0.5,0.5,0.5",), camera="side"
    )
    np.testing.assert_array_equal(read_layers(names[1])[""], single)
    result = run(store, tmp_path / "seq.zarr", frames=shots)
    assert formats.open_store(tmp_path / "seq.zarr", "radiance").read("radiance").shape[0] == 3


def test_frames_do_not_depend_on_threads_or_on_their_neighbours(store):
    a, _ = picture(store, "a.exr", env="patchy", workers=1)
    b, _ = picture(store, "b.exr", env="patchy", workers=3)
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("pattern", "name"),
    [("a.####.exr", "a.0012.exr"), ("a#.exr", "a12.exr"), ("####/a_##.exr", "####/a_12.exr"), ("#a##.exr", "#a12.exr")],
)
def test_frame_numbers(pattern, name):
    assert numbered(pattern, 12) == name


@pytest.mark.parametrize(
    ("output", "change", "error", "message"),
    [
        ("a.gif", {}, InputError, "expected a name ending in"),
        ("a.exr", {"env": None}, InputError, r"--env is needed: .* \(smooth, patchy\)"),
        ("a.exr", {"env": "dawn"}, InputError, "--env dawn: no such file.*smooth, patchy"),
        ("a.exr", {"camera": "top"}, InputError, "--camera top: not in the scene; it has main, side"),
        ("a.exr", {"env_rotate": float("nan")}, InputError, "finite"),
        ("a.exr", {"bounces": 2}, StoreError, "holds direct light only; precompute with --bounces"),
        ("a.exr", {"basis": "haar"}, StoreError, "precompute it with --basis haar"),
        ("a.exr", {"settings": ("silver.f0=1",)}, InputError, "no material 'silver'"),
        ("a.exr", {"settings": ("gold.f0=2",)}, InputError, "f0"),
        ("a.png", {"layers": True}, InputError, "--layers: expected an .exr"),
        ("a.ply", {"reference": True}, InputError, "--reference makes pictures"),
        ("a.exr", {"frames": "shots.toml"}, InputError, "needs ####"),
    ],
    ids=str,
)
def test_refusals(store, tmp_path, output, change, error, message):
    with pytest.raises(error, match=message):
        run(store, tmp_path / output, **change)
    assert not (tmp_path / output).exists()


def test_pixel_stores_have_one_camera(scene, tmp_path):
    store = make_store(scene, "one.zarr", receivers="pixels:side", light_resolution=16, refine=2)
    with pytest.raises(StoreError, match="pixels of camera 'side'"):
        run(store, tmp_path / "a.exr", camera="main")
    shots = tmp_path / "shots.toml"
    shots.write_text('format = 1\nframes = 2\n[[key]]\nframe = 1\ncamera = "side"\n[[key]]\nframe = 2\ncamera = "main"')
    with pytest.raises(StoreError, match=r"shots\.toml: frame 2: .*pixels of camera 'side'"):
        run(store, tmp_path / "a.#.exr", frames=shots)
    assert not list(tmp_path.glob("a.*.exr"))
    with pytest.raises(StoreError, match="not vertices"):
        run(store, tmp_path / "a.ply")


@pytest.mark.parametrize("reference", [False, True])
def test_a_dry_run_predicts_and_leaves_nothing(store, tmp_path, reference):
    told = run(store, tmp_path / "a.exr", reference=reference, spp=64, dry_run=True)
    assert told["frames"][0]["output"] == str(tmp_path / "a.exr")
    assert told["predicted"]["seconds"] > 0
    assert not list(tmp_path.iterdir())


def test_tolerance_of_a_reference_is_its_noise(store, tmp_path):
    with pytest.raises(NumericalError, match=r"the noise is .* at 4 samples .*; --spp \d+ should do; nothing was"):
        run(store, tmp_path / "a.exr", reference=True, spp=4, tolerance=0.01, camera="side")
    assert not (tmp_path / "a.exr").exists()
    run(store, tmp_path / "a.exr", reference=True, spp=4, tolerance=0.9, camera="side", overwrite=True)
    with pytest.raises(InputError, match="--tolerance: expected a number above 0"):
        run(store, tmp_path / "a.exr", tolerance=float("nan"))
    assert any("was not measured" in note for note in run(store, tmp_path / "a.exr", tolerance=0.1)["notes"])


def test_from_an_earlier_run_of_a_store_without_clusters_is_a_note(scene, store, tmp_path):
    run(store, tmp_path / "a.zarr")
    told = run(store, tmp_path / "a.exr", previous=tmp_path / "a.zarr")
    assert any("All of it was computed" in note for note in told["notes"])
    run(store, tmp_path / "b.exr")
    np.testing.assert_array_equal(*(read_image(tmp_path / f"{n}.exr").pixels for n in "ab"))
    other = make_store(scene, "other.zarr", light_resolution=16, refine=2, subdivide=False)
    with pytest.raises(StoreError, match="was not made from"):
        run(other, tmp_path / "a.exr", previous=tmp_path / "a.zarr")


def test_not_a_store(tmp_path):
    for path in (tmp_path / "none.zarr", tmp_path):
        with pytest.raises(StoreError):
            run(path, tmp_path / "a.exr")


@pytest.mark.parametrize("model", ["cook-torrance", "blinn-phong", "phong"])
def test_highlights_on_two_large_faces_that_nothing_shadows(tmp_path, model):
    """A sun of one texel over a ground of two faces, against the reflectance itself."""
    gloss = Material("gloss", model, (0.1, 0.1, 0.1), (0.5, 0.5, 0.5), f0=0.5, roughness=0.3, shininess=20.0)
    camera = Camera("main", (0.3, 2.0, 3.0), (0.0, 0.0, 0.0), fov=1.0, size=(2, 2))
    sun = np.zeros((32, 64, 3), np.float32)
    sun[6, 1] = 1000.0
    scene = write_scene(tmp_path, {"ground": square(50.0, material=gloss)}, [camera], {"sun": sun})
    store = make_store(scene, "t.zarr", light_resolution=16, refine=4)
    run(store, tmp_path / "a.exr", env="sun")
    found = read_layers(tmp_path / "a.exr")[""].mean(axis=(0, 1))
    longitude, latitude = np.pi * (1 - 2 * 1.5 / 64), np.pi * (0.5 - 6.5 / 32)
    to_sun = [np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)]
    omega = 2 * np.pi / 64 * (np.sin(np.pi * (0.5 - 6 / 32)) - np.sin(np.pi * (0.5 - 7 / 32)))
    view = np.array(camera.eye) / np.linalg.norm(camera.eye)
    normal = np.array([0.0, 1.0, 0.0])
    f = evaluate_many(pack_materials([gloss]), np.array(0), np.full(3, 0.1), normal, np.array(to_sun), view)
    # The texel of 5.6 degrees is not a point: f is off its mean by the second derivative, (0.05 / 0.3)^2 / 6 = 0.5 %
    # a side; interpolation adds 2 % at most (core.transport.smooth_cuts). Without cuts it is off by half.
    np.testing.assert_allclose(found, f * omega * 1000.0, rtol=0.03)
