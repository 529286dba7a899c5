import math
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from relightcli.errors import InputError, SystemFault
from relightcli.scene import parse
from relightcli.scene.model import Camera, Material, RectangleLight, Scene, SphereLight
from relightcli.scene.parse import load_scene

OBJECT = '[objects.a]\nmesh = "triangle.obj"\nmaterial = "m"\n'
MATERIAL = '[materials.m]\nmodel = "lambert"\n'
MINIMAL = "format = 1\n" + OBJECT + MATERIAL

FULL = """\
format = 1
[objects.bunny]
mesh = "triangle.obj"
material = "gold"
translate = [0, 1, 2]
rotate = [0, 1, 0, 90]
scale = 2
two_sided = true
motion = "rigid"
[objects.other]
mesh = "./triangle.obj"
material = "skin"
transform = [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]
[materials.gold]
model = "cook-torrance"
diffuse = [0.05, 0.04, 0.02]
specular = [0.9, 0.7, 0.3]
f0 = 0.8
roughness = 0.25
diffuse_texture = "wood.png"
adjustable = true
[materials.skin]
model = "translucent"
diffuse = [0.3, 0.3, 0.3]
transmittance = [0.7, 0.2, 0]
[materials.shiny]
model = "blinn-phong"
shininess = 0
[lights.lamp]
shape = "sphere"
center = [0, 2, 0]
radius = 0.1
radiance = [20, 20, 18]
[lights.panel]
shape = "rectangle"
center = [0, 2, 0]
edge_u = [1, 0, 0]
edge_v = [0, 0, 1]
radiance = [0, 0, 0]
[environments.sky]
map = "sky.exr"
[cameras.main]
eye = [0, 1, 4]
target = [0, 0.5, 0]
up = [0, 2, 0]
fov = 40
size = [320, 16384]
[accuracy]
tolerance = 0.05
"""


def write(folder: Path, text: str | bytes) -> Path:
    path = folder / "scene.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_everything_the_format_has(scene_folder):
    scene = load_scene(write(scene_folder, FULL))
    assert list(scene.objects) == ["bunny", "other"]
    bunny = scene.objects["bunny"]
    assert bunny.mesh == scene_folder / "triangle.obj"
    assert bunny.material == "gold"
    assert bunny.two_sided
    assert bunny.motion == "rigid"
    # Scale 2, a quarter turn about +Y (+X to -Z, +Z to +X), then the translation; exact.
    assert bunny.transform.tolist() == [[0, 0, 2, 0], [0, 2, 0, 1], [-2, 0, 0, 2], [0, 0, 0, 1]]
    assert scene.objects["other"].transform[:3, 3].tolist() == [5, 6, 7]
    assert scene.objects["other"].motion == "static"
    assert scene.materials["gold"] == Material(
        "gold",
        "cook-torrance",
        diffuse=(0.05, 0.04, 0.02),
        specular=(0.9, 0.7, 0.3),
        f0=0.8,
        roughness=0.25,
        diffuse_texture=scene_folder / "wood.png",
        adjustable=True,
    )
    assert scene.materials["skin"].transmittance == (0.7, 0.2, 0.0)
    assert scene.materials["shiny"] == Material("shiny", "blinn-phong", shininess=0.0)
    assert scene.lights["lamp"] == SphereLight("lamp", (0, 2, 0), 0.1, (20, 20, 18))
    assert scene.lights["panel"] == RectangleLight("panel", (0, 2, 0), (1, 0, 0), (0, 0, 1), (0, 0, 0))
    assert scene.environments == {"sky": scene_folder / "sky.exr"}
    assert scene.cameras["main"] == Camera("main", (0, 1, 4), (0, 0.5, 0), (0, 2, 0), 40.0, (320, 16384))
    assert scene.tolerance == 0.05
    assert scene.notes == ()


def test_defaults(scene_folder):
    scene = load_scene(write(scene_folder, MINIMAL))
    assert np.array_equal(scene.objects["a"].transform, np.eye(4))
    assert not scene.objects["a"].two_sided
    assert scene.materials == {"m": Material("m")}
    assert scene.lights == scene.environments == scene.cameras == {}
    assert scene.tolerance == 0.02


