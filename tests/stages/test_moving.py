"""Pictures of moved objects by their fields, against path tracing of the same places, and closed cases.

Errors against the reference are the root of the mean of (x - A)(x - B), A and B two independent references: their
noise drops out. Bounds are those that objects which move are asked for: 8 % of the picture's root mean square, 15 % of
that of the light that was reflected twice. Fields are small here (6 spheres of 6 x 6 x 6 directions, 4 proxies).
"""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import relight_formats as formats
from relightcli.adapters.images import write_image
from relightcli.errors import InputError
from relightcli.scene.model import Camera, Material
from relightcli.stages.moving import MovingStore
from relightcli.stages.relight import Config, relight
from tests.core.transport.scenes import Part, lambert, sphere, sphere_grid
from tests.stages.scene_files import make_store, picture, read_layers, write_scene

CAMERA = Camera("main", (0, 2.5, 4.5), (0, 0.6, 0), fov=40, size=(48, 36))
SMALL = {
    "light_resolution": 32,
    "field_shells": 6,
    "field_resolution": 6,
    "field_proxies": 4,
    "subdivide": False,
}
WHOLE, TWICE = 0.08, 0.15
AWAY = "block=0,1000,0"


def grid(size, cells, albedo):
    """A square that faces up, of cells x cells squares."""
    x = np.linspace(-0.5 * size, 0.5 * size, cells + 1)
    corners = np.stack([*np.meshgrid(x, [0.0], x, indexing="ij")], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    a = (i * (cells + 1) + j).ravel()
    b, c, d = a + 1, a + cells + 1, a + cells + 2
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)])
    return Part(corners, triangles, np.tile([0.0, 1.0, 0.0], (len(corners), 1)), material=lambert(albedo))


def block_of(albedo):
    """A cube of edge 1 with sharp edges."""
    mesh = trimesh.creation.box((1, 1, 1)).subdivide().subdivide().subdivide()
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    return Part(
        corners, np.arange(len(corners)).reshape(-1, 3), np.repeat(mesh.face_normals, 3, 0), material=lambert(albedo)
    )


def smooth_sky():
    """Light from above and from one side."""
    lat, lon = (np.arange(16) + 0.5) / 16 * np.pi, (np.arange(32) + 0.5) / 16 * np.pi
    light = 1 + 0.8 * np.cos(lat)[:, None] + 0.4 * np.sin(lat)[:, None] * np.cos(lon)
    return light[..., None] * np.array([1.0, 0.9, 1.1])


def write(folder, albedo=(0.5, 0.7, 0.7), more="", **parts):
    parts = {"ground": grid(6, 48, albedo[0]), "ball": sphere(0.5, rings=10, material=lambert(albedo[1])), **parts}
    parts.setdefault("block", block_of(albedo[2]))
    maps = {"smooth": smooth_sky(), "even": np.ones((4, 8, 3))}
    path = write_scene(folder, parts, [CAMERA], maps, more=more)
    text = path.read_text()
    for name, place in (("ball", [0, 0.6, 0]), ("block", [1.2, 0.5, 0])):
        text = text.replace(f"mesh = '{name}.obj'", f"mesh = '{name}.obj'\nmotion = 'rigid'\ntranslate = {place}")
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return tmp_path_factory.mktemp("library")


@pytest.fixture(scope="module")
def store(tmp_path_factory, library):
    return make_store(write(tmp_path_factory.mktemp("moving")), **SMALL, bounces=2, field_library=library)


def layers(store, name, moves, **settings):
    output = store.parent / f"{name}.exr"
    config = {"env": "smooth", "layers": True, "workers": 1, "quiet": True, **settings}
    relight(Config(store=store, output=str(output), moves=moves, **config))
    return read_layers(output)


