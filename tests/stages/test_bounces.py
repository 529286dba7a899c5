"""Interreflections from end to end, against the path tracer and against themselves."""

from __future__ import annotations

import numpy as np
import pytest

import relight_formats as formats
from relightcli.core.measure.errors import relative_rmse
from relightcli.errors import StoreError
from relightcli.scene.model import Camera, Material
from relightcli.stages.relight import Config, relight
from tests.core.shade.skies import smooth_map
from tests.core.transport.scenes import Part, lambert, sphere, sphere_grid, square
from tests.core.transport.test_buried import box
from tests.stages.scene_files import make_store, read_layers, write_scene

CAMERA = Camera("main", (0.4, 1.3, 2.6), (0, 0.4, 0), fov=38, size=(64, 48))
GOLD = Material("m", "cook-torrance", (0.1, 0.06, 0.02), (0.85, 0.6, 0.22), f0=0.9, roughness=0.4)
LAMP = """
[lights.lamp]
shape = "sphere"
center = [0.9, 1.6, 0.9]
radius = 0.15
radiance = [6, 5, 3]
"""


def corner(material, flat):
    """A wall that stands on the ground, thick, so that its back does not matter."""
    part = square(3, material=material)
    part.corners = part.corners[:, [0, 2, 1]] * [1, -1, 1] + [0, 1.5, -0.8]
    part.normals = np.tile([0.0, 0.0, 1.0], (4, 1))
    part.texture = flat
    return part


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    tiles = np.kron(np.array([[0, 1], [1, 0]]), np.ones((4, 4)))[..., None] * [0.8, 0.3, 0.2] + 0.1
    parts = {
        "ground": square(3, material=lambert((0.6, 0.5, 0.4))),
        "wall": corner(lambert(1.0), tiles),
        "ball": sphere(0.4, (-0.5, 0.42, 0), rings=24, material=lambert((0.2, 0.5, 0.7))),
        "gold": sphere(0.35, (0.45, 0.36, 0.1), rings=24, material=GOLD),
    }
    rng = np.random.default_rng(0)
    maps = {"smooth": smooth_map(), "patchy": np.kron(rng.random((8, 16, 3)) ** 3, np.ones((4, 4, 1)))}
    folder = tmp_path_factory.mktemp("scene")
    return write_scene(folder, parts, [CAMERA], maps, adjustable=True, more=LAMP)


@pytest.fixture(scope="module")
def store(scene):
    return make_store(scene, workers=2, bounces=2)


def layers_of(store, name, **settings):
    output = store.parent / name
    settings = {"env": "smooth", "workers": 2, "layers": True, **settings}
    relight(Config(store=store, output=str(output), quiet=True, **settings))
    return read_layers(output)


NAMES = ("direct", "specular", "one_bounce", "two_bounce")
EDIT = ("ground.diffuse=0.2,0.6,0.3", "ball.diffuse=0.8,0.8,0.7", "gold.roughness=0.5", "gold.specular=0.5,0.7,0.9")


def test_what_memory_need_not_hold_is_read_again(store, monkeypatch):
    # Sums at a receiver have the same order, whatever part of the others it comes with.
    whole = layers_of(store, "whole.exr", settings=EDIT)
    monkeypatch.setattr("relightcli.stages.lighting.IN_MEMORY", 0)
    monkeypatch.setattr("relightcli.stages.lighting.ENTRIES", 1 << 17)
    parts = layers_of(store, "parts.exr", settings=EDIT)
    for name in NAMES:
        np.testing.assert_array_equal(parts[name], whole[name])


@pytest.mark.slow
@pytest.mark.parametrize("edit", [(), EDIT], ids=["as it is", "edited"])
def test_every_layer_against_the_path_tracer(store, edit):
    # Promised: 3 % relative RMS of the picture. Its noise comes from the variance layer and is taken off; that of the
    # single layers is not known, so their means are compared: at 3,072 pixels and 256 samples they are good to 0.5 %.
    a = layers_of(store, "a.exr", settings=edit)
    b = layers_of(store, "b.exr", settings=edit, reference=True, spp=256)
    assert set(a) == {"", "A", *NAMES} == set(b) - {"variance"}
    noise = np.sqrt(b["variance"].mean() / (b[""] ** 2).mean())
    assert noise < 0.03
    assert relative_rmse(a[""], b[""]) ** 2 - noise**2 < 0.03**2
    for name in NAMES:
        mean = b[name].mean((0, 1))
        assert mean.min() > 0.001
        np.testing.assert_allclose(a[name].mean((0, 1)), mean, rtol=0.03, err_msg=name)


