"""What the path tracer promises beside its expected value: layers, alpha, cuts, symmetries, surfaces."""

import math

import numpy as np
import pytest

from relightcli.core.lights.latlong import make_latlong
from relightcli.core.transport.path_tracer import BATCH, resolve, split_samples, trace_rows
from relightcli.scene.model import Camera, Material, RectangleLight, SphereLight
from tests.core.transport.scenes import (
    Part,
    at_point,
    build,
    lambert,
    looking_down,
    mean_and_error,
    render,
    sphere,
    square,
)

RNG = np.random.default_rng(0)
SKY = RNG.random((8, 16, 3))
LIGHTS = [
    SphereLight("s", (1, 2, 1), 0.3, (5, 4, 3)),
    RectangleLight("r", (-1, 2, 0), (0.5, 0, 0), (0, 0, 1), (2, 3, 4)),
]
CAMERA = Camera("c", (0, 1, 4), (0, 0.3, 0), fov=40, size=(24, 16))


def still_life():
    return [
        square(4, -1.0, material=lambert((0.6, 0.5, 0.4))),
        sphere(
            0.7, (-0.7, -0.3, 0), rings=16, material=Material("g", "cook-torrance", (0.1, 0.1, 0.1), (0.9, 0.8, 0.5))
        ),
        sphere(
            0.5, (0.8, -0.5, 0.4), rings=16, material=Material("b", "blinn-phong", (0.4, 0.1, 0.1), (0.4, 0.4, 0.4))
        ),
    ]


def tile_of(rows=(0, 16), passes=(0, 2), per_pass=4, bounces=1, seed=0, lights=(), background=False):
    scene, tracer = build(still_life(), lights)
    return trace_rows(scene, tracer, make_latlong(SKY), CAMERA, rows, passes, per_pass, bounces, seed, background)


def test_cuts_into_rows_and_passes_change_nothing():
    whole = tile_of(passes=(0, 4))
    rows = [tile_of(rows=r, passes=(0, 4)) for r in ((0, 5), (5, 6), (6, 16))]
    np.testing.assert_array_equal(np.concatenate([t.layers for t in rows], axis=1), whole.layers)
    np.testing.assert_array_equal(np.concatenate([t.squares for t in rows]), whole.squares)
    np.testing.assert_array_equal(np.concatenate([t.alpha for t in rows]), whole.alpha)
    halves = tile_of(passes=(0, 1)) + tile_of(passes=(1, 4))
    # The same numbers added in another order.
    np.testing.assert_allclose(halves.layers, whole.layers, rtol=1e-14)
    assert halves.passes == whole.passes
    assert sum(t.rays for t in rows) == whole.rays


def test_batches_change_nothing(monkeypatch):
    whole = tile_of()
    monkeypatch.setattr("relightcli.core.transport.path_tracer.BATCH", 100)
    np.testing.assert_array_equal(tile_of().layers, whole.layers)
    assert BATCH > 100


def test_seeds_and_passes_are_different_samples():
    first, second, other = tile_of(passes=(0, 1)), tile_of(passes=(1, 2)), tile_of(passes=(0, 1), seed=1)
    assert (first.layers != second.layers).any()
    assert (first.layers != other.layers).any()


@pytest.mark.parametrize("lights", [(), LIGHTS], ids=["sky", "lights"])
def test_layers_do_not_depend_on_later_bounces(lights):
    few, many = tile_of(bounces=1, lights=lights), tile_of(bounces=3, lights=lights)
    np.testing.assert_array_equal(few.layers, many.layers[[0, 1, 4]])  # the last is of specular lobes


def test_layers_add_up_to_the_beauty_exactly():
    picture = resolve(tile_of(bounces=2, background=True))
    assert picture.layers.shape == (5, 16, 24, 3)
    total = np.zeros_like(picture.beauty)
    for layer in picture.layers:
        total += layer
    np.testing.assert_array_equal(total, picture.beauty)


