"""Skies and reflectances at their extremes, through the whole chain: finite, not negative, linear, within bounds."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.adapters.images import write_image
from relightcli.cli.main import run
from relightcli.scene.model import Camera, Material
from tests.core.transport.scenes import lambert, sphere, square
from tests.stages.scene_files import make_store, picture, write_scene

CAMERA = Camera("main", (0.0, 1.2, 3.0), (0.0, 0.4, 0.0), fov=35, size=(24, 16))
GREY = lambert(0.5)
MODELS = ("blinn-phong", "cook-torrance", "phong")


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A shiny ball per model on a grey floor, adjustable."""
    parts = {"floor": square(4, material=GREY)}
    for k, model in enumerate(MODELS):
        material = Material(model, model, diffuse=(0.3, 0.3, 0.3), specular=(0.5, 0.5, 0.5))
        parts[model] = sphere(0.3, (0.7 * (k - 1), 0.4, 0), rings=10, material=material)
    scene = write_scene(tmp_path_factory.mktemp("hard"), parts, [CAMERA], {"sky": np.ones((4, 8, 3))}, adjustable=True)
    return make_store(scene, light_resolution=16, subdivide=False)


def lit(store, sky, **settings):
    path = store.parent / "test-sky.exr"
    write_image(path, np.asarray(sky, np.float32))
    rgb, _ = picture(store, env=str(path), **settings)
    assert np.isfinite(rgb).all()
    assert rgb.min() >= 0
    return rgb.astype(np.float64)


def one_texel(row, column, value, base=0.0, shape=(16, 32)):
    sky = np.full((*shape, 3), base)
    sky[row, column] = value
    return sky


def test_black(store):
    assert (lit(store, np.zeros((4, 8, 3))) == 0).all()


def test_one_pixel_map_is_the_constant_map(store):
    """Both say the same; 1e-5 is what the cube transfer promises for the power."""
    np.testing.assert_allclose(lit(store, np.ones((1, 1, 3))), lit(store, np.ones((16, 32, 3))), rtol=1e-3, atol=1e-5)


def test_constant_sky_gives_lambert_its_albedo_where_nothing_blocks(store, tmp_path):
    parts = {"floor": square(4, material=GREY)}
    scene = write_scene(tmp_path, parts, [Camera("main", (0, 3, 0.1), (0, 0, 0), fov=20, size=(8, 8))], {})
    rgb = lit(make_store(scene, light_resolution=16, subdivide=False), np.ones((1, 1, 3)))
    np.testing.assert_allclose(rgb, 0.5, rtol=0.01)  # a clamped cosine over 16 texels a side: 1 % at worst


@pytest.mark.parametrize("value", [1e-30, 1e-6, 1e6, 1e30])
def test_light_is_linear_in_brightness(store, value):
    """Single precision scales every step alike: 1e-4 covers its rounding. (1e-30 to 1e30 are inside float32.)"""
    sky = np.random.default_rng(1).random((8, 16, 3)) + 0.1
    np.testing.assert_allclose(lit(store, sky * value) / value, lit(store, sky), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("row", "column"), [(0, 0), (0, 31), (3, 5), (7, 16), (8, 0), (15, 7)])
def test_one_texel_sun(store, row, column):
    """1e6 beside a sky of 1e-3, at poles and seams. Superposition: the sun and the sky apart add up to both."""
    both = lit(store, one_texel(row, column, 1e6, 1e-3))
    sun, sky = lit(store, one_texel(row, column, 1e6)), lit(store, one_texel(row, column, 1e-3, 1e-3))
    # Relative to the brightest pixel: float32 pictures keep 2^-24 of each value, sums lose some digits more.
    np.testing.assert_allclose(both, sun + sky, rtol=1e-3, atol=1e-6 * max(1.0, sun.max()))
    if row == 15:  # a sun below the ground lights nothing on the floor, and balls only through what the floor leaves
        assert sun.max() < lit(store, one_texel(3, column, 1e6)).max()


