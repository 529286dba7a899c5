"""The reference path tracer against closed forms.

Where a tolerance says `errors`, it is that many standard errors by the picture's own variance; 5 of them are passed by
chance in all but one of a million cases. What is added to it is the error of the mesh or of the quadrature.
"""

import math

import numpy as np
import pytest

from relightcli.core.brdf.models import evaluate_many, pack_materials
from relightcli.core.lights.latlong import make_latlong, texel_solid_angles
from relightcli.core.transport.path_tracer import resolve, trace_rows
from relightcli.scene.model import Camera, Material, RectangleLight, SphereLight
from tests.core.brdf.reflectances import direction, hemisphere
from tests.core.transport.scenes import (
    Part,
    at_point,
    build,
    lambert,
    looking_down,
    mean_and_error,
    render,
    sphere,
    sphere_grid,
    square,
)

SKY = np.full((4, 8, 3), [1.0, 2.0, 0.5])


def assert_mean(picture, expected, errors=5.0, relative=0.0):
    mean, error = mean_and_error(picture)
    assert (abs(mean - expected) <= errors * error + (relative + 1e-6) * abs(np.asarray(expected))).all(), (
        f"expected {expected}, found {mean} +- {error}"
    )


def test_convex_lambert_under_a_constant_sky():
    # Flat faces: light from below a face is below its normal too, so B = rho L holds to the sampling error.
    ball = sphere(smooth=False, rings=8, material=lambert((0.8, 0.5, 1.0)))
    picture = render([ball], Camera("c", (0, 1, 3), (0, 0, 0), fov=20, size=(16, 16)), SKY, bounces=2)
    assert (picture.alpha == 1).all()
    assert_mean(picture, [0.8, 1.0, 0.5])
    # Nothing on a convex body sees anything of it.
    assert not picture.layers[1:].any()


def test_smooth_normals_change_little():
    ball = sphere(material=lambert(1.0))
    picture = render([ball], Camera("c", (0, 1, 3), (0, 0, 0), fov=20, size=(16, 16)), SKY)
    # Directions between face and shading horizon, at most pi/64/2 apart, carry less than its square over 4.
    assert_mean(picture, [1.0, 2.0, 0.5], relative=2e-3)


@pytest.mark.parametrize("tilt", [0.0, 0.7, 1.2])
def test_lambert_under_a_one_texel_sky(tilt):
    pixels = np.zeros((16, 32, 3))
    pixels[3, 11] = [1e6, 2e6, 1e5]
    ground = square(4, material=lambert(0.7))
    c, s = math.cos(tilt), math.sin(tilt)
    turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    ground.corners, ground.normals = ground.corners @ turn.T, ground.normals @ turn.T
    normal = turn[:, 1]
    # Integral of n.d over the texel: 64 x 64 points uniform in longitude and sin(latitude).
    x, w = np.polynomial.legendre.leggauss(64)
    lon = math.pi * (1 - 2 * (11 + 0.5 * (x + 1)) / 32)
    top, bottom = np.sin(math.pi * (0.5 - 3 / 16)), np.sin(math.pi * (0.5 - 4 / 16))
    sin_lat = (top + (bottom - top) * 0.5 * (x + 1))[:, None]
    cos_lat = np.sqrt(1 - sin_lat**2)
    cosine = normal[0] * np.sin(lon) * cos_lat + normal[1] * sin_lat + normal[2] * np.cos(lon) * cos_lat
    irradiance = texel_solid_angles(16, 32)[3] * (0.25 * w[:, None] * w * np.maximum(cosine, 0)).sum()
    assert irradiance > 0
    picture = render([ground], at_point(3 * normal, (0, 0, 0)), pixels)
    assert_mean(picture, 0.7 / math.pi * irradiance * np.array([1e6, 2e6, 1e5]))


