"""Specular radiance from visibility bits: against the sum over all texels, and against what a finer sum says.

The quadtree is compared with the same sum without it (every visible texel, the lobe of `core.brdf` in the direction of
the texel's light): what it saves must cost little. What texels cost is measured apart, and so are lobes that are
narrower than a texel, which are sampled.
"""

import math

import numpy as np
import pytest

from relightcli.core.brdf.models import evaluate_many, pack_materials
from relightcli.core.lights.environment import latlong_to_cube, splat
from relightcli.core.shade.glossy import sky_tree, specular_radiance
from relightcli.core.sphere import cube
from relightcli.core.transport.visibility import horizon_bits
from tests.core.brdf.reflectances import random_directions
from tests.core.shade.skies import caps, patchy_map, shiny, smooth_map, sunny_map, views

R = 64
N = 24
NORMALS = random_directions(N, 1).astype(np.float32)
VIEWS = views(NORMALS, 2)
OPEN = horizon_bits(NORMALS, R)
BLOCKED = caps(NORMALS, R, 100)
MAPS = {"smooth": smooth_map(), "patchy": patchy_map(3), "sunny": sunny_map()}

WIDE = [
    *(shiny("cook-torrance", roughness=m) for m in (0.035, 0.05, 0.1, 0.25, 0.5, 1.0)),
    *(shiny("blinn-phong", shininess=a) for a in (1.0, 10.0, 100.0, 2000.0)),
    *(shiny("phong", shininess=a) for a in (1.0, 10.0, 100.0, 500.0)),
]


@pytest.fixture(scope="module")
def trees():
    out = {}
    for name, pixels in MAPS.items():
        sky = latlong_to_cube(pixels, R)
        out[name] = sky_tree(splat(sky), pixels, 0.0)
    return out


def radiance(bits, material, tree, normals=NORMALS, view=VIEWS, threads=1):
    table = pack_materials([material])
    rows = np.arange(len(normals))
    return specular_radiance(bits, rows, normals, view, np.zeros(len(normals), np.int32), table, tree, threads)


def all_texels(bits, material, tree, normals=NORMALS, view=VIEWS):
    table = pack_materials([material])
    direction, flux = tree.direction[tree.first[3] :], tree.flux[tree.first[3] :]
    out = np.zeros((len(normals), 3))
    for i in range(len(normals)):
        seen = np.unpackbits(bits[i].reshape(-1), bitorder="little").astype(bool)
        lobe = evaluate_many(
            table, np.array(0), np.zeros(3), normals[i].astype(np.float64), direction[seen], view[i].astype(np.float64)
        )
        out[i] = (lobe * flux[seen]).sum(0)
    return out


def name(material):
    return f"{material.model}-{material.roughness if material.model == 'cook-torrance' else material.shininess}"


# Measured over three skies, fourteen lobes, open and half-blocked: RMS at most 0.6 % of the RMS radiance, single
# receivers off by at most 1.2 % of the brightest, means by -0.03 to +0.4 %. Worst is Blinn-Phong of exponent 100 among
# occluders: 1.1, 1.9 and 0.5 %.
@pytest.mark.parametrize("material", WIDE, ids=name)
def test_quadtree_against_all_texels(trees, material):
    rms, most, mean = (1.4e-2, 2.4e-2, 7e-3) if name(material) == "blinn-phong-100.0" else (8e-3, 1.6e-2, 5e-3)
    # Lobes hardly wider than a texel are sampled where they are seen at a low angle: texels are no truth there.
    sampled = material.model == "cook-torrance" and material.roughness < 0.1
    steep = np.einsum("nx,nx->n", NORMALS, VIEWS) > 0.34 if sampled else slice(None)
    for tree in trees.values():
        for bits in (OPEN, BLOCKED):
            truth = all_texels(bits, material, tree)[steep]
            error = radiance(bits, material, tree)[steep] - truth
            assert math.sqrt((error**2).mean() / (truth**2).mean()) < rms
            assert np.abs(error).max() < most * truth.max()
            assert abs(error.mean()) < mean * truth.mean()