def test_background_is_the_environment_behind_what_is_not_covered():
    camera = Camera("c", (0, 0, 3), (0, 0, 0), fov=90, size=(16, 16))
    sky = np.full((1, 1, 3), [1.0, 2.0, 3.0])
    picture = render([sphere(material=lambert(0.0), rings=16)], camera, sky, background=True)
    expected = (1 - picture.alpha)[..., None] * np.array([1, 2, 3], np.float32)
    np.testing.assert_allclose(picture.beauty, expected, atol=1e-6)
    without = render([sphere(material=lambert(0.0), rings=16)], camera, sky)
    assert not without.beauty.any()
    np.testing.assert_array_equal(without.alpha, picture.alpha)


def test_background_of_an_empty_view_is_the_box_filtered_map():
    # A narrow camera inside one texel sees its radiance, at the place that the lat-long convention names.
    camera = Camera("c", (0, 50, 0), (1, 50.1, 0), fov=1, size=(2, 2))
    pixels = np.zeros((4, 8, 3))
    pixels[1, 1] = pixels[1, 2] = 7  # longitudes 45 to 135 degrees, latitudes 0 to 45
    picture = render([square(0.1)], camera, pixels, background=True, spp=16)
    assert (picture.beauty == 7).all()
    assert not picture.alpha.any()


def test_alpha_is_coverage():
    # The square's side is 0.3 of the view's: the middle pixels of 10 x 10 are covered, 9 % of the area.
    picture = render([square(0.3)], looking_down((10, 10)), spp=256)
    expected = np.zeros((10, 10))
    # The square reaches from 3.5 to 6.5 pixels: halves at the edges, quarters at the corners.
    profile = np.array([0, 0, 0, 0.5, 1, 1, 0.5, 0, 0, 0])
    expected = np.outer(profile, profile)
    # A stratified estimate of an area by 256 points.
    np.testing.assert_allclose(picture.alpha, expected, atol=0.02)


def test_radiance_is_associated_with_alpha():
    picture = render([square(0.3, material=lambert(0.5))], looking_down((10, 10)), np.ones((1, 1, 3)), spp=256)
    np.testing.assert_allclose(picture.beauty[..., 0], 0.5 * picture.alpha, atol=1e-6)


def test_first_pixel_is_top_left():
    marker = square(0.1, material=lambert(1.0))
    marker.corners = marker.corners + np.array([-0.45, 0, -0.45])  # left (-x) and far (-z, the camera's up)
    picture = render([marker], looking_down((10, 10)), np.ones((1, 1, 3)))
    assert picture.alpha[0, 0] == 1
    assert picture.alpha.sum() == 1


def test_back_faces_are_black_and_opaque():
    ceiling = square(2, material=lambert(1.0))
    ceiling.triangles = ceiling.triangles[:, ::-1]
    picture = render([ceiling], looking_down(), np.ones((1, 1, 3)), bounces=1)
    assert (picture.alpha == 1).all()
    assert not picture.beauty.any()


def test_two_sided_faces_shine_on_both_sides():
    ceiling = square(2, material=lambert(1.0), two_sided=True)
    ceiling.triangles = ceiling.triangles[:, ::-1]
    ceiling.normals = -ceiling.normals
    picture = render([ceiling], looking_down(), np.ones((1, 1, 3)))
    np.testing.assert_allclose(picture.beauty, 1, rtol=1e-5)


@pytest.mark.parametrize("two_sided", [False, True])
def test_back_faces_block_light_and_reflect_it_only_if_two_sided(two_sided):
    # A white sheet close above the floor, its front up. The floor sees its back; between them light comes from the rim.
    floor = square(1, 0.0, material=lambert(1.0))
    sheet = square(3, 1.0, material=lambert(1.0), two_sided=two_sided)
    camera = Camera("c", (0, 0.9, 0), (0, 0, 0), (0, 0, -1), 50, (8, 8))
    picture = render([floor, sheet], camera, np.ones((1, 1, 3)), bounces=1)
    assert (picture.layers[1] > 0).any() == two_sided
    # Sky fraction past a 3 x 3 sheet at distance 1 above the centre: below one half.
    assert 0 < picture.layers[0].mean() < 0.5


