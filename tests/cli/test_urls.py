"""Commands that read a store at a URL give what they give for the folder."""

from __future__ import annotations

import json

import numpy as np
import pytest

from relightcli.adapters.images import read_image
from relightcli.cli.main import run

fsspec = pytest.importorskip("fsspec", reason="fsspec is not installed: pip install 'relightcli[cluster]'")
URL = "memory://bucket/t.zarr"


@pytest.fixture
def remote(here):
    fs = fsspec.filesystem("memory")
    fs.put(str(here / "t.zarr"), "/bucket/t.zarr", recursive=True)
    yield fs
    fs.rm("/bucket", recursive=True)


def test_inspect(here, remote, capsys):
    assert run(["inspect", "t.zarr", "--verify", "--json"]) == 0
    local = json.loads(capsys.readouterr().out)
    assert run(["inspect", URL, "--verify", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {**local, "store": URL}
    remote.rm(remote.glob("/bucket/t.zarr/visibility/bits/c.*")[0])
    assert run(["inspect", URL, "--verify", "-q"]) == 3


def test_relight_and_diff(here, remote, capsys):
    assert run(["relight", "t.zarr", "--env", "sky", "-o", "local.exr", "-q"]) == 0
    assert run(["relight", URL, "--env", "sky", "-o", "remote.exr", "-q"]) == 0
    np.testing.assert_array_equal(read_image(here / "local.exr").pixels, read_image(here / "remote.exr").pixels)
    assert run(["diff", URL, "t.zarr"]) == 0
    assert run(["diff", "t.zarr", "file://" + str(here / "t.zarr")]) == 0


def test_what_is_not_there_and_what_cannot_be_written(here, remote, refused):
    refused(["relight", "memory://bucket/other.zarr", "--env", "sky", "-o", "x.exr"], "found nothing", code=3)
    refused(["inspect", "nothing://x/t.zarr"], "nothing://x/t.zarr", code=3)
    refused(["precompute", "scene.toml", "-o", "nothing://x/new.zarr"], "nothing")
    refused(["relight", "t.zarr", "--env", "sky", "-o", "memory://bucket/new.exr"], "only stores are written to a URL")
    refused(["tradeoff", "scene.toml", "-o", "memory://bucket/report"], "only stores are written to a URL")


def test_stores_are_made_at_a_url(here, remote, capsys):
    made = "memory://bucket/made.zarr"
    command = ["precompute", "scene.toml", "--light-resolution", "16", "--no-subdivide", "--bounces", "0", "-o"]
    assert run([*command, made, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["store"], told["status"]) == (made, "written")
    assert run(["diff", "t.zarr", made]) == 0
    capsys.readouterr()
    assert run([*command, made, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "up to date"
    assert run([*command, made, "--light-resolution", "32", "-q"]) == 3
    assert (
        run(["cluster", made, "-o", "memory://bucket/c.zarr", "--light-resolution", "16", "--lights", "24", "-q"]) == 0
    )
    assert run(["inspect", "memory://bucket/c.zarr", "--verify", "-q"]) == 0
    assert run(["relight", made, "--env", "sky", "-o", "memory://bucket/radiance.zarr", "-q"]) == 0
    assert run(["relight", made, "--env", "sky", "-o", "radiance.zarr", "-q"]) == 0
    assert run(["diff", "radiance.zarr", "memory://bucket/radiance.zarr"]) == 0
    assert not list(here.glob("*.partial"))
    assert not list(here.glob("made*"))