def errors(store, moves, **settings):
    """Relative error of every layer against the reference; "together": of a picture that is not split into layers."""
    ours = layers(store, "ours", moves, **settings)
    ours["together"] = layers(store, "together", moves, **settings, layers=False)[""]
    refs = [layers(store, f"ref{s}", moves, reference=True, spp=64, seed=s, **settings) for s in (0, 1)]
    out = {}
    for name in sorted({"", "direct", "one_bounce", "together"} & ours.keys()):
        x, (a, b) = ours[name], (ref["" if name == "together" else name] for ref in refs)
        out[name] = np.sqrt(max(float(((x - a) * (x - b)).mean()), 0.0) / float((a * b).mean()))
    return out


@pytest.mark.parametrize(
    "moves",
    [
        ("ball=0,0.5,0", AWAY),
        ("ball=0,0.7,0", AWAY),
        ("ball=0.3,1.5,0.2", AWAY),
        ("ball=0,1000,0", "block=0.3,0.5,0.2,0,30,0"),
        ("ball=0.1,0.5,0.4", "block=-0.8,0.5,0,0,20,0"),
        ("ball=0,1.3,0", "block=0,0.5,0,0,45,0"),
    ],
)
def test_things_that_are_moved_look_as_in_the_reference(store, moves):
    found = errors(store, moves)
    assert max(found[""], found["together"]) <= WHOLE
    assert found["direct"] <= WHOLE
    assert found["one_bounce"] <= TWICE


def test_what_an_object_reflects_on_itself_is_a_reflection_more(tmp_path):
    """A bowl on its own, lit by the sky: by layer, in the sum of one interreflection, and without any."""
    corners, triangles = sphere_grid(10, 40, np.pi / 2, np.pi)
    bowl = Part(corners, triangles[:, ::-1], -corners, material=lambert(0.8))
    scene = write_scene(tmp_path, {"bowl": bowl}, [CAMERA], {"smooth": smooth_sky()})
    text = scene.read_text().replace("mesh = 'bowl.obj'", "mesh = 'bowl.obj'\nmotion = 'rigid'")
    scene.write_text(text)
    store = make_store(scene, **SMALL, bounces=1)
    for moves in ((), ("bowl=0,0.3,0.5,0,0,20",)):
        found = errors(store, moves)
        found["alone"] = errors(store, moves, bounces=0)["together"]
        assert max(found.values()) <= 0.04, found  # four bands of a smooth sky: half of what pictures are allowed


def test_a_moved_lamp_lights_what_stands_and_what_moves(tmp_path, library):
    lamp = "[lights.lamp]\nshape = 'sphere'\ncenter = [2, 3, 0]\nradius = 0.3\nradiance = [20, 20, 20]\n"
    lamp += (
        "[lights.panel]\nshape = 'rectangle'\ncenter = [0, 3, 0]\nedge_u = [1, 0, 0]\nedge_v = [0, 0, 1]\n"
        "radiance = [3, 2, 1]\n"
    )
    path = make_store(write(tmp_path, more=lamp), **SMALL, bounces=1, field_library=library)
    for moves in ((), ("lamp=-1,3,1", "ball=0,0.7,0"), ("panel=1,2,1,0,0,-30", AWAY)):
        found = errors(path, moves, env="even")
        assert found[""] <= WHOLE
        assert found["one_bounce"] <= TWICE


def test_white_things_under_an_even_sky_shine_as_it_does(tmp_path, library):
    """Cut to four bands, the horizon of a floor costs a point that faces the sky 1.4 %; what is left after eight
    reflections is below 0.3 %."""
    path = make_store(write(tmp_path, albedo=(1.0, 1.0, 1.0)), **SMALL, bounces=8, field_library=library)
    for k, moves in enumerate((("ball=-1.5,0.9,0", "block=1,1,0.3,10,20,30"), ("ball=1000,0,0", AWAY))):
        output = tmp_path / f"white{k}.zarr"
        relight(Config(store=path, output=str(output), env="even", moves=moves, workers=1, quiet=True))
        radiance = formats.open_store(output).read("radiance")[0]
        assert np.abs(radiance - 1.0).max() < (0.02, 0.001)[k]