def fine_sum(material, pixels, i, fine=512):
    """The open hemisphere by the texels of a cube eight times finer, where the lobe is not negligible."""
    sky = latlong_to_cube(pixels, fine // 4)
    direction = cube.texel_directions(fine).reshape(-1, 3)
    weight = np.tile(cube.solid_angles(fine).reshape(-1), 6)
    radiance_of = np.repeat(np.repeat(sky.radiance(), 4, axis=1), 4, axis=2).reshape(-1, 3)
    table = pack_materials([material])
    n, v = NORMALS[i].astype(np.float64), VIEWS[i].astype(np.float64)
    mirror = 2 * (n @ v) * n - v
    near = direction @ mirror > (0.5 if material.roughness < 0.2 else -1.0)
    f = evaluate_many(table, np.array(0), np.zeros(3), n, direction[near], v)
    return (f * (radiance_of[near] * weight[near, None])).sum(0)


# What texels of 1.8 degrees cost a lobe that is hardly wider, under a smooth sky: worst at grazing view, where half-
# vector lobes shrink by the cosine of the viewer. Measured, for viewers at 1, 33, 60 and 83 degrees:
# roughness 0.05 within 0.3 % (sampled at 83 degrees), 0.1 within 0.3 %, 0.3 within 0.5 %.
@pytest.mark.parametrize("roughness", [0.05, 0.1, 0.3])
def test_texels_against_a_finer_sum(trees, roughness):
    material = shiny("cook-torrance", roughness=roughness)
    found = radiance(OPEN, material, trees["smooth"])
    for i in (0, 9, 16, 23):
        truth = fine_sum(material, MAPS["smooth"], i)
        np.testing.assert_allclose(found[i], truth, rtol=0.01)


NARROW = [
    *(shiny("cook-torrance", roughness=m) for m in (1e-4, 5e-3, 0.02, 0.03)),
    *(shiny("blinn-phong", shininess=a) for a in (3e3, 1e4, 1e5)),
    *(shiny("phong", shininess=a) for a in (1e3, 1e4, 1e5)),
]


# A mirror shows the sky's radiance where it reflects to: the smooth sky changes by 1 % over 1.6 degrees, the width of
# the widest lobe here (0.03, in half the angle), and more often does so linearly. 256 samples leave less than that.
@pytest.mark.parametrize("material", NARROW, ids=name)
def test_narrow_lobes_are_mirrors(material):
    near = slice(0, 16)  # up to 57 degrees: beyond, lobes are skewed and shadowed, and no mirrors any more
    sky = sky_tree(splat(latlong_to_cube(MAPS["smooth"], R)), smooth_map(256, 512), 0.0)
    found = radiance(OPEN, material, sky)[near, 0].astype(np.float64)
    n, v = NORMALS[near].astype(np.float64), VIEWS[near].astype(np.float64)
    mirror = 2 * np.einsum("nx,nx->n", n, v)[:, None] * n - v
    light = 1 + 0.5 * mirror[:, 1] + 0.4 * mirror[:, 2]
    cosine = np.einsum("nx,nx->n", n, v)
    if material.model == "cook-torrance":
        albedo = 0.5 + 0.5 * (1 - cosine) ** 5
    elif material.model == "phong":
        albedo = np.ones_like(cosine)
    else:
        # Blinn-Phong does not conserve its energy away from the normal: the integral of the lobe in the mirror limit
        # is (a+2)(a+4)/(8 pi a) (n.l) * 4 (v.h) * 2 pi / a, which tends to cos^2.
        a = material.shininess
        albedo = (a + 2) * (a + 4) / (8 * math.pi * a) * (2 * math.pi / (a + 2)) * 4 * cosine**2
    np.testing.assert_allclose(found, albedo * light, rtol=0.025)


@pytest.mark.parametrize("degrees", [0.0, 77.0, -200.0])
def test_narrow_lobes_see_the_turned_map(degrees):
    # A mirror under a map of one column pair: what a turn of the map does, the opposite turn of the receiver does.
    pixels = patchy_map(7)
    a = math.radians(degrees)
    turn = np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    normals, view = ((x.astype(np.float64) @ turn.T).astype(np.float32) for x in (NORMALS, VIEWS))
    material = shiny("phong", shininess=1e6)
    still = sky_tree(splat(latlong_to_cube(pixels, R)), pixels, 0.0)
    turned = sky_tree(splat(latlong_to_cube(pixels, R, degrees)), pixels, degrees)
    a = radiance(OPEN, material, still)
    b = radiance(horizon_bits(normals, R), material, turned, normals, view)
    # A sample within 1e-3 of a patch's border may fall on its other side: at most one receiver in ten.
    assert (np.abs(a - b).max(1) > 1e-3).mean() < 0.1


def test_narrow_lobes_are_blocked_where_their_mirror_direction_is(trees):
    material = shiny("phong", shininess=1e5)
    n, v = NORMALS.astype(np.float64), VIEWS.astype(np.float64)
    mirror = 2 * np.einsum("nx,nx->n", n, v)[:, None] * n - v
    texel = cube.texel_index(mirror, R)
    bits = OPEN.copy()
    around = np.concatenate([texel[:, None], cube.neighbours(R)[texel]], axis=1)
    for i in range(N):
        for t in around[i]:
            bits.reshape(N, -1)[i, t // 8] &= ~np.uint8(1 << (t % 8))
    assert radiance(OPEN, material, trees["smooth"]).min() > 0.1
    assert not radiance(bits, material, trees["smooth"]).any()


@pytest.mark.parametrize("material", [*WIDE[::3], *NARROW[::3]], ids=name)
def test_zero_cases(trees, material):
    # Nothing visible, a black sky, a viewer behind the surface.
    assert not radiance(np.zeros_like(OPEN), material, trees["patchy"]).any()
    black = np.zeros((2, 4, 3), np.float32)
    assert not radiance(OPEN, material, sky_tree(latlong_to_cube(black, R), black, 0.0)).any()
    assert not radiance(OPEN, material, trees["patchy"], view=-VIEWS).any()
    assert np.isfinite(radiance(OPEN, material, trees["patchy"], view=NORMALS)).all()


def test_lambert_has_no_lobe(trees):
    assert not radiance(OPEN, shiny("lambert"), trees["patchy"]).any()
    assert not radiance(OPEN, shiny("translucent"), trees["patchy"]).any()


def test_linear_in_light():
    material = shiny("cook-torrance", roughness=0.3)
    maps = patchy_map(5), patchy_map(6), patchy_map(5) + 2 * patchy_map(6)
    one, two, sum_ = (radiance(BLOCKED, material, sky_tree(splat(latlong_to_cube(m, R)), m, 0.0)) for m in maps)
    # Each sky has its own cells' mean directions, hence twice the quadtree's error above.
    np.testing.assert_allclose(sum_, one + 2 * two, atol=1e-2 * sum_.max())


def test_rows_colours_and_threads(trees):
    tree = trees["patchy"]
    materials = [shiny("phong", shininess=20.0), shiny("cook-torrance")]
    materials[1].specular = (0.5, 0.25, 0.0)
    table = pack_materials(materials)
    rows = np.array([5, 2, 2, 20])
    kind = np.array([0, 1, 0, 1], np.int32)
    found = specular_radiance(BLOCKED, rows, NORMALS[rows], VIEWS[rows], kind, table, tree, threads=3)
    phong = radiance(BLOCKED, materials[0], tree)
    white = radiance(BLOCKED, shiny("cook-torrance"), tree)
    np.testing.assert_array_equal(found[[0, 2]], phong[rows[[0, 2]]])
    np.testing.assert_allclose(found[[1, 3]], white[rows[[1, 3]]] * np.float32([0.5, 0.25, 0.0]), rtol=1e-6)


def sun_in_the_mirror(material, i, height=512):
    """A sun of one pixel (0.35 degrees) where receiver i mirrors to: radiance found, and by 64 x 64 points of it."""
    n, v = NORMALS[i].astype(np.float64), VIEWS[i].astype(np.float64)
    mirror = 2 * (n @ v) * n - v
    width = 2 * height
    row = int((0.5 - math.asin(np.clip(mirror[1], -1, 1)) / math.pi) * height)
    column = int((1 - math.atan2(mirror[0], mirror[2]) / math.pi) * 0.5 * width) % width
    pixels = np.zeros((height, width, 3), np.float32)
    pixels[row, column] = 1e4
    part = (np.arange(64) + 0.5) / 64
    lon = math.pi * (1 - 2 * (column + part) / width)
    low, high = np.sin(math.pi * (0.5 - np.array([row + 1, row]) / height))
    s = (low + (high - low) * part)[:, None] + 0 * lon
    c = np.sqrt(1 - s * s)
    light = np.stack([np.sin(lon) * c, s, np.cos(lon) * c], -1).reshape(-1, 3)
    lobe = evaluate_many(pack_materials([material]), np.array(0), np.zeros(3), n, light, v)[:, 0].mean()
    tree = sky_tree(splat(latlong_to_cube(pixels, R)), pixels, 0.0)
    found = radiance(OPEN[i : i + 1], material, tree, NORMALS[i : i + 1], VIEWS[i : i + 1])[0, 0]
    return found, lobe * 1e4 * 2 * math.pi / width * (high - low)


# The quadtree puts the sun into its own direction; mirrors find it with every sample. 0.035 to 0.1: within 0.1 %; 1e-3
# and 1e-4, phong 1e6: within 2 %.
@pytest.mark.parametrize(
    ("material", "bound"),
    [
        *((shiny("cook-torrance", roughness=m), 0.03) for m in (1e-4, 1e-3)),
        *((shiny("cook-torrance", roughness=m), 3e-3) for m in (0.035, 0.1)),
        (shiny("blinn-phong", shininess=1e3), 3e-3),
        (shiny("blinn-phong", shininess=1e6), 0.06),
    ],
    ids=lambda x: name(x) if hasattr(x, "model") else None,
)
def test_a_small_sun_in_a_lobe(material, bound):
    for i in (0, 8, 16):
        found, truth = sun_in_the_mirror(material, i)
        assert found == pytest.approx(truth, rel=bound)


@pytest.mark.parametrize("roughness", [0.01, 0.02, 0.03])
def test_a_small_sun_in_a_narrow_lobe(roughness):
    for i in (0, 8, 16):
        found, truth = sun_in_the_mirror(shiny("cook-torrance", roughness=roughness), i)
        assert found == pytest.approx(truth, rel=0.1)
