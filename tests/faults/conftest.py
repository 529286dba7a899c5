"""A scene of several blocks that takes a few seconds, and the store that an undisturbed run makes of it."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from relightcli.scene.model import Camera
from tests.core.transport.scenes import lambert, sphere, square
from tests.faults import harness
from tests.stages.scene_files import write_scene


def make_scene(folder):
    parts = {"ground": square(3, material=lambert(0.5)), "ball": sphere(0.5, (0, 0.6, 0), rings=14)}
    sky = np.random.default_rng(5).random((8, 16, 3))
    return write_scene(folder, parts, [Camera("main", (0, 1.5, 4), (0, 0.5, 0), size=(32, 24))], {"sky": sky}, True)


@pytest.fixture(autouse=True)
def nothing_left_running():
    yield
    harness.clear()


@pytest.fixture(scope="session")
def workplace(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("workplace")).parent


@pytest.fixture(scope="session")
def undisturbed(workplace, tmp_path_factory):
    """The store that one process makes of the scene in one go. Not to be changed."""
    code, stderr = harness.run(workplace, *harness.PRECOMPUTE, "-o", "t.zarr", "--workers", 1)
    assert code == 0, stderr
    # Made in the place where the other stores are made, because a store's description holds absolute paths.
    target = tmp_path_factory.mktemp("undisturbed") / "t.zarr"
    shutil.move(workplace / "t.zarr", target)
    return target


@pytest.fixture
def folder(workplace, undisturbed):
    """The scene's folder with nothing but the scene in it."""
    kept = {path.name: path.read_bytes() for path in workplace.iterdir()}
    yield workplace
    for path in workplace.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    for name, data in kept.items():
        (workplace / name).write_bytes(data)


@pytest.fixture
def finished(folder, undisturbed):
    """The scene's folder with a copy of its finished store, `t.zarr`."""
    shutil.copytree(undisturbed, folder / "t.zarr")
    return folder
