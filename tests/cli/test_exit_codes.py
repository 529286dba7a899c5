"""Exit codes and streams of the program as a process: what a shell, Make or a pipeline sees."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from relightcli.cli import exits
from relightcli.cli.main import run
from relightcli.errors import InputError, NumericalError, StoreError, SystemFault


def shell(script, folder):
    """A shell command with $R for the program; returns the finished process, stdout as bytes."""
    return subprocess.run(
        ["bash", "-c", f"R='{sys.executable} -m relightcli'; {script}"], cwd=folder, capture_output=True, timeout=60
    )


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (InputError("x"), 2),
        (StoreError("x"), 3),
        (NumericalError("x"), 4),
        (SystemFault("x"), 5),
        (OSError(28, "No space left on device", "a.exr"), 5),
        (MemoryError(), 5),
        (ZeroDivisionError("x"), 5),
    ],
)
def test_error_classes(error, code):
    found, message = exits.exit_code(error)
    assert found == code
    assert message
    if isinstance(error, OSError):
        assert message == "a.exr: No space left on device"


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("relight", "t.zarr", "-o", "out.exr", "-q"), 0),
        (("inspect", "t.zarr", "--verify"), 0),
        (("diff", "t.zarr", "t.zarr"), 0),
        (("diff", "sky-sky.exr", "sky-sky.exr", "--fail", "0"), 0),
        (("--help",), 0),
        (("relight", "--help"), 0),
        (("--version",), 0),
        ((), 2),
        (("relight",), 2),
        (("polish",), 2),
        (("diff", "sky-sky.exr", "none.exr"), 2),
        (("relight", "none.zarr", "-o", "out.exr"), 3),
        (("relight", "scene.toml", "-o", "out.exr"), 3),
        (("relight", ".", "-o", "out.exr"), 3),
        (("relight", "t.zarr", "-o", "out.exr", "--basis", "haar"), 3),
        (("inspect", "none.zarr"), 3),
        (("inspect", "scene.toml"), 3),
        (("precompute", "scene.toml", "-o", "sky-sky.exr"), 3),
    ],
)
def test_codes(here, capsys, arguments, code):
    assert run(list(arguments)) == code
    shown = capsys.readouterr()
    assert "Traceback" not in shown.err
    assert (shown.err != "") == (code != 0) or arguments[0] == "relight"


def test_beyond_tolerance_is_1(here):
    assert run(["relight", "t.zarr", "-o", "a.exr", "-q"]) == 0
    assert run(["relight", "t.zarr", "-o", "b.exr", "-q", "--set", "ground.diffuse=0.6,0.5,0.5"]) == 0
    assert run(["diff", "a.exr", "b.exr", "--fail", "0.5"]) == 0
    assert run(["diff", "a.exr", "b.exr", "--fail", "0.001"]) == 1


def test_light_beyond_float32_is_a_numerical_failure(here, capsys):
    import numpy as np

    from relightcli.adapters.images import write_image

    write_image(here / "huge.exr", np.full((2, 4, 3), 3e38, np.float32))
    assert run(["relight", "t.zarr", "-o", "out.exr", "--env", "huge.exr"]) == 4
    assert "not finite; nothing was written" in capsys.readouterr().err
    assert not (here / "out.exr").exists()


def test_traceback_only_when_asked_for(here, capsys):
    assert run(["relight", "none.zarr", "-o", "out.exr"]) == 3
    assert "Traceback" not in capsys.readouterr().err
    assert run(["relight", "none.zarr", "-o", "out.exr", "-v"]) == 3
    assert "Traceback" in capsys.readouterr().err


def test_json_is_one_object_and_nothing_else(here, capsys):
    for arguments in (
        ("precompute", "scene.toml", "-o", "new.zarr", "--light-resolution", "16", "--workers", "1", "--dry-run"),
        ("precompute", "scene.toml", "-o", "new.zarr", "--light-resolution", "16", "--workers", "1"),
        ("relight", "t.zarr", "-o", "out.exr"),
        ("relight", "t.zarr", "-o", "out.exr", "--reference", "--spp", "2"),
        ("inspect", "t.zarr"),
        ("diff", "t.zarr", "t.zarr"),
    ):
        assert run([*arguments, "--json"]) == 0
        shown = capsys.readouterr()
        assert isinstance(json.loads(shown.out), dict)
        assert shown.out.count("\n") == 1
        assert shown.err == ""


def test_quiet_is_quiet(here, capsys):
    assert run(["relight", "t.zarr", "-o", "out.exr", "-q"]) == 0
    shown = capsys.readouterr()
    assert shown.out == shown.err == ""


def test_stdout_carries_the_picture_alone(here):
    piped = shell("$R relight t.zarr -o - > piped.exr", here)
    assert piped.returncode == 0
    assert run(["relight", "t.zarr", "-o", "named.exr", "-q"]) == 0
    assert (here / "piped.exr").read_bytes() == (here / "named.exr").read_bytes()


@pytest.mark.parametrize("command", ["relight t.zarr -o -", "inspect t.zarr --json", "diff t.zarr t.zarr --json"])
def test_a_reader_that_goes_away(here, command):
    done = shell(f"$R {command} | true; echo ${{PIPESTATUS[0]}}", here)
    assert done.stdout.strip() == b"0"
    assert b"Error" not in done.stderr
    assert b"Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("$R relight t.zarr -o - > /dev/full", 5),
        ("$R inspect t.zarr > /dev/full", 5),
        ("$R relight t.zarr -o - >&-", 5),
        ("$R relight t.zarr -o out.exr >&-", 0),
        ("$R relight t.zarr -o out.exr <&- >&- 2>&-", 0),
        ("$R precompute scene.toml -o new.zarr --light-resolution 16 --workers 1 <&- >&- 2>&-", 0),
    ],
)
def test_streams_that_are_full_or_closed(here, command, code):
    done = shell(command, here)
    assert done.returncode == code, done.stderr.decode()
    assert b"Traceback" not in done.stderr
    assert b"internal error" not in done.stderr
    assert b"Exception ignored" not in done.stderr
    if "new.zarr" in command:
        assert run(["inspect", "new.zarr", "--verify"]) == 0


def test_any_folder_and_any_name(here, tmp_path):
    """Spaces and letters beyond ASCII, in any locale, from any working folder."""
    place = tmp_path / "sp ace" / "ünï — 光"
    place.parent.mkdir()
    Path(here).rename(place)
    for locale in ("LC_ALL=C.UTF-8", "LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0"):
        done = shell(
            f"cd / && {locale} $R precompute '{place}/scene.toml' -o '{place}/a ü.zarr' --light-resolution 16 "
            f"--workers 1 --overwrite && cd '{place.parent}' && {locale} $R relight 'ünï — 光/a ü.zarr' -o 'ö.exr'",
            tmp_path,
        )
        assert done.returncode == 0, done.stderr.decode()
        assert (place.parent / "ö.exr").exists()
        (place.parent / "ö.exr").unlink()


def test_names_that_are_no_text(here):
    done = shell(r"mv sky-sky.exr $'sk\xff.exr'; $R relight t.zarr -o out.exr --env $'sk\xff.exr'", here)
    assert done.returncode == 2
    assert b"its name is not UTF-8" in done.stderr


HALF_DONE = """
import sys
from relightcli.cli import main


class Loop:
    def __del__(self):
        raise AttributeError("half made")


async def chunk():
    pass


def interrupted(*arguments, **options):
    loop, reading = Loop(), chunk()
    raise KeyboardInterrupt


main.group.main = interrupted
main.main(["diff", *sys.argv[1:]])
"""


@pytest.mark.parametrize("verbose", [False, True])
def test_interrupted_while_an_event_loop_is_made(tmp_path, verbose):
    command = [sys.executable, "-W", "default", "-c", HALF_DONE, *["-v"][: int(verbose)]]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=60)
    assert done.returncode == 130
    assert (done.stderr.count(b"\n") == 1) is not verbose
    assert b"interrupted" in done.stderr