def test_what_is_far_away_leaves_no_trace(store, tmp_path):
    parts = {"ground": grid(6, 48, 0.5)}
    alone = make_store(write_scene(tmp_path, parts, [CAMERA], {"smooth": smooth_sky()}), **SMALL, bounces=2)
    wanted, _ = picture(alone)
    found, _ = picture(store, env="smooth", moves=("ball=0,1000,0", "block=1000,0,0"))
    np.testing.assert_allclose(found, wanted, atol=1e-4 * wanted.max())


def test_no_light_comes_through_a_wall(tmp_path, library):
    """A ball close behind a wall: what is before the wall gains 0.4 % of the brightest at most, and loses 2.4 %, as
    four bands of what the ball hides reach around the wall."""
    wall = grid(6, 24, 0.5)
    turned = wall.corners[:, [1, 0, 2]] + np.array([0.0, 2.9, 0.0])
    parts = {"wall": Part(turned, wall.triangles[:, ::-1], wall.normals[:, [1, 0, 2]], material=lambert(0.5))}
    parts["wall"].two_sided = True
    path = make_store(write(tmp_path, **parts), **SMALL, bounces=2, field_library=library)
    lit = MovingStore(path, 1)
    found = []
    for moves in (("ball=-0.8,0.6,0", AWAY), ("ball=-1000,0,0", AWAY)):
        lit.set_moves(moves)
        found.append(lit.exit_radiance(smooth_sky().astype(np.float32), 0.0, lit.scene.materials, None))
    before = lit.position[: lit.static, 0] > 0.05
    for number in range(3):
        a, b = (part[number].diffuse[: lit.static][before] for part in found)
        assert (a - b).max() < 0.01 * b.max()
        assert (b - a).max() < 0.05 * b.max()


def test_frames_move_things(store, tmp_path):
    keys = tmp_path / "shots.toml"
    keys.write_text(
        "format = 1\nframes = 3\n[[key]]\nframe = 1\nmove = { ball = [0, 0.5, 0] }\n"
        "[[key]]\nframe = 3\nmove = { ball = [0, 1.5, 0] }\n"
    )
    result = relight(
        Config(store=store, output=str(tmp_path / "f##.exr"), env="smooth", frames=keys, workers=1, quiet=True)
    )
    assert result["frames"] == 3
    for number, height in ((1, 0.5), (2, 1.0), (3, 1.5)):
        alone, _ = picture(store, env="smooth", moves=(f"ball=0,{height},0",))
        np.testing.assert_array_equal(read_layers(tmp_path / f"f0{number}.exr")[""], alone)


def test_radiance_and_meshes_follow(store, tmp_path):
    for name in ("a.zarr", "a.ply"):
        relight(
            Config(
                store=store,
                output=str(tmp_path / name),
                env="smooth",
                moves=("ball=0,1.5,0", "block=2,0.5,0,0,90,0"),
                workers=1,
                quiet=True,
            )
        )
    radiance = formats.open_store(tmp_path / "a.zarr")
    about = formats.open_store(store).attrs["fields"]["objects"]
    rows = {name: slice(entry["first"], entry["first"] + entry["count"]) for name, entry in about.items()}
    two = tmp_path / "two.zarr"
    moves = ("ball=0,1.5,0", "block=2,0.5,0,0,90,0")
    relight(Config(store=store, output=str(two), env="smooth", moves=moves, workers=2, quiet=True))
    np.testing.assert_array_equal(formats.open_store(two).read("radiance"), radiance.read("radiance"))
    position = radiance.read("receivers/position")[0]
    np.testing.assert_allclose(position[rows["ball"]].mean(0), (0, 1.5, 0), atol=0.02)
    np.testing.assert_allclose(np.ptp(position[rows["block"]], axis=0), 1.0, atol=1e-9)
    assert radiance.read("radiance")[0].min() >= 0.0
    vertices = trimesh.load(tmp_path / "a.ply", process=False).vertices
    assert vertices[:, 1].max() == pytest.approx(2.0, abs=1e-5)
    assert vertices[:, 0].max() == pytest.approx(3.0, abs=1e-5)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"moves": ("ball=2,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1",)}, "--move ball: expected a matrix that turns"),
        ({"moves": ("ball=-1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1",)}, "--move ball: expected a matrix that turns"),
        ({"moves": ("ground=0,0,0",)}, r"objects.ground.motion is 'static'"),
        ({"moves": ("bal=0,0,0",)}, "no object or light 'bal'"),
        ({"poses": ("ball=walk@0",)}, "--pose"),
    ],
)
def test_refusals(store, settings, message):
    with pytest.raises(InputError, match=message):
        picture(store, env="smooth", **settings)