@pytest.mark.parametrize(("share", "rho"), [(0.5, 0.8), (0.75, 0.8), (0.5, 1.0)])
def test_bowl(share, rho):
    # Spherical cap of a share f of the sphere: every form factor is dA / (4 pi r^2), so at every inner point the
    # light reflected k + 1 times is rho (1 - f) (rho f)^k; a white bowl approaches radiance 1.
    corners, triangles = sphere_grid(96, 128, math.acos(2 * share - 1), math.pi)
    bowl = Part(corners, triangles[:, ::-1], None, material=lambert(rho))
    camera = Camera("c", (0, 0, 0), (0, -1, 0.2), up=(0, 0, 1), fov=80, size=(16, 16))
    picture = render([bowl], camera, np.ones((4, 8, 3)), spp=1024, bounces=3)
    truth = [rho * (1 - share) * (rho * share) ** k for k in range(4)]
    # Faces 1.4 degrees apart: the mesh is off by about that angle squared, 6e-4. 262144 paths give each layer's mean
    # to 3e-3 or better, a quadrant's sum of layers to 2e-3.
    for layer, expected in zip(picture.layers, [*truth, 0], strict=True):
        assert layer.mean() == pytest.approx(expected, rel=1e-2)
    quadrants = picture.beauty.reshape(2, 8, 2, 8, 3).mean((1, 3, 4))
    np.testing.assert_allclose(quadrants, sum(truth), rtol=1e-2)


@pytest.mark.parametrize(("distance", "factor"), [(0.5, 0.415253), (1.0, 0.199825), (2.0, 0.068590)])
def test_facing_squares(distance, factor):
    light = RectangleLight("l", (0, distance, 0), (1, 0, 0), (0, 0, 1), (1, 2, 3))  # u x v = -y
    picture = render([square(material=lambert(0.5))], looking_down(height=3), lights=[light], spp=1024)
    # The factor has six digits.
    assert_mean(picture, 0.5 * factor * np.array([1, 2, 3]), relative=1e-5)


def test_squares_with_a_common_edge():
    light = RectangleLight("l", (-0.5, 0.5, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1))  # u x v = +x
    picture = render([square(material=lambert(1.0))], looking_down(), lights=[light], spp=4096)
    assert_mean(picture, 0.200044, relative=1e-5)


@pytest.mark.parametrize("theta", [0.0, 0.8, 1.2, 1.5, 1.7])
def test_sphere_light_over_a_plane(theta):
    # A sphere of radius 1 at distance H, angle theta from the normal: E = pi B cos(theta)/H^2, and for a sphere that
    # the horizon cuts E = pi B F with the straddling form factor. [e.g. Howell, B-43]
    height = 2.0
    center = height * direction(theta)[[0, 2, 1]]
    light = SphereLight("l", tuple(center), 1.0, (1.0, 2.0, 4.0))
    if theta <= 0.5 * math.pi - math.asin(1 / height):
        factor = math.cos(theta) / height**2
    else:
        k = math.sqrt(height**2 - 1)
        c, s = math.cos(theta), math.sin(theta)
        factor = 0.5 - math.asin(k / (height * s)) / math.pi
        factor += (c * math.acos(-k * c / s) - k * math.sqrt(1 - height**2 * c * c)) / (math.pi * height**2)
    picture = render([square(20, material=lambert(0.9))], at_point((0, 3, 0), (0, 0, 0)), lights=[light], spp=4096)
    assert_mean(picture, 0.9 * factor * np.array([1, 2, 4]))


def test_rectangle_light_over_a_point():
    # Parallel rectangle with a corner above the point: F = (A atan(B') + ...)/(2 pi), four corners add up.
    def corner(a, b):
        return (
            a / math.sqrt(1 + a * a) * math.atan(b / math.sqrt(1 + a * a))
            + b / math.sqrt(1 + b * b) * math.atan(a / math.sqrt(1 + b * b))
        ) / (2 * math.pi)

    h = 0.3
    light = RectangleLight("l", (0.1, h, -0.2), (2, 0, 0), (0, 0, 1), (3, 3, 3))
    expected = sum(corner(a / h, b / h) for a in (1.1, 0.9) for b in (0.7, 0.3))
    picture = render([square(20, material=lambert(0.5))], at_point((0, 3, 0), (0, 0, 0)), lights=[light], spp=16384)
    assert_mean(picture, 0.5 * 3 * expected)


def test_light_inside_which_the_point_lies_and_light_from_behind_send_nothing():
    lights = [
        SphereLight("s", (0, 0, 0), 1.0, (1, 1, 1)),
        RectangleLight("r", (0, 1, 0), (0, 0, 1), (1, 0, 0), (1, 1, 1)),  # u x v = +y
    ]
    assert not render([square(20)], at_point((0, 3, 0), (0, 0, 0)), lights=lights).beauty.any()


