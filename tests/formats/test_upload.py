"""Stores made at a URL: the commit mark comes last, work goes on, and a second writer does not write."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from relight_formats import Status, StoreError, open_store
from relight_formats.header import KEY, ROOT
from relight_formats.upload import CLAIM
from tests.formats.jobs import array_files, run, start, write

fsspec = pytest.importorskip("fsspec", reason="fsspec is not installed: pip install 'relightcli[cluster]'")
URL = "memory://bucket/deep/store.zarr"
PLACE = "/bucket/deep/store.zarr"


@pytest.fixture
def memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A file system without renames of folders, as object stores are; and an empty current directory."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    fs = fsspec.filesystem("memory")
    yield fs
    if fs.exists("/bucket"):
        fs.rm("/bucket", recursive=True)


def root(memory: Any) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(memory.cat_file(f"{PLACE}/{ROOT}"))["attributes"]
    return document


def files(memory: Any) -> set[str]:
    return {name.removeprefix(f"{PLACE}/") for name in memory.find(PLACE)}


def left() -> list[str]:
    """What lies in the current directory, without the digest of the URL."""
    return sorted(re.sub(r"\.[0-9a-f]{8}(?=\.|$)", "", path.name) for path in Path.cwd().iterdir())


def interrupt(factor: float = 1.0, **changes: Any) -> None:
    writer = start(URL, factor, **changes)
    assert writer is not None
    with writer:
        write(writer, factor, blocks=1)


def test_the_store_is_that_of_a_folder(memory, tmp_path: Path) -> None:
    run(tmp_path / "store.zarr")
    assert run(URL)
    there = open_store(URL)
    assert there.fingerprint == open_store(tmp_path / "store.zarr").fingerprint
    assert there.verify() == []
    for name in array_files(tmp_path / "store.zarr"):
        assert memory.cat_file(f"{PLACE}/{name}") == (tmp_path / "store.zarr" / name).read_bytes()
    assert CLAIM not in root(memory)
    assert left() == []
    assert start(URL) is None  # up to date


def test_the_mark_comes_last(memory, monkeypatch) -> None:
    writer = start(URL)
    with writer:
        write(writer)
        assert files(memory) == {ROOT}
        assert root(memory)[KEY]["complete"] is False
        with pytest.raises(StoreError, match="unfinished"):
            open_store(URL)
        written = []
        pipe = memory.pipe_file

        def spy(path: str, value: bytes, **more: Any) -> None:
            written.append((path, files(memory)))
            pipe(path, value, **more)

        monkeypatch.setattr(memory, "pipe_file", spy)
        writer.commit({})
    before = [there for path, there in written if path == f"{PLACE}/{ROOT}"][-1]
    assert before == files(memory)  # the last write added no file: all others were there


def test_interrupted_work_is_taken_up(memory) -> None:
    interrupt()
    assert left() == ["store.zarr.partial"]
    writer = start(URL)
    assert writer.status is Status.RESUMED
    assert len(writer.done) == 1
    writer.close()
    assert run(URL)
    assert open_store(URL).verify() == []
    assert left() == []


def test_what_could_not_be_sent_is_sent_by_the_next_run(memory, monkeypatch) -> None:
    put, sent = memory.put, []

    def fail(local: list[str], there: list[str]) -> None:
        put(local[:1], there[:1])
        sent.append(there[0])
        raise OSError("the network is down")

    with monkeypatch.context() as broken:
        broken.setattr(memory, "put", fail)
        with pytest.raises(OSError, match="network"):
            run(URL)
    assert sent
    with pytest.raises(StoreError, match="unfinished"):
        open_store(URL)
    assert left() == ["store.zarr"]
    memory.pipe_file(f"{PLACE}/stray", b"of a killed run")
    assert start(URL) is None
    assert open_store(URL).verify() == []
    assert left() == []


def test_a_second_writer_is_refused(memory, tmp_path: Path, monkeypatch) -> None:
    interrupt()
    with start(URL), pytest.raises(StoreError, match="another process is writing this store"):
        start(URL)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    with pytest.raises(StoreError, match=r"another process is making this store.*work/store.zarr.*begun"):
        start(URL)
    assert left() == []
    assert run(URL, overwrite=True)
    monkeypatch.chdir(tmp_path / "work")
    assert start(URL) is None  # the store that it wanted is there


def test_a_writer_whose_place_was_taken_does_not_send(memory, tmp_path: Path, monkeypatch) -> None:
    writer = start(URL)
    write(writer)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert run(URL, 2.0, overwrite=True)
    with writer, pytest.raises(StoreError, match="another process has written there meanwhile"):
        writer.commit({})
    assert open_store(URL).settings["factor"] == 2.0
    assert open_store(URL).verify() == []
    monkeypatch.chdir(tmp_path / "work")
    assert left() == ["store.zarr"]  # kept
    assert start(URL, overwrite=True) is None
    assert open_store(URL).settings["factor"] == 1.0


def test_a_finished_store_stays_until_the_new_one_is_sent(memory) -> None:
    run(URL)
    with pytest.raises(StoreError, match=r"setting factor: 1\.0 there, 2.0 asked for"):
        start(URL, 2.0)
    writer = start(URL, 2.0, overwrite=True)
    with writer:
        write(writer, 2.0)
        assert open_store(URL).settings["factor"] == 1.0
        writer.commit({})
    assert open_store(URL).settings["factor"] == 2.0
    assert open_store(URL).verify() == []


def test_what_is_no_store_is_not_touched(memory) -> None:
    memory.pipe_file(f"{PLACE}/letter", b"dear")
    with pytest.raises(StoreError, match="found other files"):
        start(URL, overwrite=True)
    memory.pipe_file(f"{PLACE}/{ROOT}", b'{"zarr_format": 3}')
    with pytest.raises(StoreError, match="found something else"):
        start(URL, overwrite=True)
    assert files(memory) == {"letter", ROOT}
    assert left() == []


def test_abandoned_work_leaves_nothing(memory) -> None:
    writer = start(URL)
    assert writer is not None
    assert files(memory) == {ROOT}
    writer.abandon()
    assert files(memory) == set()
    assert left() == []
    run(URL)
    writer = start(URL, 2.0, overwrite=True)
    assert writer is not None
    writer.abandon()  # a finished store stays
    assert open_store(URL).attrs is not None