def test_membrane_lets_light_through():
    pixels = np.zeros((2, 1, 3))
    pixels[1] = 1.0  # light from below only
    m = Material("m", "translucent", (0.5, 0.5, 0.5), transmittance=(0.25, 0.5, 1.0))
    picture = render([square(1000, material=m)], looking_down(), pixels)
    # E = pi from a hemisphere of radiance 1: B = transmittance.
    np.testing.assert_allclose(picture.beauty.mean((0, 1)), [0.25, 0.5, 1.0], rtol=1e-3)
    # A plate underneath shadows the backward lobe completely.
    blocked = render([square(1000, material=m), square(1000, -1e-3, two_sided=True)], looking_down(), pixels)
    assert blocked.layers[0].max() < 1e-3


def test_texture_is_bilinear_repeats_and_starts_at_the_bottom():
    image = np.zeros((2, 2, 3))
    image[0, 0], image[0, 1], image[1, 0], image[1, 1] = [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]
    uvs = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], float)
    ground = square(1, material=lambert(0.5), texture=image, uvs=uvs)
    picture = render([ground], looking_down((8, 8)), np.ones((1, 1, 3)), spp=16384)
    # uv runs with +x (right) and -z (up in the picture); two repeats: 4 pixels per repeat, texel centres at the
    # borders of pixels 0|1 and 2|3. The middle of the picture's pixel (2, 1) is at u = 3/8, v = 3/8 of a repeat.
    bottom, top = np.array([[0, 0, 1], [1, 1, 1]]), np.array([[1, 0, 0], [0, 1, 0]])
    expected = 0.5 * (0.75 * (0.75 * bottom[0] + 0.25 * bottom[1]) + 0.25 * (0.75 * top[0] + 0.25 * top[1]))
    np.testing.assert_allclose(picture.beauty[6, 1], expected, atol=2e-3)
    np.testing.assert_allclose(picture.beauty[2, 5], expected, atol=2e-3)
    assert picture.beauty.mean() == pytest.approx(0.25, abs=1e-3)


def test_light_scales_the_picture_exactly():
    one = render(still_life(), CAMERA, SKY, lights=LIGHTS, bounces=1, spp=32)
    doubled = [
        SphereLight("s", (1, 2, 1), 0.3, (10, 8, 6)),
        RectangleLight("r", (-1, 2, 0), (0.5, 0, 0), (0, 0, 1), (4, 6, 8)),
    ]
    two = render(still_life(), CAMERA, 2 * SKY, lights=doubled, bounces=1, spp=32)
    # A factor of two only shifts exponents.
    np.testing.assert_array_equal(two.beauty, 2 * one.beauty)
    np.testing.assert_array_equal(two.variance, 4 * one.variance)


def test_superposition():
    # Two skies and two sets of lights, each alone, and together: means over the picture agree.
    other = np.random.default_rng(1).random((8, 16, 3))
    parts = [
        mean_and_error(render(still_life(), CAMERA, sky, lights=lights, bounces=1, spp=1024))
        for sky, lights in ((SKY, LIGHTS[:1]), (other, LIGHTS[1:]), (SKY + other, LIGHTS))
    ]
    (a, ea), (b, eb), (c, ec) = parts
    assert (abs(a + b - c) < 5 * np.sqrt(ea**2 + eb**2 + ec**2)).all()


def test_turning_everything_changes_nothing():
    angle = math.radians(70.0)
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    turned = []
    for part in still_life():
        part.corners = part.corners @ turn.T
        part.normals = part.normals @ turn.T
        turned.append(part)
    camera = Camera("c", tuple(turn @ CAMERA.eye), tuple(turn @ CAMERA.target), fov=40, size=(24, 16))
    before = render(still_life(), CAMERA, SKY, bounces=1, spp=1024)
    after = render(turned, camera, SKY, bounces=1, spp=1024, rotate=70.0)
    z = (after.beauty - before.beauty) / np.sqrt(after.variance + before.variance + 1e-12)
    # Pixel by pixel: 99 % of Student's t with 15 to 30 degrees of freedom lie within 2.95.
    assert np.quantile(abs(z), 0.99) < 3.2
    # And over the whole picture, where 384 pixels average out.
    (a, ea), (b, eb) = mean_and_error(before), mean_and_error(after)
    assert (abs(a - b) < 5 * np.hypot(ea, eb)).all()


