"""The cache of factorised sets of materials."""

import multiprocessing
import shutil

import numpy as np
import pytest

import relight_formats as formats
from relightcli.core.brdf import direct_model as model
from relightcli.errors import InputError
from relightcli.stages import brdf_data

SMALL = {"ranks": (2, 4, 4), "resolution": 8}


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("RELIGHTCLI_CACHE", str(tmp_path / "deep" / "cache"))
    monkeypatch.setattr(model, "EXPONENTS", (0.0, 5.0, 50.0, 1e6))
    return tmp_path / "deep" / "cache"


def same(a, b):
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in model.ARRAYS)


def must_not_build(*_):
    raise AssertionError("built again")


def test_second_time_from_the_cache(cache, monkeypatch):
    made = brdf_data.direct_model("blinn-phong", **SMALL)
    (store,) = cache.glob("*.zarr")
    assert formats.open_store(store, "brdf").verify() == []
    assert formats.open_store(store).settings["family"] == "blinn-phong"
    monkeypatch.setattr(model, "build_direct_model", must_not_build)
    assert same(brdf_data.direct_model("blinn-phong", **SMALL), made)
    # Other arguments are another model.
    with pytest.raises(AssertionError):
        brdf_data.direct_model("blinn-phong", ranks=(3, 4, 4), resolution=8)


@pytest.mark.parametrize("damage", ["chunk", "root", "no root", "file"])
def test_damaged_cache_is_made_again(cache, damage):
    made = brdf_data.direct_model("blinn-phong", **SMALL)
    (store,) = cache.glob("*.zarr")
    if damage == "chunk":
        chunk = next(path for path in (store / "light").rglob("*") if path.is_file() and path.name != "zarr.json")
        chunk.write_bytes(b"\0" * 40)
    elif damage == "root":
        (store / "zarr.json").write_text("{")
    elif damage == "no root":
        (store / "zarr.json").unlink()
    else:
        shutil.rmtree(store)
        store.write_text("not a folder")
    assert same(brdf_data.direct_model("blinn-phong", **SMALL), made)
    assert formats.open_store(store, "brdf").verify() == []
    assert [path.name for path in cache.iterdir()] == [store.name]


def test_folder_that_cannot_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("RELIGHTCLI_CACHE", str(tmp_path / "file" / "cache"))
    monkeypatch.setattr(model, "EXPONENTS", (0.0, 5.0))
    assert len(brdf_data.direct_model("blinn-phong", **SMALL).parameters) == 2


def test_places(monkeypatch, tmp_path):
    monkeypatch.delenv("RELIGHTCLI_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert brdf_data.cache_folder() == tmp_path / "relightcli"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert brdf_data.cache_folder() == tmp_path / ".cache" / "relightcli"


def build(folder, queue):
    import os

    os.environ["RELIGHTCLI_CACHE"] = folder
    model.EXPONENTS = (0.0, 5.0, 50.0, 1e6)
    queue.put(brdf_data.direct_model("blinn-phong", **SMALL).light)


def test_two_builders_at_once(cache):
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    builders = [context.Process(target=build, args=(str(cache), queue)) for _ in range(2)]
    for builder in builders:
        builder.start()
    found = [queue.get(timeout=240) for _ in builders]
    for builder in builders:
        builder.join()
        assert builder.exitcode == 0
    np.testing.assert_array_equal(*found)
    (store,) = cache.glob("*.zarr")
    assert formats.open_store(store, "brdf").verify() == []


def test_unknown_family(cache):
    with pytest.raises(InputError, match="family"):
        brdf_data.direct_model("ward", **SMALL)
