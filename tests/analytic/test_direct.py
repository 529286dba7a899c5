"""Direct light from end to end: scene file, store, picture, against closed forms.

Pictures are of scenes small enough to precompute in a second. KT numbers are the known answers of the field: KT3 the
form factor of a sphere, KT5 the spherical bowl, KT6 unit squares.
"""

import math

import numpy as np
import pytest

import relight_formats as formats
from relightcli.core.lights.latlong import texel_solid_angles
from relightcli.scene.model import Camera, Material
from tests.core.transport.scenes import Part, at_point, lambert, looking_down, sphere, sphere_grid, square
from tests.stages.scene_files import make_store, picture, write_scene

WHITE_SKY = np.ones((4, 8, 3))
TINTED_SKY = np.full((4, 8, 3), [1.0, 2.0, 0.5])
LOOK = Camera("main", (0, 1, 3), (0, 0, 0), fov=20, size=(16, 16))
CLOSE_UP = Camera("main", (0, 1, 3), (0, 0, 0), fov=10, size=(16, 16))


def one_pixel_sky(row=3, column=11, radiance=(1e6, 2e6, 1e5), height=16):
    pixels = np.zeros((height, 2 * height, 3))
    pixels[row, column] = radiance
    return pixels


def pixel_direction(row, column, height=16):
    lon, lat = math.pi * (1 - (column + 0.5) / height), math.pi * (0.5 - (row + 0.5) / height)
    return np.array([math.sin(lon) * math.cos(lat), math.sin(lat), math.cos(lon) * math.cos(lat)])


@pytest.mark.parametrize("resolution", [16, 64])
@pytest.mark.parametrize("effects", ["auto", "direct,shadows"])
def test_white_furnace(tmp_path, resolution, effects):
    # A convex white body under L = 1 shows 1 everywhere. `auto` finds that it casts no shadow.
    scene = write_scene(tmp_path, {"ball": sphere(rings=24, material=lambert(1.0))}, [CLOSE_UP], {"sky": WHITE_SKY})
    store = make_store(scene, light_resolution=resolution, effects=effects)
    rgb, alpha = picture(store)
    assert (alpha == 1).all()
    # The horizon's staircase of texels (1.3e-3 at 16, 1e-4 at 64), and the interpolation of unit normals' radiance.
    np.testing.assert_allclose(rgb, 1.0, atol={16: 3e-3, 64: 3e-4}[resolution])


def test_colours_of_albedo_and_sky_multiply(tmp_path):
    ball = sphere(rings=24, material=lambert((0.8, 0.5, 1.0)))
    store = make_store(write_scene(tmp_path, {"ball": ball}, [CLOSE_UP], {"sky": TINTED_SKY}))
    np.testing.assert_allclose(picture(store)[0], np.broadcast_to([0.8, 1.0, 0.5], (16, 16, 3)), rtol=3e-4)


def test_lambert_sphere_under_one_texel(tmp_path):
    # B = albedo/pi L dOmega (n.d): the moment of the light is exact, and for n.d well above 0 the horizon is far.
    ball = sphere(rings=64, material=lambert(0.7))
    row, column = 3, 11
    d = pixel_direction(row, column)
    camera = Camera("main", tuple(5 * d), (0, 0, 0), fov=8, size=(24, 24))
    scene = write_scene(tmp_path, {"ball": ball}, [camera], {"sky": one_pixel_sky(row, column)})
    rgb, _ = picture(make_store(scene))
    # Moment of the pixel, integrated: 64 x 64 points uniform in longitude and sin(latitude).
    part = (np.arange(64) + 0.5) / 64
    lon = math.pi * (1 - 2 * (column + part) / 32)
    low, high = np.sin(math.pi * (0.5 - np.array([row + 1, row]) / 16))
    s = (low + (high - low) * part)[:, None] + 0 * lon
    c = np.sqrt(1 - s * s)
    moment = np.stack([np.sin(lon) * c, s, np.cos(lon) * c], -1).mean((0, 1)) * texel_solid_angles(16, 32)[row]
    # The middle of the picture sees the point of the sphere that looks at the camera, over 0.3 degrees.
    found = rgb[11:13, 11:13].mean((0, 1))
    expected = 0.7 / math.pi * (moment @ d) * np.array([1e6, 2e6, 1e5])
    np.testing.assert_allclose(found, expected, rtol=1e-3)