@pytest.mark.parametrize("scale", [1e-4, 1e6])
def test_scale_does_not_matter(scale):
    camera = Camera("c", *(tuple(scale * x for x in v) for v in (CAMERA.eye, CAMERA.target)), fov=40, size=(24, 16))
    lights = [
        SphereLight("s", tuple(scale * x for x in (1, 2, 1)), 0.3 * scale, (5, 4, 3)),
        RectangleLight("r", (-scale, 2 * scale, 0), (0.5 * scale, 0, 0), (0, 0, scale), (2, 3, 4)),
    ]
    one = render(still_life(), CAMERA, SKY, lights=LIGHTS, bounces=1, spp=256)
    other = render(still_life(), camera, SKY, lights=lights, bounces=1, spp=256, scale=scale)
    assert np.isfinite(other.beauty).all()
    # The same samples up to rounding, which moves a ray past an edge here and there.
    z = (other.beauty - one.beauty) / np.sqrt(one.variance + other.variance + 1e-12)
    assert np.quantile(abs(z), 0.99) < 1.0
    np.testing.assert_allclose(other.alpha, one.alpha, atol=0.01)


def test_far_camera_sees_the_same_as_a_near_one():
    # Nearly parallel projection: at 1e5 scene sizes float32 origins would be coarser than the pixels.
    parts = [sphere(rings=32, material=lambert(0.5))]
    far = Camera("c", (0, 0, 1e5), (0, 0, 0), fov=math.degrees(2 * math.atan(1.2e-5)), size=(16, 16))
    picture = render(parts, far, np.ones((1, 1, 3)), spp=256)
    # A disc of radius 1 in a square of side 2.4; the mesh's outline lacks 1/6 (pi/64)^2 of it.
    assert picture.alpha.mean() == pytest.approx(math.pi / 2.4**2, rel=3e-3)


def test_no_light_is_black_with_alpha():
    picture = render(still_life(), CAMERA, bounces=2, spp=16)
    assert not picture.beauty.any()
    assert not picture.variance.any()
    assert picture.alpha.max() == 1


def test_surface_without_reflectance_is_black():
    assert not render([square(4, material=lambert(0.0))], looking_down(), SKY, lights=LIGHTS, bounces=2).beauty.any()


def test_opposite_vertex_normals_fall_back_to_the_face():
    ground = square(2, material=lambert(1.0))
    corners = ground.corners[[0, 1, 2]]
    # Middle of an edge: the two normals cancel; on the rest they are horizontal and look away or sideways.
    part = Part(corners, np.array([[0, 1, 2]]), np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1, 0]]), material=lambert(1.0))
    picture = render([part], at_point((0, 1, 1), (0, 0, 1)), np.ones((1, 1, 3)), spp=16)
    assert np.isfinite(picture.beauty).all()


@pytest.mark.parametrize(
    ("spp", "passes", "per_pass"), [(0, 2, 1), (1, 2, 1), (16, 16, 1), (100, 25, 4), (1024, 16, 64), (1000, 32, 32)]
)
def test_samples_are_split_into_passes(spp, passes, per_pass):
    assert split_samples(spp) == (passes, per_pass)
    assert passes * per_pass >= spp


def test_one_pass_has_no_variance():
    with pytest.raises(ValueError, match="2 passes"):
        resolve(tile_of(passes=(0, 1)))


@pytest.mark.parametrize("roughness", [1e-6, 1e-4, 1e3])
def test_extreme_materials_stay_finite(roughness):
    m = Material("m", "cook-torrance", (0.1, 0.1, 0.1), (1, 1, 1), f0=1.0, roughness=roughness)
    pixels = np.full((16, 32, 3), 1e-3)
    pixels[3, 5] = 1e6
    picture = render([sphere(rings=16, material=m), square(6, -1.0)], CAMERA, pixels, lights=LIGHTS, bounces=2, spp=64)
    assert np.isfinite(picture.beauty).all()
    assert np.isfinite(picture.variance).all()
    assert (picture.beauty >= 0).all()
