"""Keyframe files: interpolation, what holds, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from relightcli.errors import InputError
from relightcli.scene.moving import parse_move
from relightcli.stages.shots import Shot, read_shots

DEFAULT = Shot(1, "sky", 5.0, "main", -1.0, ("gold.f0=0.5",), ("man=none@0",))


def shots(tmp_path, text):
    path = tmp_path / "shots.toml"
    path.write_text("format = 1\n" + text)
    return read_shots(path, DEFAULT)


def test_without_keys_every_frame_is_the_default(tmp_path):
    found = shots(tmp_path, "frames = 3\nfirst = 7\n")
    assert [s.number for s in found] == [7, 8, 9]
    assert all(s == Shot(s.number, "sky", 5.0, "main", -1.0, ("gold.f0=0.5",), ("man=none@0",)) for s in found)


def test_a_turn_without_a_double(tmp_path):
    found = shots(tmp_path, "frames = 24\n[[key]]\nframe = 1\nenv_rotate = 0\n[[key]]\nframe = 25\nenv_rotate = 360\n")
    assert [s.env_rotate for s in found] == pytest.approx([15.0 * k for k in range(24)])


def test_numbers_go_linearly_and_hold_outside(tmp_path):
    found = shots(
        tmp_path,
        "frames = 6\n"
        "[[key]]\nframe = 2\nexposure = 1\nset = { 'red.diffuse' = [0, 0.5, 1], 'gold.f0' = 0.2 }\n"
        "[[key]]\nframe = 4\nexposure = 3\nset = { 'red.diffuse' = [1, 0.5, 0] }\n",
    )
    assert [s.exposure for s in found] == [1, 1, 2, 3, 3, 3]
    assert found[2].settings == ("gold.f0=0.5", "red.diffuse=0.5,0.5,0.5", "gold.f0=0.2")
    assert found[0].settings[1] == "red.diffuse=0.0,0.5,1.0"
    assert found[5].settings[1] == "red.diffuse=1.0,0.5,0.0"


def test_texts_hold_until_the_next(tmp_path):
    (tmp_path / "noon.exr").touch()
    found = shots(
        tmp_path,
        "frames = 4\n[[key]]\nframe = 2\nenv = 'noon.exr'\ncamera = 'a'\n[[key]]\nframe = 3.5\nenv = 'dusk'\n",
    )
    noon = str(tmp_path / "noon.exr")
    assert [s.env for s in found] == [noon, noon, noon, "dusk"]
    assert [s.camera for s in found] == ["a"] * 4


def test_measured_materials_hold_and_numbers_go_on_top(tmp_path):
    # The numbers' key stands first; the material would wipe them out if it came after them.
    found = shots(
        tmp_path,
        "frames = 4\n"
        "[[key]]\nframe = 1\nset = { 'floor.roughness' = 0.1 }\n"
        "[[key]]\nframe = 2\nset = { floor = 'Blue Acrylic' }\n"
        "[[key]]\nframe = 3\nset = { floor = 'chrome', 'floor.roughness' = 0.3 }\n",
    )
    roughness = ("0.1", "0.2", "0.3", "0.3")
    names = ("blue-acrylic", "blue-acrylic", "chrome", "chrome")
    assert [s.settings for s in found] == [
        ("gold.f0=0.5", f"floor={name}", f"floor.roughness={m}") for name, m in zip(names, roughness, strict=True)
    ]


def test_poses_go_on_within_a_clip_and_stand_still_between_two(tmp_path):
    keys = ((2, "walk@0"), (4, "walk@3"), (6, "run@1"), (7, "run@1.5"))
    text = "".join(f"[[key]]\nframe = {frame}\npose = {{ man = '{pose}' }}\n" for frame, pose in keys)
    found = shots(tmp_path, "frames = 8\n" + text)
    poses = [s.poses for s in found]
    seconds = ["walk@0.0", "walk@0.0", "walk@1.5", "walk@3.0", "walk@3.0", "run@1.0", "run@1.5", "run@1.5"]
    assert poses == [("man=none@0", f"man={pose}") for pose in seconds]


def test_moves_are_interpolated_and_follow_those_of_the_command_line(tmp_path):
    path = tmp_path / "shots.toml"
    path.write_text(
        "format = 1\nframes = 3\n"
        "[[key]]\nframe = 1\nmove = { ball = [0, 0, 0], block = [0, 0, 0, 0, 90, 0] }\n"
        "[[key]]\nframe = 3\nmove = { ball = [2, 4, 0], block = [0, 0, 1, 0, 0, 0] }\n"
    )
    found = read_shots(path, replace(DEFAULT, moves=("lamp=1,1,1",)))
    assert [s.moves[:2] for s in found] == [("lamp=1,1,1", f"ball={x}.0,{2 * x}.0,0.0") for x in (0, 1, 2)]
    turned = [parse_move(s.moves[2])[1] for s in found]
    np.testing.assert_allclose(turned, [(0, 0, 0, 0, 90, 0), (0, 0, 0.5, 0, 45, 0), (0, 0, 1, 0, 0, 0)], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "frames: expected a whole number from 1 to 100000; found None"),
        ("frames = 0", "frames: .*found 0"),
        ("frames = true", "frames: .*found True"),
        ("frames = 1.0", "frames: .*found 1.0"),
        ("frames = 100001", "frames: .*found 100001"),
        ("frames = 2\nfirst = -1", "first: expected"),
        ("frames = 2\nfps = 24", "fps: unknown key; expected one of first, format, frames, key"),
        ("frames = 2\nkey = 3", r"key: expected tables \[\[key\]\]"),
        ("frames = 2\n[[key]]\nenv = 'a'", r"key\[0\].frame: expected a finite number; found None"),
        ("frames = 2\n[[key]]\nframe = inf", r"key\[0\].frame: expected a finite number"),
        ("frames = 2\n[[key]]\nframe = 1\n[[key]]\nframe = 1", r"key\[1\].frame: expected more than 1"),
        ("frames = 2\n[[key]]\nframe = 1\nenv = 3", r"key\[0\].env: expected a text"),
        ("frames = 2\n[[key]]\nframe = 1\nenv_rotate = 'x'", r"key\[0\].env_rotate: expected a finite number"),
        ("frames = 2\n[[key]]\nframe = 1\nrotate = 3", r"key\[0\].rotate: unknown key"),
        ("frames = 2\n[[key]]\nframe = 1\nset = 3", r"key\[0\].set: expected a table"),
        ("frames = 2\n[[key]]\nframe = 1\nset = { a = 'crome' }", r"key\[0\].set.a: no measured .*'chrome'\?"),
        ("frames = 2\n[[key]]\nframe = 1\nset = { a = '0.5' }", r"key\[0\].set.a: no measured material '0.5'"),
        ("frames = 2\n[[key]]\nframe = 1\nset = { a = ['x'] }", r"key\[0\].set.a: expected a finite number"),
        ("frames = 2\n[[key]]\nframe = 1\nset = { a = true }", r"key\[0\].set.a: expected a finite number"),
        (
            "frames = 2\n[[key]]\nframe = 1\nset = { a = 1 }\n[[key]]\nframe = 2\nset = { a = 'chrome' }",
            r"key\[1\].set.a: expected a number, as in the key before; found 'chrome'",
        ),
        (
            "frames = 2\n[[key]]\nframe = 1\nset = { a = 'chrome' }\n[[key]]\nframe = 2\nset = { a = 1 }",
            r"key\[1\].set.a: expected a measured material, as in the key before; found 1",
        ),
        (
            "frames = 2\n[[key]]\nframe = 1\nset = { a = 1 }\n[[key]]\nframe = 2\nset = { a = [1, 2, 3] }",
            r"key\[1\].set.a: expected 1 numbers",
        ),
        ("frames = 2\n[[key]]\nframe = 1\npose = 'x@1'", r"key\[0\].pose: expected a table"),
        ("frames = 2\n[[key]]\nframe = 1\npose = { a = 1 }", r"key\[0\].pose.a: expected a text CLIP@SECONDS"),
        ("frames = 2\n[[key]]\nframe = 1\npose = { a = 'x' }", r"key\[0\].pose.a: --pose a=x: expected OBJECT="),
        ("frames = 2\n[[key]]\nframe = 1\nmove = 3", r"key\[0\].move: expected a table"),
        ("frames = 2\n[[key]]\nframe = 1\nmove = { a = [1, 2] }", r"key\[0\].move.a: expected 3 or 6 or 16 numbers"),
        ("frames = 2\n[[key]]\nframe = 1\nmove = { a = [1, 2, inf] }", r"key\[0\].move.a: expected a finite number"),
        (
            "frames = 2\n[[key]]\nframe = 1\nmove = { a = [1, 2, 3] }\n"
            "[[key]]\nframe = 2\nmove = { a = [1, 2, 3, 0, 0, 0] }",
            r"key\[1\].move.a: expected 3 numbers, as in the key before",
        ),
        ("frames = ", "not a TOML file"),
    ],
)
def test_refusals_name_file_and_key(tmp_path, text, message):
    with pytest.raises(InputError, match=f"shots.toml: {message}"):
        shots(tmp_path, text)


def test_format_and_files(tmp_path):
    path = tmp_path / "shots.toml"
    path.write_text("format = 2\nframes = 1\n")
    with pytest.raises(InputError, match="format: expected 1; found 2"):
        read_shots(path, DEFAULT)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="not a TOML file"):
        read_shots(path, DEFAULT)
    with pytest.raises(InputError, match="no such file"):
        read_shots(tmp_path / "none.toml", DEFAULT)
    with pytest.raises(InputError, match="is a folder"):
        read_shots(tmp_path, DEFAULT)