@pytest.mark.parametrize("height", [1.2, 2.0, 4.0])
def test_shadow_of_a_sphere(tmp_path, height):
    # KT3: under a black sphere of radius 1 at height H the plane loses 1/H^2 of a constant sky.
    parts = {
        "ground": square(60, material=lambert(1.0)),
        "ball": sphere(center=(0, height, 0), rings=48, material=lambert(0.0)),
    }
    scene = write_scene(tmp_path, parts, [at_point((3 * height, 0.5, 0), (0, 0, 0))], {"sky": WHITE_SKY})
    rgb, _ = picture(make_store(scene, receivers="pixels:c"))
    # Texels along the ball's outline: 64 of them count with error 1/2 texel each; measured below 1 % of 1 - 1/H^2.
    np.testing.assert_allclose(rgb, 1 - 1 / height**2, atol=4e-3)


@pytest.mark.parametrize("theta", [0.5, 1.0, 1.4])
def test_shadow_beside_a_sphere(tmp_path, theta):
    # KT3 off the axis; at 1.4 the horizon cuts the sphere.
    h = 2.0
    center = (h * math.sin(theta), h * math.cos(theta), 0.0)
    parts = {
        "ground": square(60, material=lambert(1.0)),
        "ball": sphere(center=center, rings=48, material=lambert(0.0)),
    }
    if theta <= 0.5 * math.pi - math.asin(1 / h):
        factor = math.cos(theta) / h**2
    else:
        k, c, s = math.sqrt(h * h - 1), math.cos(theta), math.sin(theta)
        factor = 0.5 - math.asin(k / (h * s)) / math.pi
        factor += (c * math.acos(-k * c / s) - k * math.sqrt(1 - h * h * c * c)) / (math.pi * h * h)
    scene = write_scene(tmp_path, parts, [at_point((-3, 2, 0.1), (0, 0, 0))], {"sky": WHITE_SKY})
    rgb, _ = picture(make_store(scene, receivers="pixels:c"))
    np.testing.assert_allclose(rgb, 1 - factor, atol=4e-3)


@pytest.mark.parametrize("share", [0.35, 0.5, 0.75])
def test_bowl(tmp_path, share):
    # KT5: inside a bowl that is a share f of its sphere the direct light is rho (1 - f), the same at every point.
    corners, triangles = sphere_grid(32, 96, math.acos(2 * share - 1), math.pi)
    bowl = Part(corners, triangles[:, ::-1], -corners, material=lambert(0.8))
    camera = Camera("main", (0, 0, 0), (0, -1, 0.2), up=(0, 0, 1), fov=60, size=(16, 16))
    rgb, alpha = picture(
        make_store(write_scene(tmp_path, {"bowl": bowl}, [camera], {"sky": WHITE_SKY}), subdivide=False)
    )
    assert (alpha == 1).all()
    # The rim is a polygon of 96 sides (1e-3 of its area), and crosses texels at both ends of the sky that is left.
    np.testing.assert_allclose(rgb, 0.8 * (1 - share), rtol=1.2e-2)


def box_without_lid(cells=16):
    """Unit box around the origin, open above, seen from inside: floor and four walls, each a grid of its own."""
    g = np.linspace(-0.5, 0.5, cells + 1)
    a, b = (x.ravel() for x in np.meshgrid(g, g, indexing="ij"))
    i, j = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    p = (i * (cells + 1) + j).ravel()
    quads = np.stack([p, p + cells + 1, p + cells + 2, p + 1], -1)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    half = np.full(len(a), 0.5)
    walls = {
        "floor": (np.stack([a, -half, -b], -1), (0, 1, 0)),
        "left": (np.stack([-half, b, -a], -1), (1, 0, 0)),
        "right": (np.stack([half, b, a], -1), (-1, 0, 0)),
        "back": (np.stack([a, b, -half], -1), (0, 0, 1)),
        "front": (np.stack([-a, b, half], -1), (0, 0, -1)),
    }
    out = {}
    for name, (corners, normal) in walls.items():
        e = corners[triangles]
        n = np.cross(e[0, 1] - e[0, 0], e[0, 2] - e[0, 0])
        assert n @ normal > 0
        out[name] = Part(corners, triangles, np.tile(np.array(normal, float), (len(corners), 1)), material=lambert(1.0))
    return out