def test_layers_add_up_and_so_do_bounces(store):
    layers = layers_of(store, "a.exr")
    parts = sum(layers[name] for name in NAMES)
    np.testing.assert_allclose(parts, layers[""], rtol=1e-5, atol=1e-6)
    plain = layers_of(store, "b.exr", layers=False)
    np.testing.assert_allclose(plain[""], layers[""], rtol=1e-4, atol=1e-5)
    fewer = layers_of(store, "c.exr", bounces=1)
    np.testing.assert_array_equal(fewer["one_bounce"], layers["one_bounce"])
    np.testing.assert_allclose(fewer[""] + layers["two_bounce"], layers[""], rtol=1e-4, atol=1e-5)
    none = layers_of(store, "d.exr", bounces=0)
    np.testing.assert_array_equal(none[""], layers["direct"] + layers["specular"])
    more = layers_of(store, "e.exr", bounces=4)
    assert set(more) == {"", "A", *NAMES, "three_bounce", "four_bounce"}
    assert 0 < more["four_bounce"].mean() < more["three_bounce"].mean() < more["two_bounce"].mean()


def test_one_bounce_is_of_first_and_two_of_second_degree_in_the_albedos(store):
    def white(albedo):
        names = ("ground", "wall", "ball", "gold")
        return (
            *(f"{name}.diffuse={albedo},{albedo},{albedo}" for name in names),
            "gold.specular=0,0,0",
        )

    one, half = (layers_of(store, f"{x}.exr", settings=white(x)) for x in (0.8, 0.4))
    for name, degree in (("direct", 1), ("one_bounce", 2), ("two_bounce", 3)):
        np.testing.assert_allclose(one[name], half[name] * 2**degree, rtol=1e-3, atol=1e-5)


