"""What a user can get wrong, from the outside: code 2 and a message that names the place, what was expected and found.

The scene file's rules are tested key by key in tests/scene/test_parse.py; here are the ways in which they reach a user.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest

from relightcli.adapters.images import write_image
from relightcli.cli.main import run

PRECOMPUTE = ("precompute", "scene.toml", "-o", "new.zarr", "--light-resolution", "16", "--workers", "1")
RELIGHT = ("relight", "t.zarr", "-o", "out.exr")
FRAMES = ("relight", "t.zarr", "-o", "out.##.exr", "--frames", "frames.toml")


def edit(folder, old, new):
    text = (folder / "scene.toml").read_text()
    assert old in text
    (folder / "scene.toml").write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("format = 1", "format = 2", ("format", "expected 1, found 2")),
        ("format = 1", "format = ", "is not valid TOML"),
        (
            "mesh = 'ball.obj'",
            "mesh = 'none.obj'",
            ("objects.ball.mesh", "expected a mesh", "'none.obj'", "no such file"),
        ),
        ("mesh = 'ball.obj'", "mesh = '.'", ("objects.ball.mesh", "not a regular file")),
        ("mesh = 'ball.obj'", "mesh = 'scene.toml'", ("scene.toml", ".ply", "found suffix '.toml'")),
        ("mesh = 'ball.obj'", "mesh = 'sky-sky.exr'", ("expected a mesh file", "found suffix '.exr'")),
        ("mesh = 'ball.obj'", "mesh = '../outside.obj'", ("objects.ball.mesh", "--allow-outside")),
        ("mesh = 'ball.obj'", "mesh = '/etc/passwd'", ("objects.ball.mesh", "--allow-outside")),
        ("mesh = 'ball.obj'", "mesh = 3", ("objects.ball.mesh", "expected a string, found 3 (integer)")),
        ("mesh = 'ball.obj'", "mush = 'ball.obj'", ("objects.ball.mush", "unknown key", "Did you mean 'mesh'?")),
        ("material = 'ball'", "material = 'bell'", ("objects.ball.material", "found 'bell'", "Did you mean 'ball'?")),
        ("roughness = 0.3", "roughness = 0", ("materials.ball.roughness", "from 0.0001 to 10, found 0")),
        ("f0 = 0.04", "f0 = 1.5", ("materials.ball.f0", "from 0 to 1, found 1.5")),
        ("model = 'lambert'", "model = 'lambda'", ("materials.ground.model", "Did you mean 'lambert'?")),
        ("fov = 40.0", "fov = 180", ("cameras.main.fov", "below 180 degrees", "found 180")),
        ("size = [8, 6]", "size = [0, 6]", ("cameras.main.size", "whole numbers", "found [0, 6]")),
        ("map = 'sky-sky.exr'", "map = 'none.exr'", ("environments.sky.map", "no such file")),
        ("two_sided = false", "motion = 'skinned'", ("objects.ground.motion", "'skinned'", ".glb")),
        ("two_sided = false", "translate = [1e300, 0, 0]", ("objects.ground", "beyond 1e+30")),
    ],
)
def test_scene_file(here, refused, old, new, words):
    edit(here, old, new)
    words = (words,) if isinstance(words, str) else words
    refused(PRECOMPUTE, ("scene.toml", *words) if "suffix" not in str(words) else words)
    assert not list(here.glob("new.zarr*"))


def test_scene_that_is_none(here, refused):
    refused(("precompute", "none.toml", "-o", "new.zarr"), ("none.toml", "no such file", "expected a scene file"))
    refused(("precompute", ".", "-o", "new.zarr"), ("not a regular file", "expected a scene file"))
    (here / "binary.toml").write_bytes(b"\xff\xfe\x00")
    refused(("precompute", "binary.toml", "-o", "new.zarr"), ("binary.toml", "expected UTF-8 text", "0xff"))
    refused(("precompute", "sky-sky.exr", "-o", "new.zarr"), "sky-sky.exr")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "no triangles"),
        (b"v 0 0 0\nv 1 0 0\nv nan 1 0\nf 1 2 3\n", ("1 of 3 vertices", "not finite", "vertex 2")),
        (b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", ("degenerate", "expected a surface mesh")),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "cannot be read as a OBJ mesh"),
        (b"\x00\x01\x02" * 100, "ball.obj"),
    ],
    ids=["empty", "nan", "flat", "index", "binary"],
)
def test_meshes(here, refused, content, words):
    (here / "ball.obj").write_bytes(content)
    refused(PRECOMPUTE, ("ball.obj", *((words,) if isinstance(words, str) else words)))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--light-resolution", "17"), ("--light-resolution", "16", "256", "found 17")),
        (("--light-resolution", "512"), ("--light-resolution", "found 512")),
        (("--light-resolution", "many"), ("--light-resolution", "not a valid integer")),
        (("--refine", "3"), ("--refine", "found 3")),
        (("--refine", "8"), ("--refine", "found 8")),  # 16 texels are too few for it
        (("--effects", ""), ("--effects", "direct, shadows", "found ''")),
        (("--effects", "direct,magic"), ("--effects", "found 'magic'")),
        (("--effects", "direct,one-bounce"), ("--effects", "'one-bounce' needs 'shadows'")),
        (("--effects", "shadows"), ("--effects", "'direct' must be among them")),
        (("--receivers", "pixels"), ("--receivers", "pixels:CAMERA", "found 'pixels'")),
        (("--pixel-grid", "2"), ("--pixel-grid", "--receivers pixels:CAMERA")),
        (("--pixel-grid", "9"), ("--pixel-grid", "1 to 8", "found 9")),
        (("--receivers", "pixels:side"), ("--receivers", "no camera 'side'", "main")),
        (("--basis", "wavelet"), ("--basis", "visibility, haar, sh, dense", "found 'wavelet'")),
        (("--basis", "haar", "--coefficients", "0"), ("--coefficients", "found 0")),
        (("--basis", "sh", "--sh-order", "99"), ("--sh-order", "found 99")),
        (("--tolerance", "nan"), ("--tolerance", "found nan")),
        (("--tolerance", "0"), ("--tolerance", "found 0")),
        (("--bounces", "-1"), ("--bounces", "0 to 64", "found -1")),
        (("--bounces", "65"), ("--bounces", "0 to 64", "found 65")),
        (("--bounces", "x"), ("--bounces", "'x' is not a valid integer")),
        (("--bounces", "1", "--effects", "direct,shadows"), ("--bounces 1", "--effects names no bounces")),
        (("--bounces", "1", "--bounce-resolution", "12"), ("--bounce-resolution", "8, 16 or 32", "found 12")),
        (("--pose-frames", "spread"), ("--pose-frames", "spread:N", "found 'spread'")),
        (("--pose-order", "0"), ("--pose-order", "1 to 8", "found 0")),
        (("--pose-directions", "1"), ("--pose-directions", "16 to 65536", "found 1")),
        (("--workers", "0"), ("--workers", "0 is not in the range")),
        (("--workers", "100000"), ("--workers", "is not in the range")),
        (("--seed", "-1"), ("--seed", "-1 is not in the range")),
        (("--seed", "9" * 30), ("--seed", "is not in the range")),
        (("--frobnicate",), "No such option '--frobnicate'"),
    ],
)
def test_precompute_options(here, refused, options, words):
    refused((*PRECOMPUTE, *options), words)
    assert not list(here.glob("new.zarr*"))  # a slip must not leave work that refuses the right command


@pytest.mark.parametrize("command", ["precompute", "relight", "reference"])
@pytest.mark.parametrize(
    ("output", "words"),
    [
        ("none/new", ("--output", "expected a folder", "none does not exist")),
        ("scene.toml/new", ("--output", "expected a folder", "scene.toml is a file")),
    ],
)
def test_output_folder(here, refused, command, output, words):
    if command == "precompute":
        refused(("precompute", "scene.toml", "-o", f"{output}.zarr"), words)
    else:
        more = ("--reference",) if command == "reference" else ()
        refused(("relight", "t.zarr", "-o", f"{output}.exr", *more), words)


def test_output_names(here, refused):
    refused(("precompute", "scene.toml", "-o", "/"), ("--output", "expected the name of a file or store"))
    refused(("precompute", "scene.toml"), "Missing option '-o'")
    for output in ("out", "out.gif", "", "out.exr/"):
        if output == "out.exr/":
            (here / "out.exr").mkdir()
            refused(("relight", "t.zarr", "-o", output), ("out.exr", "is a folder"))
        else:
            refused(("relight", "t.zarr", "-o", output), ("--output", ".exr", ".zarr"))
    refused(("relight", "t.zarr", "-o", "out.ply", "--reference"), ("--reference", ".exr", "out.ply"))
    refused(("relight", "t.zarr", "-o", "out.png", "--layers"), ("--layers", ".exr", "out.png"))
    refused((*RELIGHT[:3], "-", "--json"), "both want stdout")


def test_inputs_are_not_overwritten(here, refused):
    sky, root = (here / "sky-sky.exr").read_bytes(), (here / "t.zarr" / "zarr.json").read_bytes()
    refused(("relight", "t.zarr", "-o", "sky-sky.exr", "--env", "./sky-sky.exr"), "is --env itself")
    refused(("relight", "t.zarr", "-o", "t.zarr", "--overwrite"), "is the store itself")
    assert sky == (here / "sky-sky.exr").read_bytes()
    assert root == (here / "t.zarr" / "zarr.json").read_bytes()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--env", "none.exr"), ("--env none.exr", "no such file", "sky")),
        (("--env", "."), ("not a regular file", "expected a picture")),
        (("--env", "scene.toml"), ("scene.toml", "cannot be read as a picture")),
        (("--env-rotate", "nan"), ("--env-rotate", "finite")),
        (("--env-rotate", "north"), ("--env-rotate", "'north' is not a valid float")),
        (("--exposure", "inf"), ("--exposure", "finite")),
        (("--camera", "side"), ("--camera side", "main")),
        (("--set", "gold"), ("--set gold", "MATERIAL.PARAMETER=VALUE")),
        (("--set", "ball=velvet"), ("--set ball=velvet", "no measured material 'velvet'", "chrome", "PARAMETER=VALUE")),
        (("--set", "ground=crome"), ("no measured material 'crome'", "Did you mean 'chrome'?")),
        (("--set", "bell.f0=1"), ("no material 'bell'", "Did you mean 'ball'?")),
        (("--set", "ball.color=1,1,1"), ("no parameter 'color'", "diffuse, specular, f0, roughness")),
        (("--set", "ground.f0=1"), ("lambert has no parameter 'f0'",)),
        (("--set", "ball.f0="), ("--set ball.f0=", "VALUE")),
        (("--set", "ball.f0=x"), ("ball.f0", "one number", "'x'")),
        (("--set", "ball.f0=2"), ("ball.f0", "from 0 to 1", "found 2")),
        (("--set", "ball.roughness=nan"), ("ball.roughness", "found nan")),
        (("--set", "ball.diffuse=1,1"), ("three numbers", "'1,1'")),
        (("--set", "ball.diffuse=1,1,2"), ("3 numbers from 0 to 1",)),
        (("--background", "sea"), ("--background", "'sea' is not one of")),
        (("--bounces", "65"), ("--bounces", "65 is not in the range")),
        (("--reference", "--spp", "0"), ("--spp", "0 is not in the range")),
        (("--seed", "9" * 30), ("--seed", "is not in the range")),
        (("--frames", "none.toml"), ("--output", "####")),
    ],
)
def test_relight_options(here, refused, options, words):
    refused((*RELIGHT, *options), words)
    assert not (here / "out.exr").exists()


def test_materials_that_are_not_adjustable(here, refused):
    edit(here, "adjustable = true", "adjustable = false")
    assert run([*PRECOMPUTE, "-q"]) == 0
    refused(
        ("relight", "new.zarr", "-o", "out.exr", "--set", "ground.diffuse=0,0,0"),
        ("'ground' is not adjustable", "adjustable: ball"),
    )


def test_scenes_without_environment_or_camera(here, refused):
    text = (here / "scene.toml").read_text()
    (here / "scene.toml").write_text(text[: text.index("[cameras.main]")])
    assert run([*PRECOMPUTE, "-q"]) == 0
    refused(("relight", "new.zarr", "-o", "out.exr"), ("--env", "none"))
    refused(("relight", "new.zarr", "-o", "out.exr", "--env", "sky-sky.exr"), ("no camera", "[cameras.main]"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "no such file"),
        ("frames = 1\n", "format: expected 1"),
        ("format = 1\n", "frames: expected a whole number from 1"),
        ("format = 1\nframes = 0\n", "found 0"),
        ("format = 1\nframes = 1\nfps = 24\n", "fps: unknown key"),
        ("format = 1\nframes = 1\nkey = 3\n", "[[key]]"),
        ("format = 1\nframes = 1\n[[key]]\nframe = 1\nexposure = nan\n", "key[0].exposure: expected a finite number"),
        (f"format = 1\nframes = 1\n[[key]]\nframe = 1\nexposure = 1{'0' * 400}\n", "key[0].exposure"),
        (f"format = 1\nframes = 1\n[[key]]\nframe = 1\nexposure = 1{'0' * 5000}\n", "not a TOML file"),
        ("format = " + "[" * 5000 + "]" * 5000, "not a TOML file"),
        ("format = 1\nframes = 1\n[[key]]\nframe = 2\n[[key]]\nframe = 2\n", "expected more than 2"),
        (
            "format = 1\nframes = 3\n[[key]]\nframe = 1\nenv = 'sky'\n[[key]]\nframe = 3\nenv = 'sea'\n",
            "frame 3: --env sea",
        ),
        ("format = 1\nframes = 1\n[[key]]\nframe = 1\ncamera = 'side'\n", "frame 1: --camera side"),
        ("format = 1\nframes = 1\n[[key]]\nframe = 1\nset = {'ball.shine' = 1}\n", "no parameter 'shine'"),
        ("format = 1\nframes = 1\n[[key]]\nframe = 1\nset = {ball.f0 = 1}\n", "key[0].set.ball"),
        ("format = 1\nframes = 1\n[[key]]\nframe = 1\nset = {ball = 'velvet'}\n", "key[0].set.ball: no measured"),
        ("format = 1\nframes = 1\n[[key]]\nframe = 1\nset = {'ball.f0' = 'chrome'}\n", "f0: expected one number"),
    ],
)
def test_frames(here, refused, text, words):
    if text is not None:
        (here / "frames.toml").write_text(text)
    refused(FRAMES, ("frames.toml", words))
    assert not list(here.glob("out.*"))


def png(width, height):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 99)) + chunk(b"IEND", b"")
    )


def rgbe(width, height):
    return f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode() + b"\0" * 100


@pytest.mark.parametrize("reference", [False, True], ids=["store", "reference"])
@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("empty.exr", b"", "cannot be read as a picture"),
        ("text.exr", b"not a picture", "cannot be read as a picture"),
        ("bomb.png", png(60000, 60000), "60000x60000"),
        ("bomb.hdr", rgbe(99999999, 99999999), "99999999x99999999"),
        ("short.hdr", rgbe(4000, 2000), "short.hdr"),
        ("cut.exr", 0.5, ("cut.exr", "cut short")),
        ("nan.exr", np.nan, ("1 pixels are NaN or infinite", "x=3, y=2", "(nan, nan, nan)")),
        ("inf.exr", np.inf, ("1 pixels are NaN or infinite", "x=3, y=2")),
        ("none-suffix", b"", "cannot be read as a picture"),
    ],
)
def test_environments(here, refused, name, content, words, reference):
    if isinstance(content, bytes):
        (here / name).write_bytes(content)
    elif content == 0.5:
        data = (here / "sky-sky.exr").read_bytes()
        (here / name).write_bytes(data[: len(data) // 2])
    else:
        pixels = np.ones((8, 16, 3), np.float32)
        pixels[2, 3] = content
        write_image(here / name, pixels)
    more = ("--reference", "--spp", "2") if reference else ()
    refused((*RELIGHT, "--env", name, *more), (name, *((words,) if isinstance(words, str) else words)))
    assert not (here / "out.exr").exists()


def test_negative_and_odd_environments_are_taken_with_a_note(here, capsys):
    pixels = np.ones((8, 16, 3), np.float32)
    pixels[2, 3] = -5
    write_image(here / "negative.exr", pixels)
    write_image(here / "one.exr", pixels[:1, :1])
    write_image(here / "tall.exr", pixels[:, :2])
    assert run([*RELIGHT, "--env", "negative.exr"]) == 0
    assert "note: negative.exr: 1 pixels had negative values (down to -5); set to 0." in capsys.readouterr().err
    assert run([*RELIGHT, "--env", "tall.exr"]) == 0
    assert "note: tall.exr: 2x8 is not 2:1" in capsys.readouterr().err
    assert run([*RELIGHT, "--env", "one.exr"]) == 0
    assert "note" not in capsys.readouterr().err


def test_reference_reads_scene_files_within_their_folder_only(here, refused):
    (here / "inner").mkdir()
    text = (here / "scene.toml").read_text().replace("'ground.obj'", "'../ground.obj'")
    (here / "inner" / "scene.toml").write_text(text)
    arguments = ("relight", "inner/scene.toml", "--reference", "-o", "out.exr", "--env", "sky-sky.exr")
    refused(arguments, ("objects.ground.mesh", "--allow-outside"))
