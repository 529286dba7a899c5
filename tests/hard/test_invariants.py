"""What no change of words may change: scale, order of vertices and faces, a common turn, sums of lights and of layers.

Scenes go through the real stages: a bowl in which light bounces, shiny things that hang in the air and shade each
other, and lamps. `within` notes every figure for docs/hard-cases.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from relightcli.adapters.images import write_image
from relightcli.scene.model import Camera, Material
from relightcli.stages.relight import Config, relight
from tests.core.transport.scenes import Part, lambert, sphere, square
from tests.stages.scene_files import make_store, read_layers, write_scene

CAMERA = Camera("main", (0.6, 2.0, 3.2), (0.0, 0.3, 0.0), fov=42, size=(24, 18))
GOLD = Material("m", "cook-torrance", (0.2, 0.15, 0.1), (0.7, 0.6, 0.4), f0=0.8, roughness=0.35)
LACQUER = Material("m", "blinn-phong", (0.3, 0.1, 0.1), (0.3, 0.3, 0.3), shininess=40.0)
LAMPS = """
[lights.ball]
shape = "sphere"
center = [{0}, {1}, {2}]
radius = {3}
radiance = [4.0, 3.0, 2.0]
"""


def bowl(rings=12):
    """The lower half of a shell, open at the top, seen from inside, and a ball in it."""
    shell = sphere(1.0, (0, 0.6, 0), rings=rings, material=lambert((0.8, 0.6, 0.4)))
    low = (shell.corners[shell.triangles][:, :, 1] < 0.62).all(axis=1)
    return {
        "shell": Part(shell.corners, shell.triangles[low][:, ::-1], -shell.normals, material=shell.material),
        "ball": sphere(0.25, (0.1, 0.1, 0.15), rings=8, material=lambert(0.5)),
    }


def shiny(rings=10):
    return {
        "floor": square(4.0, material=lambert(0.4)),
        "gold": sphere(0.4, (-0.45, 0.5, 0.1), rings=rings, material=GOLD),
        "lacquer": sphere(0.3, (0.4, 0.5, 0.3), rings=rings, material=LACQUER),
    }


# What a scene is made of, and where it has a lamp.
SCENES = {"bowl": (bowl, None), "shiny": (shiny, None), "lamp": (shiny, (0.9, 1.3, 0.8, 0.2))}


def sky(seed, height=8):
    return np.random.default_rng(seed).random((height, 2 * height, 3)) + 0.05


def build(folder, name, change=None, camera=CAMERA, lamp=None):
    make, own = SCENES[name]
    parts = make()
    if change:
        parts = {key: change(part) for key, part in parts.items()}
    lamp = lamp or own
    more = LAMPS.format(*lamp) if lamp else ""
    path = write_scene(folder, parts, [camera], {"sky": sky(1)}, adjustable=True, more=more)
    # Few receivers hang on how faces lie to each other in the file: large faces are not cut, and nothing is planned.
    return make_store(path, light_resolution=16, bounce_resolution=8, bounces=1, subdivide=False)


def layers(store, pixels=None, **settings):
    env = {}
    if pixels is not None:
        path = store.parent / "given.exr"
        write_image(path, np.asarray(pixels, np.float32))
        env = {"env": str(path)}
    output = store.parent / "out.exr"
    relight(Config(store=store, output=str(output), layers=True, workers=1, quiet=True, **env, **settings))
    found = read_layers(output)
    for rgb in found.values():
        assert np.isfinite(rgb).all()
    assert found[""].min() >= 0.0
    return found


@pytest.fixture(scope="module", params=sorted(SCENES))
def scene(request, tmp_path_factory):
    """Name, store and layers of a scene as it stands."""
    store = build(tmp_path_factory.mktemp(request.param), request.param)
    return request.param, store, layers(store)


def apart(found, wanted):
    """Largest difference as a part of the brightest pixel."""
    return float(np.abs(found.astype(np.float64) - wanted).max() / wanted.max())


def shuffled_vertices(part):
    order = np.random.default_rng(3).permutation(len(part.corners))
    back = np.argsort(order)
    return replace(
        part,
        corners=part.corners[order],
        normals=part.normals[order],
        triangles=back[part.triangles],
        uvs=None,
    )


def shuffled_faces(part):
    order = np.random.default_rng(4).permutation(len(part.triangles))
    return replace(part, triangles=part.triangles[order], uvs=None)


def turned(part, turn):
    return replace(part, corners=part.corners @ turn.T, normals=part.normals @ turn.T, uvs=None)


def quarter(k):
    """A turn by k quarters about +Y, free of rounding."""
    c, s = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[k]
    return np.array([[c, 0, s], [0, 1.0, 0], [-s, 0, c]])


def test_layers_add_up_to_the_picture(scene, within):
    """float32 sums of three or four layers: some roundings of 2^-24."""
    name, _, found = scene
    total = sum(rgb.astype(np.float64) for key, rgb in found.items() if key not in ("", "A"))
    within(f"{name}: beauty less its layers", apart(total, found[""]), 1e-6)


@pytest.mark.parametrize("factor", [2.0**-10, 1e6])
def test_linear_in_brightness(scene, within, factor):
    """Every step scales alike in float32, thresholds are shares of the whole: some roundings of sums."""
    name, store, _ = scene
    if name == "lamp":
        pytest.skip("a lamp does not scale with the sky")
    one, other = layers(store, sky(2))[""], layers(store, sky(2) * factor)[""]
    within(f"{name}: sky times {factor:g}", apart(other / factor, one), 5e-6)


def test_sum_of_two_skies(scene, within):
    """Superposition. A texel's light is put where its mean direction is, which moves by a part of a texel as skies are
    mixed: at the edge of a shadow less than one texel of 1536. Of shiny things the brightest texels are treated point
    by point and the rest as broad lobes, and which are brightest differs: twice as much."""
    name, store, _ = scene
    if name == "lamp":
        pytest.skip("a lamp would count twice")
    a, b = sky(2), 3.0 * sky(5)
    both = layers(store, a + b)[""].astype(np.float64)
    apart_ = layers(store, a)[""].astype(np.float64) + layers(store, b)[""]
    within(f"{name}: two skies", apart(apart_, both), 1e-3 if name == "bowl" else 2e-3)


@pytest.mark.parametrize("exponent", [-20, 20])
def test_size(tmp_path, scene, within, exponent):
    """A power of two leaves every mantissa as it is: the picture is the same, to the bit."""
    name, _, wanted = scene
    scale = 2.0**exponent
    camera = replace(CAMERA, eye=tuple(scale * x for x in CAMERA.eye), target=tuple(scale * x for x in CAMERA.target))
    own = SCENES[name][1]
    lamp = tuple(scale * x for x in own) if own else None
    store = build(tmp_path, name, lambda p: replace(p, corners=p.corners * scale), camera, lamp)
    within(f"{name}: 2^{exponent} times as large", apart(layers(store)[""], wanted[""]), 0.0)


@pytest.mark.parametrize("change", [shuffled_vertices, shuffled_faces])
def test_order_in_the_file(tmp_path, scene, within, change):
    """Receivers lie along a curve through space, whatever their order; random numbers hang on that. Rays that meet an
    edge may find the one face or the other: single cells of 384, of a bounce that carries a third of the light."""
    name, _, wanted = scene
    store = build(tmp_path, name, change)
    found = layers(store)
    within(f"{name}, {change.__name__}: direct light", apart(found["direct"], wanted["direct"]), 1e-5)
    within(f"{name}, {change.__name__}: all", apart(found[""], wanted[""]), 2e-3)


@pytest.mark.parametrize("k", [1, 2])
def test_scene_and_sky_turn_together(tmp_path, scene, within, k):
    """Quarter turns take the cube's texels to texels: direct light of matte things stays but for roundings, which may
    move texels at a horizon. Bounces draw other rays: at 384 cells some percent of the share that they carry."""
    name, _, wanted = scene
    turn = quarter(k)
    camera = replace(CAMERA, eye=tuple(turn @ CAMERA.eye), target=tuple(turn @ CAMERA.target))
    own = SCENES[name][1]
    lamp = (*(turn @ own[:3]), own[3]) if own else None
    store = build(tmp_path, name, lambda p: turned(p, turn), camera, lamp)
    found = layers(store, env_rotate=90.0 * k)
    scale = wanted[""].max()
    direct = np.abs(found["direct"].astype(np.float64) - wanted["direct"])
    within(f"{name}: direct light, {90 * k} degrees, rms", float(np.sqrt((direct**2).mean()) / scale), 3e-3)
    both = np.abs(found[""].astype(np.float64) - wanted[""])
    within(f"{name}: all, {90 * k} degrees, rms", float(np.sqrt((both**2).mean()) / scale), 5e-3)


def test_white_under_a_white_sky(tmp_path, within):
    """Furnace: with albedo 1 everywhere light is neither made nor lost, only not yet out: after 12 bounces between
    walls that see the sky with half of their hemisphere nothing is left. It is never above 1 but for the texels'
    quadrature, 1 % at 16 a side. Below 1 is what leaves a vertex within a facet's angle of 7.5 degrees of its horizon:
    it meets the next facet from behind the shading normal, and sin^2 of that, 1.7 %, is lost, about twice over."""
    parts = bowl(24)
    for part in parts.values():
        part.material = lambert(1.0)
    into = Camera("main", (0.0, 4.0, 0.0), (0.0, 0.0, 0.01), fov=18, size=(16, 12))
    path = write_scene(tmp_path, parts, [into], {"sky": np.ones((4, 8, 3))})
    store = make_store(path, light_resolution=16, bounce_resolution=8, bounces=12, subdivide=False)
    found = layers(store)
    assert found["A"].min() > 1 - 1e-6
    within("above 1 after 12 bounces", float(found[""].max() - 1), 0.01)
    within("light not yet out after 12 bounces, mean", float(1 - found[""].mean()), 0.035)
    assert (found["direct"] <= found[""] + 1e-6).all()