def test_linear_in_the_light(store, scene):
    # The lamp shines on top of either sky: it is taken off first.
    dark = scene.parent / "dark.exr"
    from relightcli.adapters.images import read_image, write_image

    sky = {name: read_image(scene.parent / f"{name}-sky.exr").pixels for name in ("smooth", "patchy")}
    write_image(dark, np.zeros_like(sky["smooth"]))
    height = max(s.shape[0] for s in sky.values())
    grown = {n: np.kron(s, np.ones((height // s.shape[0],) * 2 + (1,))) for n, s in sky.items()}
    write_image(scene.parent / "sum.exr", (grown["smooth"] + 2 * grown["patchy"]).astype(np.float32))
    lamp = layers_of(store, "l.exr", env=str(dark))
    found = {name: layers_of(store, f"{name}.exr", env=name) for name in ("smooth", "patchy")}
    both = layers_of(store, "s.exr", env=str(scene.parent / "sum.exr"))
    for name in ("one_bounce", "two_bounce"):
        assert lamp[name].mean() > 0
        expected = found["smooth"][name] + 2 * found["patchy"][name] - 2 * lamp[name]
        # Sums below zero are cut off, which is not linear: a few vertices around the gold ball.
        assert relative_rmse(both[name], expected) < 2e-3


def test_reference_takes_the_stores_bounces(store):
    b = layers_of(store, "b.exr", reference=True, spp=2)
    assert {"direct", "one_bounce", "two_bounce"} <= set(b)


def test_vertices_and_radiance_stores_hold_the_sum(store):
    def total(**settings):
        output = store.parent / f"{len(settings)}.zarr"
        relight(Config(store=store, output=str(output), env="smooth", quiet=True, overwrite=True, **settings))
        return formats.open_store(output).read("radiance")[0]

    assert (total() >= total(bounces=0)).all()
    assert total().mean() > 1.05 * total(bounces=0).mean()


def test_a_texture_colours_what_it_reflects(scene, store):
    # The wall is red on black; its light reddens the grey ball more than a white wall's of the same brightness would.
    grey = ("ball.diffuse=0.5,0.5,0.5", "ground.diffuse=0,0,0", "gold.diffuse=0,0,0", "gold.specular=0,0,0")
    ball = layers_of(store, "a.exr", settings=grey)["one_bounce"]
    # The texture's mean, 0.5, 0.25, 0.2, is what a ball that sees all of it gets; the sky is close to grey.
    ratio = ball[..., 0].sum() / ball[..., 1].sum()
    assert 1.5 < ratio < 2.5


def test_convex_has_none(tmp_path):
    scene = write_scene(tmp_path, {"ball": sphere(rings=12)}, [CAMERA], {"sky": np.ones((4, 8, 3))})
    store = make_store(scene, bounces=2)
    assert "bounce/hit" not in formats.open_store(store)
    layers = layers_of(store, "a.exr", env="sky", bounces=2)
    assert not layers["one_bounce"].any()
    assert layers["direct"].any()


def test_white_box_stays_bounded(tmp_path):
    # Albedo 1 in a closed box with a lamp: every interreflection keeps all the light, none adds any.
    corners, triangles = sphere_grid(16, 32)
    part = sphere(rings=16, material=lambert(1.0))
    part.corners, part.triangles, part.normals = corners, triangles[:, ::-1], -corners
    camera = Camera("main", (0, 0, 0.5), (0, 0, -1), fov=60, size=(16, 16))
    lamp = "[lights.lamp]\nshape = 'sphere'\ncenter = [0, 0.2, 0]\nradius = 0.05\nradiance = [10, 10, 10]\n"
    scene = write_scene(tmp_path, {"room": part}, [camera], {"sky": np.zeros((4, 8, 3))}, more=lamp)
    store = make_store(scene, bounces=8)
    layers = layers_of(store, "a.exr", env="sky")
    means = [layers[name].mean() for name in ("direct", "one_bounce", "two_bounce", "four_bounce", "bounce_8")]
    assert means[0] > 0
    # Inside a ball one interreflection spreads the light evenly; 4 % a bounce is the horizon of its 16 rings.
    for k, earlier, later in ((1, *means[:2]), (1, *means[1:3]), (2, *means[2:4]), (4, *means[3:5])):
        assert earlier * 0.93**k < later < earlier * 1.07


@pytest.mark.parametrize("roughness", [0.005, 1.0])
@pytest.mark.parametrize("f0", [0.0, 1.0])
def test_extreme_materials(store, roughness, f0):
    edit = (f"gold.roughness={roughness}", f"gold.f0={f0}", "gold.specular=1,1,1")
    layers = layers_of(store, "a.exr", settings=edit)
    for name in ("one_bounce", "two_bounce"):
        assert np.isfinite(layers[name]).all()
        assert layers[name].min() >= 0
        # No more than a white world would send: the sky and the lamp are below 10.
        assert layers[name].max() < 10


@pytest.mark.slow
def test_mirrors_neither_make_nor_lose_light(tmp_path):
    # A closed box of mirrors with a lamp, against the path tracer: the picture's sharpness is lost, not its light.
    # Means of whole layers; 4,096 samples on 256 pixels leave them uncertain by less than 1 %.
    material = Material("m", "cook-torrance", (0.1, 0.1, 0.1), (0.8, 0.8, 0.8), f0=1.0, roughness=0.1)
    walls = box((-1, -1, -1), (1, 1, 1), 10)
    start = np.cumsum([0] + [len(p) for p, _ in walls])
    corners = np.concatenate([p for p, _ in walls])
    triangles = np.concatenate([f[:, ::-1] + s for (_, f), s in zip(walls, start[:-1], strict=True)])
    room = Part(corners, triangles, material=material)
    camera = Camera("main", (0.2, 0.1, 0.9), (0, 0, -1), fov=80, size=(16, 16))
    lamp = "[lights.lamp]\nshape = 'sphere'\ncenter = [0.1, 0.3, 0]\nradius = 0.2\nradiance = [10, 10, 10]\n"
    scene = write_scene(tmp_path, {"room": room}, [camera], {"sky": np.zeros((4, 8, 3))}, more=lamp)
    truth = {}
    for cells in (8, 16, 32):
        store = make_store(scene, f"{cells}.zarr", bounces=3, bounce_resolution=cells, workers=2)
        truth = truth or layers_of(store, "b.exr", env="sky", reference=True, spp=4096)
        found = layers_of(store, f"{cells}.exr", env="sky")
        for name in (*NAMES, "three_bounce"):
            # At 8 cells a side the lamp's reflection in a wall is smaller than a cell.
            bound = 0.12 if cells == 8 else 0.03
            assert found[name].mean() == pytest.approx(truth[name].mean(), rel=bound), (cells, name)


def test_a_store_without_shadows_knows_of_no_interreflections(scene, tmp_path):
    store = make_store(scene, "plain.zarr", effects="direct", light_resolution=16, refine=2)
    with pytest.raises(StoreError, match="holds direct light only"):
        layers_of(store, "a.exr", bounces=1)


def test_two_sided_and_translucent(tmp_path):
    screen = square(1.5, 0.6, material=Material("m", "translucent", (0.3, 0.3, 0.3), transmittance=(0.5, 0.2, 0.2)))
    screen.two_sided = True
    parts = {"ground": square(3, material=lambert(0.7)), "screen": screen}
    low = Camera("main", (0, 0.3, 2.5), (0, 0.4, 0), fov=40, size=(48, 32))
    scene = write_scene(tmp_path, parts, [low], {"sky": smooth_map()})
    store = make_store(scene, bounces=2, workers=2)
    a = layers_of(store, "a.exr", env="sky")
    b = layers_of(store, "b.exr", env="sky", reference=True, spp=256)
    for name in ("direct", "one_bounce", "two_bounce"):
        np.testing.assert_allclose(a[name].mean((0, 1)), b[name].mean((0, 1)), rtol=0.04, err_msg=name)


def test_picture_without_lobes_needs_no_camera_for_vertices(tmp_path):
    parts = {"ground": square(2, material=lambert(0.7)), "ball": sphere(0.4, (0, 0.5, 0), rings=8)}
    scene = write_scene(tmp_path, parts, [], {"sky": np.ones((4, 8, 3))})
    store = make_store(scene, bounces=1)
    relight(Config(store=store, output=str(tmp_path / "a.ply"), quiet=True))
    assert (tmp_path / "a.ply").stat().st_size > 1000