def test_a_flat_row_major_transform(scene_folder):
    text = MINIMAL.replace('material = "m"\n', 'material = "m"\ntransform = [2,0,0,5, 0,1,0,6, 0,0,1,7, 0,0,0,1]\n')
    matrix = load_scene(write(scene_folder, text)).objects["a"].transform
    assert matrix.tolist() == [[2, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]


def test_too_much_energy_is_allowed_and_noted(scene_folder):
    bright = "[materials.m]\nmodel = 'phong'\ndiffuse = [0.6, 0.1, 0.1]\nspecular = [0.6, 0.1, 0.1]\n"
    scene = load_scene(write(scene_folder, MINIMAL.replace(MATERIAL, bright)))
    assert len(scene.notes) == 1
    assert "materials.m: diffuse + specular is 1.2" in scene.notes[0]


def _object(lines: str) -> str:
    return MINIMAL.replace('material = "m"\n', f'material = "m"\n{lines}\n')


def _material(lines: str) -> str:
    return MINIMAL.replace('model = "lambert"\n', f"{lines}\n")


def _sphere(lines: str) -> str:
    fields = {"shape": '"sphere"', "center": "[0, 0, 0]", "radius": "1", "radiance": "[1, 1, 1]"}
    return _section("lights.l", fields, lines)


def _rectangle(lines: str) -> str:
    fields = {"shape": '"rectangle"', "center": "[0, 0, 0]", "edge_u": "[1, 0, 0]", "edge_v": "[0, 1, 0]"}
    return _section("lights.l", {**fields, "radiance": "[1, 1, 1]"}, lines)


def _camera(lines: str) -> str:
    return _section("cameras.c", {"eye": "[0, 1, 4]", "target": "[0, 0.5, 0]"}, lines)


def _section(name: str, fields: dict[str, str], lines: str) -> str:
    """The minimal scene with one more table; `lines` replace its fields, `-key` removes one."""
    for line in lines.split("\n"):
        key, _, value = line.partition(" = ")
        if key.startswith("-"):
            fields.pop(key[1:])
        else:
            fields[key] = value
    return MINIMAL + f"[{name}]\n" + "".join(f"{k} = {v}\n" for k, v in fields.items())


@pytest.mark.parametrize(
    ("text", "key", "words"),
    [
        # the file as a whole
        (OBJECT + MATERIAL, "format", "expected format = 1, found nothing"),
        (MINIMAL.replace("format = 1", "format = 2"), "format", "expected 1, found 2 (integer)"),
        (MINIMAL.replace("format = 1", "format = true"), "format", "expected 1, found True (boolean)"),
        (MINIMAL.replace("format = 1", "format = '1'"), "format", "(string)"),
        ("format = 1\n" + MATERIAL, "objects", "at least one object"),
        ("format = 1\nobjects = 3\n", "objects", "expected a table, found 3"),
        (MINIMAL + "[camera.main]\n", "camera", "Did you mean 'cameras'?"),
        (MINIMAL + '"ob\\njects" = 1\n', "materials.m.'ob\\njects...'", "unknown key"),
        (MINIMAL + "[" + "x" * 5000 + "]\n", "'xxxx", "unknown key"),
        (MINIMAL.replace("[objects.a]", "[objects]\nb = 1\n[objects.a]"), "objects.b", "expected a table"),
        (MINIMAL + OBJECT, "", "not valid TOML"),
        (MINIMAL.replace("objects.a", 'objects.""'), "objects", "name of 1 to 128"),
        (MINIMAL.replace("objects.a", 'objects."a=b"'), "objects", "name of 1 to 128"),
        (MINIMAL.replace("objects.a", 'objects."a\\u0007"'), "objects", "name of 1 to 128"),
        # objects
        (MINIMAL.replace('mesh = "triangle.obj"\n', ""), "objects.a.mesh", "expected a string, found nothing"),
        (MINIMAL.replace('"triangle.obj"', "7"), "objects.a.mesh", "found 7 (integer)"),
        (MINIMAL.replace('"triangle.obj"', '""'), "objects.a.mesh", "found '' (string)"),
        (MINIMAL.replace("triangle", "none"), "objects.a.mesh", "no such file"),
        (MINIMAL.replace("triangle.obj", "."), "objects.a.mesh", "not a regular file"),
        (MINIMAL.replace("triangle.obj", "a\\u0000b"), "objects.a.mesh", "no usable path"),
        (MINIMAL.replace("triangle.obj", "a" * 5000), "objects.a.mesh", "name too long"),
        (MINIMAL.replace("triangle.obj", "../outside.obj"), "objects.a.mesh", "--allow-outside"),
        (MINIMAL.replace("triangle.obj", "/etc/hostname"), "objects.a.mesh", "--allow-outside"),
        (MINIMAL.replace('material = "m"\n', ""), "objects.a.material", "found nothing"),
        (MINIMAL.replace('material = "m"', 'material = "n"'), "objects.a.material", "expected one of m, found 'n'"),
        (MINIMAL.replace(MATERIAL, ""), "objects.a.material", "the file defines none"),
        (_object("colour = 3"), "objects.a.colour", "unknown key; expected one of mesh"),
        (_object("two-sided = true"), "objects.a.two-sided", "Did you mean 'two_sided'?"),
        (_object("two_sided = 1"), "objects.a.two_sided", "expected true or false, found 1"),
        (_object('motion = "moving"'), "objects.a.motion", "one of static, rigid, skinned"),
        (_object("translate = [1, 2]"), "objects.a.translate", "expected 3 numbers, found [1, 2] (array)"),
        (_object("translate = [1, 2, true]"), "objects.a.translate", "3 numbers"),
        (_object("translate = [1, 2, nan]"), "objects.a.translate", "3 numbers"),
        (_object("translate = [1, 2, 1e999]"), "objects.a.translate", "3 numbers"),
        (_object("translate = [1, 2, 1979-05-27]"), "objects.a.translate", "3 numbers"),
        (_object("translate = 1"), "objects.a.translate", "3 numbers"),
        (_object(f"scale = 1{'0' * 400}"), "objects.a.scale", "expected a number"),
        (_object(f"scale = 1{'0' * 5000}"), "", "not valid TOML"),
        (_object("scale = 0"), "objects.a.scale", "other than 0"),
        (_object("scale = [1, 0.0, 1]"), "objects.a.scale", "other than 0"),
        (_object("scale = [1, 1]"), "objects.a.scale", "3 numbers"),
        (_object("scale = [1e200, 1, 1]"), "objects.a.scale", "flattens"),
        (_object("scale = '2'"), "objects.a.scale", "expected a number"),
        (_object("rotate = [0, 0, 0, 90]"), "objects.a.rotate", "axis that is not 0 0 0"),
        (_object("rotate = [0, 1, 0]"), "objects.a.rotate", "expected 4 numbers"),
        (_object("transform = [1, 2]"), "objects.a.transform", "4 rows of 4 numbers"),
        (_object("transform = [[1,0,0,0],[0,1,0,0],[0,0,1,0]]"), "objects.a.transform", "4 rows of 4 numbers"),
        (_object("transform = [1,0,0,0, 0,1,0,0, 0,0,1,0, 5,6,7,1]"), "objects.a.transform", "row-major"),
        (_object("transform = [1,0,0,0, 0,1,0,0, 0,0,true,0, 0,0,0,1]"), "objects.a.transform", "16 numbers"),
        (_object("transform = [1,0,0,0, 0,0,0,0, 0,0,1,0, 0,0,0,1]"), "objects.a.transform", "does not flatten"),
        (
            _object("transform = [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]\nscale = 2"),
            "objects.a.scale",
            "either `transform` or translate/rotate/scale, found both",
        ),
        # materials
        (_material('model = "phnog"'), "materials.m.model", "Did you mean 'phong'?"),
        (_material("model = 1"), "materials.m.model", "expected one of lambert"),
        (_material("diffuse = [0.5, 0.5]"), "materials.m.diffuse", "3 numbers from 0 to 1"),
        (_material("diffuse = [-0.1, 0.5, 0.5]"), "materials.m.diffuse", "found [-0.1, 0.5, 0.5]"),
        (_material("diffuse = [0.5, 1.1, 0.5]"), "materials.m.diffuse", "from 0 to 1"),
        (_material("difuse = [0.5, 0.1, 0.5]"), "materials.m.difuse", "Did you mean 'diffuse'?"),
        (_material("f0 = 0.1"), "materials.m.f0", "lambert does not use it; it belongs to cook-torrance"),
        (_material('model = "phong"\nroughness = 1'), "materials.m.roughness", "belongs to cook-torrance"),
        (_material("shininess = 1"), "materials.m.shininess", "belongs to blinn-phong, phong"),
        (_material("transmittance = [0, 0, 0]"), "materials.m.transmittance", "belongs to translucent"),
        (_material('model = "translucent"\nspecular = [0, 0, 0]'), "materials.m.specular", "belongs to"),
        (_material('model = "cook-torrance"\nroughness = 0'), "materials.m.roughness", "from 0.0001 to 10"),
        (_material('model = "cook-torrance"\nroughness = "abc"'), "materials.m.roughness", "found 'abc' (string)"),
        (_material('model = "cook-torrance"\nf0 = 1.5'), "materials.m.f0", "expected a number from 0 to 1, found 1.5"),
        (_material('model = "cook-torrance"\nf0 = true'), "materials.m.f0", "found True (boolean)"),
        (_material('model = "phong"\nshininess = -1'), "materials.m.shininess", "from 0 to 1e+06"),
        (_material('model = "phong"\nshininess = nan'), "materials.m.shininess", "found nan"),
        (_material('model = "translucent"\ntransmittance = [0, 0.6, 0]'), "materials.m.transmittance", "0.5, 1.1, 0.5"),
        (
            _material('model = "translucent"\ndiffuse = [1, 1, 1]\ntransmittance = [0, 0, 0.1]'),
            "materials.m",
            "1, 1, 1.1",
        ),
        (
            _material('diffuse_texture = "none.png"'),
            "materials.m.diffuse_texture",
            "expected a texture, found 'none.png' (string): no such",
        ),
        (_material("diffuse_texture = false"), "materials.m.diffuse_texture", "expected a string"),
        (_material("adjustable = 'yes'"), "materials.m.adjustable", "true or false"),
        # lights
        (_sphere('shape = "disc"'), "lights.l.shape", "one of sphere, rectangle"),
        (_sphere("-shape"), "lights.l.shape", "found nothing"),
        (_sphere("radius = 0"), "lights.l.radius", "expected a number above 0, found 0"),
        (_sphere("radius = -1"), "lights.l.radius", "above 0"),
        (_sphere("-radius"), "lights.l.radius", "found nothing"),
        (_sphere("radiance = [1, -1, 1]"), "lights.l.radiance", "3 numbers of at least 0"),
        (_sphere("-radiance"), "lights.l.radiance", "found nothing"),
        (_sphere("-center"), "lights.l.center", "found nothing"),
        (_sphere("edge_u = [1, 0, 0]"), "lights.l.edge_u", "belongs to rectangle"),
        (_sphere("radios = 1"), "lights.l.radios", "Did you mean 'radius'?"),
        (_rectangle("radius = 1"), "lights.l.radius", "belongs to sphere"),
        (_rectangle("edge_u = [0, 0, 0]"), "lights.l.edge_u", "not 0 0 0"),
        (_rectangle("edge_v = [-2, 0, 0]"), "lights.l.edge_v", "not parallel"),
        (_rectangle("-edge_v"), "lights.l.edge_v", "found nothing"),
        # environments
        (
            MINIMAL + '[environments.e]\nmap = "none.exr"\n',
            "environments.e.map",
            "an environment map, found 'none.exr' (string): no such",
        ),
        (MINIMAL + "[environments.e]\n", "environments.e.map", "found nothing"),
        (MINIMAL + '[environments.e]\nmap = "sky.exr"\nrotate = 1\n', "environments.e.rotate", "unknown key"),
        # cameras
        (_camera("-eye"), "cameras.c.eye", "found nothing"),
        (_camera("-target"), "cameras.c.target", "found nothing"),
        (_camera("target = [0, 1, 4]"), "cameras.c.target", "a point other than eye"),
        (_camera("target = [0, 9, 4]"), "cameras.c.up", "not parallel to the view"),
        (_camera("up = [0, 0, 0]"), "cameras.c.up", "not 0 0 0"),
        (_camera("fov = 0"), "cameras.c.fov", "above 0 and below 180 degrees, found 0"),
        (_camera("fov = 180"), "cameras.c.fov", "below 180 degrees"),
        (_camera("size = [640]"), "cameras.c.size", "whole numbers from 1 to 16384"),
        (_camera("size = [640, 0]"), "cameras.c.size", "found [640, 0]"),
        (_camera("size = [640.0, 480]"), "cameras.c.size", "whole numbers"),
        (_camera("size = [true, true]"), "cameras.c.size", "whole numbers"),
        (_camera("size = [16385, 1]"), "cameras.c.size", "16384"),
        (_camera("aperture = 2"), "cameras.c.aperture", "unknown key"),
        # accuracy
        (MINIMAL + "[accuracy]\ntolerance = 0\n", "accuracy.tolerance", "above 0 and at most 1"),
        (MINIMAL + "[accuracy]\ntolerance = 1.5\n", "accuracy.tolerance", "found 1.5"),
        (MINIMAL + "[accuracy]\ntolerence = 0.1\n", "accuracy.tolerence", "Did you mean 'tolerance'?"),
    ],
)
def test_refusals_name_file_key_expected_and_found(scene_folder, text, key, words):
    (scene_folder.parent / "outside.obj").write_text("")
    path = write(scene_folder, text)
    with pytest.raises(InputError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: {key}")
    assert words in message
    assert "\n" not in message
    # 5000 letters of a name must not reach the terminal; two paths of this test's own may.
    assert len(message) < 800


def test_files_that_are_no_scene(scene_folder, monkeypatch):
    with pytest.raises(InputError, match="no such file"):
        load_scene(scene_folder / "none.toml")
    with pytest.raises(InputError, match="not a regular file"):
        load_scene(scene_folder)
    with pytest.raises(InputError, match="UTF-8 text, found byte 0xff at 10"):
        load_scene(write(scene_folder, b"format = 1\xff"))
    with pytest.raises(InputError, match="not valid TOML"):
        load_scene(write(scene_folder, "x = " + "[" * 100_000))
    monkeypatch.setattr(parse, "MAX_FILE_BYTES", 10)
    with pytest.raises(InputError, match="at most 10"):
        load_scene(write(scene_folder, MINIMAL))


def test_an_unreadable_file_is_the_systems_fault(scene_folder, monkeypatch):
    def deny(self):
        raise PermissionError(13, "Permission denied")

    path = write(scene_folder, MINIMAL)
    monkeypatch.setattr(Path, "read_bytes", deny)
    with pytest.raises(SystemFault, match="Permission denied"):
        load_scene(path)


def test_outside_files_need_permission(scene_folder):
    (scene_folder.parent / "outside.obj").write_text("")
    path = write(scene_folder, MINIMAL.replace("triangle.obj", "../outside.obj"))
    assert load_scene(path, allow_outside=True).objects["a"].mesh.is_file()


def test_a_link_may_not_lead_outside_but_the_folder_itself_may_be_one(scene_folder):
    (scene_folder.parent / "outside.obj").write_text("")
    (scene_folder / "link.obj").symlink_to(scene_folder.parent / "outside.obj")
    with pytest.raises(InputError, match="--allow-outside"):
        load_scene(write(scene_folder, MINIMAL.replace("triangle.obj", "link.obj")))
    path = write(scene_folder, MINIMAL)
    elsewhere = scene_folder.parent / "elsewhere"
    elsewhere.symlink_to(scene_folder)
    assert load_scene(elsewhere / path.name).objects["a"].mesh.is_file()
    (scene_folder / "loop.obj").symlink_to(scene_folder / "loop.obj")
    with pytest.raises(InputError, match=r"objects\.a\.mesh"):
        load_scene(write(scene_folder, MINIMAL.replace("triangle.obj", "loop.obj")))


def test_relative_scene_paths_give_absolute_files(scene_folder, monkeypatch):
    write(scene_folder, MINIMAL)
    monkeypatch.chdir(scene_folder)
    scene = load_scene("scene.toml")
    assert scene.path.is_absolute()
    assert scene.objects["a"].mesh.is_absolute()


def test_a_pipe_is_no_mesh(scene_folder):
    os.mkfifo(scene_folder / "pipe.obj")
    with pytest.raises(InputError, match="not a regular file"):
        load_scene(write(scene_folder, MINIMAL.replace("triangle.obj", "pipe.obj")))


ODD_VALUES = st.one_of(
    st.sampled_from(
        ["nan", "-inf", "1e999", "true", "''", "[]", "{}", "[[]]", "1979-05-27", "07:32:00", "0", "-1", "0x7fff", '"m"']
    ),
    st.integers().map(str),
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.lists(st.floats(width=32).map(lambda x: repr(x)), max_size=5).map(lambda xs: f"[{', '.join(xs)}]"),
    st.text(max_size=20),
)


@settings(
    max_examples=400, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, derandomize=True
)
@given(data=st.data())
def test_no_mutation_gives_anything_but_a_scene_or_an_input_error(scene_folder, data):
    lines = FULL.splitlines()
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(lines) - 1))
        key, equals, _value = lines[at].partition(" = ")
        change = data.draw(st.sampled_from(["value", "key", "delete", "repeat", "cut", "insert"]))
        if change == "value" and equals:
            lines[at] = f"{key} = {data.draw(ODD_VALUES)}"
        elif change == "key" and equals:
            lines[at] = f"{data.draw(st.text(max_size=8))} = {_value}"
        elif change == "delete":
            lines[at] = ""
        elif change == "repeat":
            lines.append(lines[at])
        elif change == "cut":
            lines[at] = lines[at][: data.draw(st.integers(0, len(lines[at])))]
        else:
            lines[at] += data.draw(st.text(max_size=8))
    path = scene_folder / "scene.toml"
    path.write_bytes("\n".join(lines).encode("utf-8", "surrogatepass"))
    try:
        scene = load_scene(path)
    except InputError as error:
        assert str(path) in str(error)  # noqa: PT017
    else:
        assert isinstance(scene, Scene)
        assert scene.objects
        assert all(np.isfinite(o.transform).all() for o in scene.objects.values())
        assert all(0 < c.fov < 180 and math.isfinite(c.fov) for c in scene.cameras.values())