def test_sizes_may_change(store):
    """Half the size at half the distance from the floor: the field is the same one."""
    found = errors(store, ("ball=0.5,0,0,0,0,0.5,0,0.3,0,0,0.5,0,0,0,0,1", AWAY))
    assert found[""] <= WHOLE


def test_the_diffuse_colour_of_what_moves_may_change(tmp_path, library):
    """As if the scene file had said so, for a block and a ball that do not see themselves: direct light to round-off,
    and what follows within the errors of the two compressed transfers."""
    path = write(tmp_path)
    path.write_text(path.read_text().replace("adjustable = false", "adjustable = true"))
    made = make_store(path, **SMALL, bounces=2, field_library=library)
    colour = (0.2, 0.5, 0.9)
    settings = tuple(f"{name}.diffuse={colour[0]},{colour[1]},{colour[2]}" for name in ("ball", "block"))
    moves = ("ball=0.1,0.5,0.4", "block=-0.8,0.5,0,0,20,0")
    before = layers(made, "before", moves)["direct"]
    ours = layers(made, "ours", moves, settings=settings)
    assert np.abs(before - ours["direct"]).max() > 0.1
    text = path.read_text().replace("adjustable = true", "adjustable = false")  # and simulated for this colour alone
    path.write_text(text.replace("diffuse = [0.7, 0.7, 0.7]", f"diffuse = {list(colour)}"))
    anew = layers(make_store(path, "anew.zarr", **SMALL, bounces=2, field_library=library), "anew", moves)
    for name in ("direct", "one_bounce", "two_bounce"):
        missing = np.sqrt(((ours[name] - anew[name]) ** 2).mean() / (anew[name] ** 2).mean())
        assert missing < (1e-5 if name == "direct" else 0.01), name
    with pytest.raises(InputError, match=r"--set ball: is the material of 'ball', which moves: .* only the diffuse"):
        picture(made, env="smooth", settings=("ball=brass",))


def test_the_materials_of_several_movers_may_change(tmp_path, library):
    """As if the scene file had said so, for a ball and a block that do not see themselves: their own points within the
    error of the compressed self transfer, 1 %; what they send within those of both compressed fields, 2 % each, and
    what four functions leave of a lobe. Against path tracing: `benchmarks moving`."""

    def materials(ball, block):
        parts = {"ball": sphere(0.5, rings=10), "block": block_of(0.5)}
        for name, values in (("ball", ball), ("block", block)):
            diffuse, specular, f0, roughness = values
            parts[name].material = Material("m", "cook-torrance", diffuse, specular, f0=f0, roughness=roughness)
        return parts

    old = ((0.1, 0.1, 0.1), (0.8, 0.7, 0.5), 0.6, 0.3), ((0.6, 0.5, 0.4), (0.1, 0.1, 0.1), 0.2, 0.6)
    new = ((0.6, 0.2, 0.1), (0.1, 0.1, 0.1), 0.3, 0.6), ((0.05, 0.05, 0.05), (0.9, 0.8, 0.6), 0.8, 0.4)
    path = write(tmp_path, **materials(*old))
    path.write_text(path.read_text().replace("adjustable = false", "adjustable = true"))
    made = make_store(path, **SMALL, bounces=1, field_library=library)
    settings = []
    for name, (diffuse, specular, f0, roughness) in zip(("ball", "block"), new, strict=True):
        settings += [f"{name}.{k}={','.join(map(str, v))}" for k, v in (("diffuse", diffuse), ("specular", specular))]
        settings += [f"{name}.f0={f0}", f"{name}.roughness={roughness}"]
    moves = ("ball=0.1,0.5,0.4", "block=-0.8,0.5,0,0,20,0")
    before = layers(made, "before", moves)
    ours = layers(made, "ours", moves, settings=tuple(settings))
    anew = write(tmp_path / "anew", **materials(*new))
    anew = layers(make_store(anew, **SMALL, bounces=1, field_library=library), "anew", moves)
    for name, bound in (("direct", 1e-5), ("specular", 0.01), ("one_bounce", 0.03)):
        missing = np.sqrt(((ours[name] - anew[name]) ** 2).mean() / (anew[name] ** 2).mean())
        assert missing < bound, name
        assert np.sqrt(((before[name] - anew[name]) ** 2).mean() / (anew[name] ** 2).mean()) > 5 * bound, name


