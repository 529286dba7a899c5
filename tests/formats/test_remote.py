"""Stores at a URL: read as those in a folder, and damage is found there too."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from relight_formats import StoreError, open_store
from relight_formats.header import ROOT
from tests.formats.jobs import run

fsspec = pytest.importorskip("fsspec", reason="fsspec is not installed: pip install 'relightcli[cluster]'")
URL = "memory://bucket/deep/store.zarr"


@pytest.fixture
def memory():
    """A file system without folders, links or renames of folders, as object stores are."""
    fs = fsspec.filesystem("memory")
    yield fs
    fs.rm("/bucket", recursive=True)


@pytest.fixture
def both(tmp_path: Path, memory):
    """A store in a folder, and a copy of it at `URL`."""
    run(tmp_path / "store.zarr")
    memory.put(f"{tmp_path}/store.zarr", "/bucket/deep/store.zarr", recursive=True)
    return open_store(tmp_path / "store.zarr"), open_store(URL)


def chunk_of(memory) -> str:
    return sorted(name for name in memory.find("/bucket/deep/store.zarr/direct/transfer") if "/c." in name)[0]


def test_everything_is_as_in_the_folder(both) -> None:
    local, remote = both
    assert str(remote.path).startswith("memory://")
    for name in ("kind", "settings", "inputs", "attrs", "blocks", "fingerprint", "layouts", "ledger"):
        assert getattr(local, name) == getattr(remote, name)
    for name in local.names():
        np.testing.assert_array_equal(local.read(name), remote.read(name))
        assert remote.array(name).shape == local.layouts[name].shape
    assert remote.sizes() == local.sizes()
    assert remote.verify() == []


def test_a_part_of_an_array_reads_its_chunks_only(both, memory) -> None:
    _, remote = both
    array = remote.array("direct/transfer")
    read = []
    memory.cat_file, cat_file = lambda path, **more: (read.append(path), cat_file(path, **more))[1], memory.cat_file
    try:
        _ = array[: array.chunks[0]]
    finally:
        del memory.cat_file
    assert [name.rpartition("/")[2] for name in read] == ["c.0" + ".0" * (array.ndim - 1)]


def test_a_flipped_bit_and_a_missing_chunk_are_found(both, memory) -> None:
    _, remote = both
    name = chunk_of(memory)
    data = bytearray(memory.cat_file(name))
    data[len(data) // 2] ^= 1
    memory.pipe_file(name, bytes(data))
    with pytest.raises(StoreError, match="does not match its checksum"):
        remote.read("direct/transfer")
    assert len(remote.verify()) == 1
    memory.rm(name)
    with pytest.raises(StoreError, match="is missing"):
        remote.read("direct/transfer")
    memory.pipe_file("/bucket/deep/store.zarr/stranger", b"x")
    assert [p.partition(": ")[2] for p in remote.verify()][-1] == "stranger does not belong to the store."


def test_a_copy_without_its_commit_mark_or_metadata_is_refused(both, memory) -> None:
    root = f"/bucket/deep/store.zarr/{ROOT}"
    document = memory.cat_file(root)
    memory.pipe_file("/bucket/deep/store.zarr/direct/zarr.json", b"{}")
    with pytest.raises(StoreError, match="does not match its digest"):
        open_store(URL)
    memory.rm("/bucket/deep/store.zarr/direct/zarr.json")
    with pytest.raises(StoreError, match=r"zarr\.json is missing"):
        open_store(URL)
    memory.rm(root)  # written last by whoever copies a store: it is what makes it one
    with pytest.raises(StoreError, match=r"without zarr\.json"):
        open_store(URL)
    memory.pipe_file(root, json.dumps({**json.loads(document), "zarr_format": 2}).encode())
    with pytest.raises(StoreError, match="found another kind"):
        open_store(URL)


def test_nothing_there(memory) -> None:
    memory.pipe_file("/bucket/file", b"x")
    with pytest.raises(StoreError, match="expected a relight store, found nothing"):
        open_store("memory://bucket/nothing")
    with pytest.raises(StoreError, match="expected a relight store, found a file"):
        open_store("memory://bucket/file")


def test_a_file_url_is_a_folder(tmp_path: Path) -> None:
    run(tmp_path / "a store.zarr")
    assert open_store(f"file://{tmp_path}/a%20store.zarr").path == tmp_path / "a store.zarr"


def test_without_fsspec_the_user_is_told_what_to_install(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(StoreError, match=r"pip install 'relightcli\[cluster\]'"):
        open_store(URL)
