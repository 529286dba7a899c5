"""A scene of a few dozen vertices and its store, and the command line called in this process."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from relightcli.cli.main import run
from relightcli.scene.model import Camera, Material
from tests.core.transport.scenes import lambert, sphere, square
from tests.stages.scene_files import make_store, write_scene


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    parts = {
        "ground": square(3, material=lambert(0.5)),
        "ball": sphere(0.5, (0, 0.6, 0), rings=4, material=Material("ball", "cook-torrance", specular=(0.5, 0.5, 0.5))),
    }
    sky = np.random.default_rng(5).random((8, 16, 3))
    camera = Camera("main", (0, 1.5, 4), (0, 0.5, 0), size=(8, 6))
    scene = write_scene(tmp_path_factory.mktemp("small"), parts, [camera], {"sky": sky}, adjustable=True)
    make_store(scene, "t.zarr", light_resolution=16, subdivide=False)
    return scene.parent


@pytest.fixture
def here(small, tmp_path, monkeypatch):
    """The working folder: a copy of scene.toml, its files, and t.zarr."""
    target = tmp_path / "here"
    shutil.copytree(small, target)
    monkeypatch.chdir(target)
    return target


@pytest.fixture
def refused(capsys):
    """Calls a command that must fail; checks its exit code and that one short message says all the `words`."""

    def check(arguments, words, code=2):
        found = run([str(a) for a in arguments])
        shown = capsys.readouterr()
        assert found == code, shown.err
        assert shown.out == ""
        assert "Traceback" not in shown.err
        assert "internal error" not in shown.err
        assert shown.err.startswith(("relightcli: ", "Usage: "))
        if shown.err.startswith("relightcli: "):
            assert len(shown.err.strip().splitlines()) <= 2, shown.err
        for word in (words,) if isinstance(words, str) else words:
            assert word in shown.err, shown.err

    return check