def test_unit_box_without_a_lid(tmp_path):
    # KT6: mean sky fraction of the floor .199825, of the walls .200044. Pixel receivers: means over areas.
    cameras = [
        Camera("floor", (0, 0.4999, 0), (0, -0.5, 0), (0, 0, -1), math.degrees(2 * math.atan(0.5 / 0.9999)), (24, 24)),
        Camera("left", (0.4999, 0, 0), (-0.5, 0, 0), (0, 1, 0), math.degrees(2 * math.atan(0.5 / 0.9999)), (24, 24)),
    ]
    scene = write_scene(tmp_path, box_without_lid(), cameras, {"sky": WHITE_SKY})
    for name, factor in (("floor", 0.199825), ("left", 0.200044)):
        store = make_store(scene, f"{name}.zarr", receivers=f"pixels:{name}")
        rgb, alpha = picture(store, camera=name)
        assert alpha.min() > 0.999
        # One point per pixel, 24 x 24 of them: the midpoint rule; next to the common edges it is off by some 1e-3.
        assert rgb.mean() == pytest.approx(factor, rel=1e-2)


def test_linear_in_light_and_superposition(tmp_path):
    rng = np.random.default_rng(0)
    maps = {"a": rng.random((8, 16, 3)), "b": rng.random((8, 16, 3)) ** 4}
    maps["both"] = maps["a"].astype(np.float32) + np.float32(3) * maps["b"].astype(np.float32)
    parts = {"ground": square(6, material=lambert(0.5)), "ball": sphere(0.5, (0, 0.6, 0), rings=12)}
    store = make_store(write_scene(tmp_path, parts, [LOOK], maps), light_resolution=16)
    a, b, both = (picture(store, env=name)[0] for name in maps)
    # Weights of `splat` follow each sky's own mean directions: texels are shared a little differently.
    np.testing.assert_allclose(both, a + 3 * b, rtol=2e-2)
    # Scaling alone is exact to float32.
    scaled = tmp_path / "scaled"
    bright = write_scene(scaled, parts, [LOOK], {"a": maps["a"].astype(np.float32) * np.float32(1024)})
    c, _ = picture(store, env=str(bright.parent / "a-sky.exr"))
    np.testing.assert_allclose(c, 1024 * a, rtol=1e-6)


@pytest.mark.parametrize("model", ["lambert", "cook-torrance"])
def test_scene_and_light_turned_together(tmp_path, model):
    # A quarter turn of everything maps the sky cube's texels onto each other: the picture stays, to rounding.
    m = Material("m", model, (0.3, 0.4, 0.5), specular=(0.5, 0.4, 0.3), f0=0.6, roughness=0.3)
    rng = np.random.default_rng(1)
    pixels = rng.random((8, 16, 3))
    ball = sphere(0.5, (0.2, 0.6, 0.1), rings=16, material=m)
    ground = square(6, material=lambert(0.5))

    def turned(part, a):
        t = np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
        return Part(part.corners @ t.T, part.triangles, part.normals @ t.T, part.uvs, part.material), t

    pictures = []
    for degrees in (0.0, 90.0):
        a = math.radians(degrees)
        parts = {name: turned(part, a)[0] for name, part in (("ground", ground), ("ball", ball))}
        eye = turned(ball, a)[1] @ np.array([0.3, 1.5, 3])
        camera = Camera("main", tuple(eye), (0, 0.3, 0), fov=35, size=(24, 24))
        folder = tmp_path / f"{degrees:.0f}"
        scene = write_scene(folder, parts, [camera], {"sky": pixels})
        store = make_store(scene, light_resolution=32, refine=1, subdivide=False)
        pictures.append(picture(store, env_rotate=degrees))
    (a, alpha), (b, beta) = pictures
    assert np.abs(alpha - beta).max() < 0.05
    inside = (alpha == 1) & (beta == 1)
    # A texel centre or a camera ray within rounding of an edge may fall on its other side in a few places.
    error = np.abs(a - b)[inside].max(axis=1) / a[inside].max()
    assert np.quantile(error, 0.98) < 2e-3
    assert error.max() < 0.05