def test_stores_without_fields_move_nothing(tmp_path):
    path = make_store(write(tmp_path), **SMALL, effects="direct,shadows")
    with pytest.raises(InputError, match=r"--move: .* lights its objects where they stood"):
        picture(path, env="smooth", moves=("ball=0,1,0",))


def sunny_sky():
    """A dim smooth sky with a sun of one pixel, 0.7 degrees wide, 50 degrees up, that sends two thirds of the light
    that falls on a floor."""
    light = np.repeat(np.repeat(0.3 * smooth_sky(), 16, axis=0), 16, axis=1)
    row, column = 256 * 40 // 180, 40
    solid = np.cos(np.pi * row / 256) - np.cos(np.pi * (row + 1) / 256)
    light[row, column] += 2.0 / (solid * 2 * np.pi / 512)
    return light


def test_traced_suns_are_as_sharp_as_in_the_reference(tmp_path, library):
    """A floor and two movers, in the sun: within the bounds of smooth skies, and several times nearer than by fields
    alone, which smear a shadow over some 45 degrees."""
    path = write(tmp_path)
    write_image(tmp_path / "sunny-sky.exr", sunny_sky().astype(np.float32))
    path.write_text(path.read_text() + "[environments.sunny]\nmap = 'sunny-sky.exr'\n")
    made = make_store(path, **SMALL, bounces=1, field_library=library)
    moves = ("ball=0.1,0.8,0.4", "block=-0.8,0.5,0,0,20,0")
    reference = [layers(made, f"r{s}", moves, env="sunny", reference=True, spp=64, seed=s) for s in (0, 1)]
    a, b = (r[""] for r in reference)
    found = {}
    for kind in ("soft", "traced"):
        x = layers(made, kind, moves, env="sunny", suns=kind, layers=False)[""]
        found[kind] = np.sqrt(max(float(((x - a) * (x - b)).mean()), 0.0) / float((a * b).mean()))
    assert found["traced"] <= WHOLE
    assert found["traced"] < 0.5 * found["soft"]
    x = layers(made, "layers", moves, env="sunny", suns="traced")[""]
    apart = np.sqrt(max(float(((x - a) * (x - b)).mean()), 0.0) / float((a * b).mean()))
    assert apart == pytest.approx(found["traced"], rel=0.2)  # they differ where a layer alone would be negative


def test_suns_want_something_that_moves(store, tmp_path):
    still = make_store(write(tmp_path), **SMALL, effects="direct,shadows")
    with pytest.raises(InputError, match=r"--suns traced: .* holds nothing that may be moved"):
        picture(still, env="smooth", suns="traced")
    with pytest.raises(InputError, match=r"--suns traced: --reference"):
        picture(store, env="smooth", suns="traced", reference=True)