def test_light_flush_in_a_ceiling_is_not_hidden_by_it():
    ceiling = square(4, 1.0, material=lambert(0.0))
    ceiling.triangles = ceiling.triangles[:, ::-1]
    light = RectangleLight("l", (0, 1, 0), (1, 0, 0), (0, 0, 1), (1, 1, 1))
    camera = Camera("c", (0, 0.9, 0), (0, 0, 0), (0, 0, -1), math.degrees(2 * math.atan(0.5 / 0.9)), (8, 8))
    picture = render([square(material=lambert(1.0)), ceiling], camera, lights=[light], spp=4096)
    assert_mean(picture, 0.199825, relative=1e-5)


@pytest.mark.parametrize("height", [1.2, 2.0, 5.0])
def test_shadow_of_a_sphere(height):
    # Under the middle of a sphere of radius 1 the plane loses 1/H^2 of a constant sky.
    ball = sphere(center=(0, height, 0), rings=128, material=lambert(0.0))
    eye = (3 * height, 0.5, 0)
    picture = render([square(50, material=lambert(1.0)), ball], at_point(eye, (0, 0, 0)), SKY, spp=4096)
    # The mesh's silhouette is inside the sphere by less than (pi/128)^2/2 of its radius.
    expected = (1 - 1 / height**2) * np.array([1.0, 2.0, 0.5])
    assert_mean(picture, expected, relative=2 * (math.pi / 128) ** 2 / height**2 / (1 - 1 / height**2))


def test_endless_wall():
    # At distance x from a wall of height h a floor sees the sky fraction (1 + x / sqrt(x^2 + h^2)) / 2.
    wall = Part(
        np.array([[0, 0, -500], [0, 1, -500], [0, 1, 500], [0, 0, 500]], float),
        np.array([[0, 1, 2], [0, 2, 3]]),
        np.tile([1.0, 0, 0], (4, 1)),
        material=lambert(0.0),
    )
    floor = square(1000, material=lambert(1.0))
    picture = render([floor, wall], at_point((3, 2, 0), (0.5, 0, 0)), np.ones((1, 1, 3)), spp=4096)
    # The wall ends at 500: 1e-6 of the hemisphere.
    assert_mean(picture, 0.5 * (1 + 0.5 / math.sqrt(1.25)), relative=1e-5)


GLOSSY = [
    Material("m", "blinn-phong", (0.3, 0.3, 0.3), (0.5, 0.4, 0.2), shininess=20),
    Material("m", "blinn-phong", (0, 0, 0), (1, 1, 1), shininess=0),
    Material("m", "phong", (0.1, 0.2, 0.3), (0.5, 0.4, 0.2), shininess=8),
    Material("m", "cook-torrance", (0.2, 0.1, 0.0), (0.8, 0.7, 0.6), f0=0.8, roughness=0.3),
    Material("m", "cook-torrance", (0, 0, 0), (1, 1, 1), f0=0.0, roughness=1.0),
    Material("m", "translucent", (0.4, 0.2, 0.1), transmittance=(0.3, 0.5, 0.2)),
]


@pytest.mark.parametrize("theta", [0.1, 1.0, 1.4])
@pytest.mark.parametrize("m", GLOSSY, ids=lambda m: f"{m.model}-{m.shininess}-{m.roughness}")
def test_reflected_sky_is_the_quadrature(m, theta):
    # A sky with a bright and a dark half: north (-z) bright.
    pixels = np.zeros((2, 4, 3))
    pixels[:, [0, 3]] = [1.0, 2.0, 3.0]
    light, weight = hemisphere(200, 200)
    light, weight = np.concatenate([light, -light])[:, [1, 2, 0]], np.tile(weight, 2)
    radiance = np.where(light[:, 2:] < 0, [1.0, 2.0, 3.0], 0.0)
    view = direction(theta)[[1, 2, 0]]
    f = evaluate_many(pack_materials([m]), np.array(0), np.array(m.diffuse), np.array([0.0, 1, 0]), light, view)
    expected = weight @ (f * radiance)
    picture = render([square(20, material=m)], at_point(3 * view, (0, 0, 0)), pixels, spp=16384)
    assert_mean(picture, expected, relative=2e-4)