def turned_back(part):
    return Part(part.corners, part.triangles[:, ::-1], -part.normals, part.uvs, part.material, part.two_sided)


def test_back_faces_are_black_and_opaque(tmp_path):
    below = square(2, material=lambert(1.0))
    seen_from_behind = turned_back(below)
    scene = write_scene(tmp_path, {"sheet": seen_from_behind}, [looking_down()], {"sky": WHITE_SKY})
    rgb, alpha = picture(make_store(scene))
    assert (alpha == 1).all()
    assert not rgb.any()


@pytest.mark.parametrize("receivers", ["vertices", "pixels:c"])
def test_two_sided_objects_are_lit_on_both_sides(tmp_path, receivers):
    # The sky is 1 above and 3 below: the sheet shows the one that it looks at.
    pixels = np.ones((4, 8, 3))
    pixels[2:] = 3.0
    for back, expected in ((False, 1.0), (True, 1.0)):
        sheet = square(2, material=lambert(1.0), two_sided=True)
        sheet = turned_back(sheet) if back else sheet
        scene = write_scene(tmp_path / str(back), {"sheet": sheet}, [looking_down()], {"sky": pixels})
        rgb, alpha = picture(make_store(scene, receivers=receivers))
        assert (alpha == 1).all()
        np.testing.assert_allclose(rgb, expected, rtol=3e-4)


def test_translucent_membranes_let_light_through(tmp_path):
    # B = diffuse E_above/pi + transmittance E_below/pi, with 1 above and 3 below.
    pixels = np.ones((4, 8, 3))
    pixels[2:] = 3.0
    m = Material("m", "translucent", (0.4, 0.2, 0.1), transmittance=(0.3, 0.5, 0.2))
    scene = write_scene(tmp_path, {"leaf": square(2, material=m)}, [looking_down()], {"sky": pixels})
    rgb, _ = picture(make_store(scene))
    expected = np.array([0.4, 0.2, 0.1]) + 3 * np.array([0.3, 0.5, 0.2])
    np.testing.assert_allclose(rgb, np.broadcast_to(expected, rgb.shape), rtol=3e-4)


def test_texture_multiplies_the_albedo(tmp_path):
    # Four colours in a 2 x 2 texture; the camera sees the square exactly, (0, 0) of the UVs is bottom left.
    texture = np.array([[[1, 0.5, 0.25], [0.1, 0.2, 0.3]], [[0.9, 0.8, 0.7], [0, 0, 0]]])
    part = square(1, material=lambert((0.5, 1.0, 1.0)), texture=texture)
    store = make_store(write_scene(tmp_path, {"sheet": part}, [looking_down((16, 16))], {"sky": WHITE_SKY}))
    rgb, _ = picture(store)
    # Bilinear between texel centres, which lie in the middle of the quadrants, 8 pixels apart. The four pixels around
    # such a middle are half a pixel from it on the average, along both axes, and the texture repeats.
    near, far = 1 - 0.5 / 8, 0.5 / 8
    for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
        quadrant = rgb[8 * row + 3 : 8 * row + 5, 8 * column + 3 : 8 * column + 5].mean((0, 1))
        expected = near * near * texture[row, column] + near * far * texture[row, 1 - column]
        expected += far * near * texture[1 - row, column] + far * far * texture[1 - row, 1 - column]
        np.testing.assert_allclose(quadrant, expected * [0.5, 1, 1], atol=6e-4)  # horizon's staircase; half floats