def test_texels_at_the_poles_count_by_their_solid_angle(store):
    """A whole row at the zenith is one small cap: less power than a row at 45 degrees, by cos and by solid angle."""
    top, middle = np.zeros((16, 32, 3)), np.zeros((16, 32, 3))
    top[0], middle[3] = 1.0, 1.0
    assert 0 < lit(store, top).mean() < lit(store, middle).mean()


def test_negative_pixels_are_taken_as_black(store, capsys):
    negative = one_texel(3, 5, -1e6, 1.0)
    np.testing.assert_array_equal(lit(store, negative), lit(store, one_texel(3, 5, 0.0, 1.0)))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_pixels_that_are_no_light_are_refused(store, capsys, value):
    path = store.parent / "broken.exr"
    write_image(path, one_texel(3, 5, value).astype(np.float32))
    for more in ([], ["--reference", "--spp", "2"]):
        output = store.parent / "broken-out.exr"
        assert run(["relight", str(store), "-o", str(output), "--env", str(path), *more]) == 2
        assert "expected finite radiance" in capsys.readouterr().err
        assert not output.exists()


SKIES = {"even": np.ones((4, 8, 3)), "sun": one_texel(3, 5, 1e6, 1e-3)}
EXTREMES = [
    ("cook-torrance", "roughness", 1e-4),
    ("cook-torrance", "roughness", 1.0),
    ("cook-torrance", "roughness", 10.0),
    ("cook-torrance", "f0", 0.0),
    ("cook-torrance", "f0", 1.0),
    ("blinn-phong", "shininess", 0.0),
    ("blinn-phong", "shininess", 1e6),
    ("phong", "shininess", 0.0),
    ("phong", "shininess", 1e6),
]


@pytest.mark.parametrize("sky", SKIES)
@pytest.mark.parametrize(("model", "parameter", "value"), EXTREMES)
def test_reflectances(store, model, parameter, value, sky):
    """No NaN, nothing negative, and no more than 2 times the brightest of the sky: diffuse 0.3 and specular 0.5 give
    0.8 at most where the lobe keeps its energy; Blinn-Phong and Phong gain towards grazing views."""
    rgb = lit(store, SKIES[sky], settings=(f"{model}.{parameter}={value}",))
    assert rgb.max() < 2.0 * SKIES[sky].max()


@pytest.mark.parametrize("sky", SKIES)
@pytest.mark.parametrize(("model", "parameter", "value"), EXTREMES)
def test_reflectances_by_the_reference(store, model, parameter, value, sky):
    """The same of path tracing. Two interreflections give 0.8 of what they get again: 1 + 0.8 + 0.64 times as much. Of
    the sun a sample holds its radiance times the lobe, which may be as high as one likes: no bound is asked there."""
    rgb = lit(store, SKIES[sky], settings=(f"{model}.{parameter}={value}",), reference=True, spp=8, bounces=2)
    if sky == "even":
        assert rgb.max() < 2.0 * (1 + 0.8 + 0.64)


@pytest.mark.parametrize("model", MODELS)
def test_specular_light_is_linear_and_non_negative_at_grazing(tmp_path, model):
    """A camera that skims a shiny plane: angles of a degree and less."""
    material = Material("m", model, diffuse=(0.1, 0.1, 0.1), specular=(0.9, 0.9, 0.9))
    camera = Camera("main", (0, 0.01, 2), (0, 0.0, 0), fov=5, size=(8, 8))
    scene = write_scene(tmp_path, {"floor": square(4, material=material)}, [camera], {})
    store = make_store(scene, light_resolution=16, subdivide=False)
    sky = np.random.default_rng(1).random((8, 16, 3))
    one = lit(store, sky)
    assert one.max() > 0
    np.testing.assert_allclose(lit(store, 4 * sky), 4 * one, rtol=1e-4, atol=1e-6)
