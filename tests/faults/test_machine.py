"""The machine says no: full disks and folders that cannot be written. Code 5, the file's name, a rerun that works."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from relightcli.adapters import files
from relightcli.cli.main import run
from tests.faults import harness


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("limit", [100, 1000, 20_000])
def test_full_disk(undisturbed, folder, limit, workers):
    """100 bytes: the first metadata; 1000: a mesh array; 20,000: a block's visibility, in the worker."""
    before = harness.limit_file_size(limit)
    code, stderr = harness.run(folder, *harness.PRECOMPUTE, "-o", "t.zarr", "--workers", workers, "-q", before=before)
    assert code == 5, stderr
    assert str(folder / "t.zarr.partial") in stderr
    assert "File too large" in stderr
    assert len(stderr.strip().splitlines()) == 1
    assert not (folder / "t.zarr").exists()
    code, stderr = harness.run(folder, *harness.PRECOMPUTE, "-o", "t.zarr", *harness.WORKERS)
    assert code == 0, stderr
    assert harness.content(folder / "t.zarr") == harness.content(undisturbed)


@pytest.mark.parametrize("name", ["out.exr", "out.png", "out.jpg", "out.hdr", "out.tif", "out.ply"])
def test_full_disk_under_a_picture(finished, monkeypatch, capsys, name):
    """Nothing is left of the new picture, and the old one is as it was. The disk is full when data is to reach it."""

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.chdir(finished)
    monkeypatch.setattr(files.os, "fsync", full)
    (finished / name).write_bytes(b"old")
    assert run(["relight", "t.zarr", "-o", name]) == 5
    assert f"relightcli: {name}: No space left on device\n" == capsys.readouterr().err
    assert (finished / name).read_bytes() == b"old"
    assert [p.name for p in finished.iterdir() if "partial" in p.name] == []


def test_a_device_without_room(finished):
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")
    (finished / "full.exr").symlink_to("/dev/full")
    code, stderr = harness.run(finished, "relight", "t.zarr", "-o", "full.exr")
    assert code == 5
    assert "full.exr: No space left on device" in stderr


@pytest.mark.parametrize(
    "arguments",
    [
        (*harness.PRECOMPUTE, "-o", "locked/t.zarr"),
        ("relight", "t.zarr", "-o", "locked/out.exr"),
        ("relight", "t.zarr", "-o", "locked/out.zarr"),
        ("relight", "t.zarr", "-o", "locked/out.exr", "--reference", "--spp", "2"),
    ],
    ids=["precompute", "picture", "radiance", "reference"],
)
def test_read_only_folder(finished, arguments):
    locked = finished / "locked"
    locked.mkdir()
    locked.chmod(0o555)
    try:
        code, stderr = harness.run(finished, *arguments, before=harness.drop_root_powers)
    finally:
        locked.chmod(0o755)
    if code == 99:
        pytest.skip("root may write anywhere and cannot give that up here (prctl refused)")
    assert code == 5, stderr
    assert "locked" in stderr
    assert "Permission denied" in stderr
    assert os.listdir(locked) == []


def test_unreadable_inputs(finished):
    for name, arguments in {
        "scene.toml": (*harness.PRECOMPUTE, "-o", "u.zarr"),
        "ball.obj": (*harness.PRECOMPUTE, "-o", "u.zarr"),
        "t.zarr/zarr.json": ("relight", "t.zarr", "-o", "out.exr"),
        "t.zarr/visibility/bits/c.0.0.0.0": ("relight", "t.zarr", "-o", "out.exr"),
        "frames.toml": ("relight", "t.zarr", "-o", "out.#.exr", "--frames", "frames.toml"),
    }.items():
        path = finished / name
        if name == "frames.toml":
            path.write_text("format = 1\nframes = 1\n")
        mode = path.stat().st_mode
        path.chmod(0)
        code, stderr = harness.run(finished, *arguments, before=harness.drop_root_powers)
        path.chmod(mode)
        if code == 99:
            pytest.skip("root may read anything and cannot give that up here (prctl refused)")
        assert code == 5, (name, stderr)
        assert name in stderr
        assert "ermission denied" in stderr