def test_pixel_receivers_agree_with_vertex_receivers(tmp_path):
    # Away from shadow edges both see the same light; vertices are 0.05 apart on the ball.
    ball = sphere(0.5, (0, 0.7, 0), rings=32, material=lambert(0.8))
    scene = write_scene(
        tmp_path, {"ground": square(20, material=lambert(0.5)), "ball": ball}, [LOOK], {"sky": one_pixel_sky() + 1e5}
    )
    by_vertex, _ = picture(make_store(scene, "v.zarr"), "v.exr")
    by_pixel, _ = picture(make_store(scene, "p.zarr", receivers="pixels:main"), "p.exr")
    error = np.abs(by_vertex - by_pixel).max(axis=2) / by_pixel.max()
    assert np.median(error) < 3e-3
    assert np.quantile(error, 0.8) < 2e-2


@pytest.mark.parametrize("bounces", [0, 1])
def test_more_receivers_a_pixel_soften_the_steps_of_a_shadow(tmp_path, bounces):
    # The sun's shadow of a ball: of one receiver a pixel it is all or nothing.
    ball = sphere(0.5, (0, 0.6, 0), rings=24, material=lambert(0.8))
    parts = {"ground": square(20, material=lambert(0.5)), "ball": ball}
    camera = Camera("main", (0, 2, 3), (0, 0.2, 0), fov=40, size=(24, 24))
    scene = write_scene(tmp_path, parts, [camera], {"sky": one_pixel_sky(14, 40, height=64) + 50})
    truth = None
    errors, counts = [], []
    for grid in (1, 2, 4):
        store = make_store(scene, f"{grid}.zarr", receivers="pixels:main", pixel_grid=grid, bounces=bounces)
        if truth is None:
            truth, _ = picture(store, "truth.exr", reference=True, spp=256)
        rgb, alpha = picture(store, f"{grid}.exr")
        assert alpha.min() > 0.999
        errors.append(math.sqrt(((rgb - truth) ** 2).mean() / (truth**2).mean()))
        counts.append(formats.open_store(store).layouts["receivers/pixel"].shape[0])
    assert errors[1] < 0.6 * errors[0], errors
    assert errors[2] < 0.6 * errors[1], errors
    assert 2 * counts[0] < counts[1] < 4 * counts[0]  # outlines have nine already
    assert counts[2] == 16 * 24 * 24


def test_glossy_ball_under_a_constant_sky_shows_its_directional_albedo(tmp_path):
    # Unblocked and L = 1: the specular light is the integral of the lobe, by quadrature over the hemisphere.
    from relightcli.core.brdf.models import evaluate_many, pack_materials
    from tests.core.brdf.reflectances import N, direction, hemisphere

    m = Material("m", "cook-torrance", (0.1, 0.2, 0.3), (0.8, 0.6, 0.4), f0=0.5, roughness=0.3)
    camera = Camera("main", (0, 0, 4), (0, 0, 0), fov=29, size=(65, 65))
    scene = write_scene(tmp_path, {"ball": sphere(rings=40, material=m)}, [camera], {"sky": WHITE_SKY})
    rgb, alpha = picture(make_store(scene))
    light, weight = hemisphere(200, 200)
    for column in (32, 40, 48, 54):
        # Angle of the normal on the ball's equator against the viewer, for the pixel's middle.
        x = (2 * (column + 0.5) / 65 - 1) * math.tan(math.radians(14.5))
        t = (4 - math.sqrt(16 - 15 * (1 + x * x))) / (1 + x * x)
        point = np.array([x * t, 0, 4 - t])
        viewer = np.array([0, 0, 4]) - point
        cosine = point @ viewer / np.linalg.norm(viewer)
        view = direction(math.acos(min(1.0, cosine)))
        f = evaluate_many(pack_materials([m]), np.array(0), np.array(m.diffuse), N, light, view)
        assert alpha[32, column] == 1
        # The quadtree's 0.3 %, and the curvature within a pixel.
        np.testing.assert_allclose(rgb[32, column], weight @ f, rtol=1.5e-2)