@pytest.mark.parametrize("m", GLOSSY[:4], ids=lambda m: m.model)
def test_interpolated_normals_shade_and_the_face_blocks(m):
    # A flat square whose vertex normals all lean by 0.5: reflectance by the normal, nothing from below the square.
    ground = square(20, material=m)
    normal = np.array([math.sin(0.5), math.cos(0.5), 0.0])
    ground.normals = np.tile(normal, (4, 1))
    pixels = np.zeros((2, 4, 3))
    pixels[:, [0, 3]], pixels[:, [1, 2]] = [1.0, 2.0, 3.0], [0.5, 0.2, 0.1]
    light, weight = hemisphere(200, 200)
    light = light[:, [1, 2, 0]]
    radiance = np.where(light[:, 2:] < 0, [1.0, 2.0, 3.0], [0.5, 0.2, 0.1])
    view = direction(0.6)[[1, 2, 0]]
    f = evaluate_many(pack_materials([m]), np.array(0), np.array(m.diffuse), normal, light, view)
    picture = render([ground], at_point(3 * view, (0, 0, 0)), pixels, spp=16384)
    # 1e-3: the quadrature's steps at the tilted horizon, where the integrand has a kink.
    assert_mean(picture, weight @ (f * radiance), relative=1e-3)


@pytest.mark.parametrize("roughness", [0.02, 0.1, 0.5])
def test_glossy_surface_under_a_one_texel_sun(roughness):
    # The sun stands in the mirror direction's neighbourhood: both techniques of the heuristic matter.
    pixels = np.full((32, 64, 3), 1e-3)
    pixels[9, 40] = 1e6
    m = Material("m", "cook-torrance", (0.1, 0.1, 0.1), (1, 1, 1), f0=0.5, roughness=roughness)
    x, w = np.polynomial.legendre.leggauss(100)
    lon = math.pi * (1 - 2 * (40 + 0.5 * (x + 1)) / 64)
    top, bottom = np.sin(math.pi * (0.5 - 9 / 32)), np.sin(math.pi * (0.5 - 10 / 32))
    sin_lat = (top + (bottom - top) * 0.5 * (x + 1))[:, None] + 0 * lon
    cos_lat = np.sqrt(1 - sin_lat**2)
    light = np.stack([np.sin(lon) * cos_lat, sin_lat, np.cos(lon) * cos_lat], -1).reshape(-1, 3)
    weight = (texel_solid_angles(32, 64)[9] * 0.25 * w[:, None] * w).ravel()
    middle = light.mean(0) / np.linalg.norm(light.mean(0))
    view = np.array([-middle[0], middle[1], -middle[2]])
    arguments = pack_materials([m]), np.array(0), np.array(m.diffuse), np.array([0.0, 1, 0])
    sun = 1e6 * (weight @ evaluate_many(*arguments, light, view))
    picture = render([square(20, material=m)], at_point(3 * view, (0, 0, 0)), pixels, spp=16384)
    # The sky adds 1e-3 at most, less than 1e-6 of the sun.
    assert_mean(picture, sun, relative=1e-5)


def test_error_falls_with_the_root_of_the_samples():
    # One sample per pass: plain Monte Carlo. RMS over 32 x 32 pixels against the exact (1 - F).
    scene, tracer = build([square(20, material=lambert(0.5))])
    pixels = np.zeros((2, 4, 3))
    pixels[0, 0] = 1.0  # an octant of the upper hemisphere: E = pi/4
    sky = make_latlong(pixels + 1e-9)
    counts = np.array([4, 16, 64, 256])
    errors = []
    for n in counts:
        tile = trace_rows(scene, tracer, sky, at_point((0, 3, 0), (0, 0, 0), (32, 32)), (0, 32), (0, n), 1, 0)
        errors.append(np.sqrt(np.mean((tile.layers[0] / n - 0.5 / 4) ** 2)))
    slope = np.polyfit(np.log(counts), np.log(errors), 1)[0]
    # An RMS over 1024 pixels is known to 1/sqrt(2 * 1024) = 2 %, hence the slope over a factor 64 to about 0.01.
    assert slope == pytest.approx(-0.5, abs=0.03)


def test_error_bars_are_honest():
    # z = (mean - truth)/standard error over pixels: with 32 passes its variance is (n-1)/(n-3) = 1.07.
    pixels = np.zeros((2, 4, 3))
    pixels[0, 0] = 1.0
    scene, tracer = build([square(20, material=lambert(0.5))])
    camera = at_point((0, 3, 0), (0, 0, 0), (32, 32))
    for per_pass in (1, 4):
        picture = resolve(trace_rows(scene, tracer, make_latlong(pixels + 1e-9), camera, (0, 32), (0, 32), per_pass, 0))
        z = (picture.beauty[..., 1] - 0.5 / 4) / np.sqrt(picture.variance[..., 1])
        # 1024 independent pixels: mean within 4/32, variance within 4 sqrt(2/1024) of 1.07.
        assert abs(z.mean()) < 4 / 32
        assert z.var() == pytest.approx(31 / 29, abs=0.2)
