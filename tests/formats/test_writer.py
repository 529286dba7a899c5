"""Writing arrays: what comes back, what is refused, and what happens when the disk is full."""

from __future__ import annotations

import contextlib
import errno
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from relight_formats import StoreError, Writer, begin, open_store, worker_array
from tests.formats.jobs import array_files, run, start, write

TYPES = ["bool", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f2", "f4", "f8", ">f4", ">i2"]


def new(path: Path) -> Writer:
    writer = begin(path, "test", settings={}, inputs={}, program="test 1", overwrite=True)
    assert writer is not None
    return writer


@settings(max_examples=60, deadline=None)
@given(st.data(), st.sampled_from(TYPES), st.sampled_from(["lz4", "zstd", "zstd_shuffled", "none"]))
def test_any_array_comes_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, dtype: str, codec: Any
) -> None:
    shape = data.draw(array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=5))
    values = data.draw(arrays(dtype, shape))
    chunks = [data.draw(st.integers(1, 6)) for _ in shape]
    dims = [f"axis{i}" for i in range(len(shape))]
    path = tmp_path_factory.mktemp("array") / "store"
    with new(path) as writer:
        writer.put("whole/array", values, dims=dims, codec=codec)
        chunked = writer.array("chunked", shape=shape, dtype=dtype, chunks=chunks, dims=dims, codec=codec)
        if values.size:
            chunked[...] = values
        writer.commit({})
    store = open_store(path)
    assert store.verify() == []
    for name in ("whole/array", "chunked"):
        back = store.read(name)
        assert back.shape == values.shape
        assert back.dtype == values.dtype.newbyteorder("<")
        assert back.tobytes() == values.astype(back.dtype).tobytes()  # NaN payloads and signed zeros included


def test_metadata_carries_names_units_and_attributes(tmp_path: Path) -> None:
    with new(tmp_path / "store") as writer:
        writer.put("a", np.zeros((2, 3)), dims=("V", "C"), units="sr", attrs={"bits": np.int64(3)})
        writer.put("b", np.zeros(2), dims=("V",))
        writer.commit({})
    store = open_store(tmp_path / "store")
    assert store.layouts["a"].dims == ("V", "C")
    assert dict(store.array("a").attrs) == {"units": "sr", "bits": 3}
    assert dict(store.array("b").attrs) == {"units": "1"}


def test_put_cuts_chunks_of_about_4_megabytes(tmp_path: Path) -> None:
    with new(tmp_path / "store") as writer:
        writer.put("a", np.zeros((1000, 5000), np.float32), dims=("V", "L"))  # 20 MB, rows of 20 kB
        writer.commit({})
    array = open_store(tmp_path / "store").array("a")
    assert array.chunks == (209, 5000)  # 209 * 20000 <= 2^22 < 210 * 20000


def test_two_runs_write_the_same_bytes(tmp_path: Path) -> None:
    run(tmp_path / "a")
    run(tmp_path / "b")
    assert array_files(tmp_path / "a") == array_files(tmp_path / "b")
    assert len(array_files(tmp_path / "a")) == 3 + 1 + 4  # chunks of two arrays, metadata of two arrays and two groups


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": "../out"}, "expected letters"),
        ({"name": "/abs"}, "expected letters"),
        ({"name": "a//b"}, "expected letters"),
        ({"name": "a.b"}, "expected letters"),
        ({"name": ""}, "expected letters"),
        ({"name": "ledger/x"}, "reserved"),
        ({"dtype": "c8"}, "not one of"),
        ({"dtype": "U3"}, "not one of"),
        ({"dtype": object}, "not one of"),
        ({"dims": ("V",)}, "same length"),
        ({"dims": ("V", "V")}, "name of its own"),
        ({"dims": ("V", "")}, "name of its own"),
        ({"shape": (-1, 3)}, "must not be negative"),
        ({"chunks": (0, 3)}, "must be positive"),
        ({"shape": (1 << 30, 3), "chunks": (1 << 30, 3)}, "larger than 1024 MiB"),
        ({"codec": "pickle"}, "expected one of none, lz4, zstd"),
        ({"attrs": {"scale_factor": 2}}, "meaning to readers"),
        ({"attrs": {"x": float("nan")}}, "finite"),
        ({"dtype": "i4", "fill": 0.5}, "not a whole number"),
    ],
)
def test_what_the_format_does_not_allow_is_refused(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    given_: dict[str, Any] = {"name": "a", "shape": (2, 3), "dtype": "f4", "chunks": (2, 3), "dims": ("V", "C")}
    given_ |= changes
    with new(tmp_path / "store") as writer, pytest.raises(ValueError, match=words):
        writer.array(given_.pop("name"), **given_)


def test_one_size_per_dimension_name_in_related_groups(tmp_path: Path) -> None:
    with new(tmp_path / "store") as writer:
        writer.put("a/x", np.zeros(3), dims=("V",))
        writer.put("b/x", np.zeros(4), dims=("V",))  # beside, not above or below
        for name in ("a/y", "y", "a/deep/y"):
            with pytest.raises(ValueError, match="dimension V has size 5, but 3 in a/x"):
                writer.put(name, np.zeros(5), dims=("V",))
        with pytest.raises(ValueError, match="cannot lie inside an array"):
            writer.put("a/x/y", np.zeros(3), dims=("V",))
        with pytest.raises(ValueError, match="cannot lie inside an array"):
            writer.put("a", np.zeros(3), dims=("V",))


def test_blocks_are_recorded_once_and_read_back(tmp_path: Path) -> None:
    with new(tmp_path / "store") as writer:
        writer.record("b0", {"seconds": np.float32(0.5), "rays": 10})
        with pytest.raises(ValueError, match="recorded already"):
            writer.record("b0", {})
        with pytest.raises(ValueError, match=r"block b1\.error.*finite"):
            writer.record("b1", {"error": float("nan")})
        assert writer.done == {"b0"}
        writer.commit({"rays": 10})
    store = open_store(tmp_path / "store")
    assert store.blocks == [{"id": "b0", "seconds": 0.5, "rays": 10}]
    assert store.summary == {"rays": 10}


def test_attributes_are_merged_and_the_header_is_out_of_reach(tmp_path: Path) -> None:
    with new(tmp_path / "store") as writer:
        writer.set_attrs({"a": 1, "b": (1, 2)})
        writer.set_attrs({"a": 2})
        with pytest.raises(ValueError, match="reserved"):
            writer.set_attrs({"relight": {}})
        writer.commit({})
    assert open_store(tmp_path / "store").attrs == {"a": 2, "b": [1, 2]}


def test_commit_refuses_when_a_chunk_was_never_written(tmp_path: Path) -> None:
    with new(tmp_path / "store") as writer:
        array = writer.array("a", shape=(6,), dtype="f4", chunks=(2,), dims=("V",))
        array[:4] = 0  # fill values, and written all the same
        with pytest.raises(StoreError, match=r"array a: expected 3 chunks, 1 were never written \(c.2\)"):
            writer.commit({})
    assert not (tmp_path / "store").exists()


def test_a_closed_writer_says_so(tmp_path: Path) -> None:
    with new(tmp_path / "store") as writer:
        writer.commit({})
    with pytest.raises(ValueError, match="this writer is closed"):
        writer.record("x", {})
    with pytest.raises(ValueError, match="this writer is closed"):
        writer.commit({})


def test_workers_get_the_arrays_that_were_made_and_no_others(tmp_path: Path) -> None:
    with new(tmp_path / "store") as writer:
        writer.array("a", shape=(2,), dtype="f4", chunks=(2,), dims=("V",))
        worker_array(writer.partial_path, "a")[...] = 7
        assert worker_array(str(writer.partial_path), "a")[1] == 7
        with pytest.raises(StoreError, match=r"zarr\.json is missing"):
            worker_array(writer.partial_path, "b")
        with pytest.raises(ValueError, match="expected letters"):
            worker_array(writer.partial_path, "../a")


def test_what_only_the_work_needs_is_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also after a crash halfway through, of which a group with some of its files is left."""
    with new(tmp_path / "store") as writer:
        for name in ("f/work/a", "f/work/b", "f/works", "f/kept"):
            writer.put(name, np.zeros(2), dims=("V",))
        writer.record("made", {})
        writer.drop("f/work/b")
        assert sorted(writer.layouts) == ["f/kept", "f/work/a", "f/works"]

        def crash(folder: Path) -> None:
            (folder / "a/zarr.json").unlink()
            raise OSError(5, "crash")

        with monkeypatch.context() as patched:
            patched.setattr("relight_formats.writer.remove_store", crash)
            with pytest.raises(OSError, match="crash"):
                writer.drop("f/work")
    again = begin(tmp_path / "store", "test", settings={}, inputs={}, program="test 1")
    assert again is not None
    with again as writer:
        assert writer.done == {"made"}
        writer.drop("f/work")
        writer.drop("f/work")
        with pytest.raises(ValueError, match="expected letters"):
            writer.drop("../store")
        writer.commit({})
    store = open_store(tmp_path / "store")
    assert store.names() == ["f/kept", "f/works"]
    assert store.verify() == []


def test_leftover_temporary_files_are_swept(tmp_path: Path) -> None:
    with new(tmp_path / "store") as writer:
        writer.put("a", np.zeros(2), dims=("V",))
        (writer.partial_path / "a/c.0.0123.partial").write_text("torn")
        writer.commit({})
    assert open_store(tmp_path / "store").verify() == []


def test_chunks_and_their_names_are_on_disk_before_the_ledger_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    real = os.fsync

    def watched(descriptor: int) -> None:
        synced.append(Path(os.readlink(f"/proc/self/fd/{descriptor}")).name)
        real(descriptor)

    if not Path("/proc/self/fd").exists():
        pytest.skip("needs /proc to name open files")
    with new(tmp_path / "store") as writer:
        array = writer.array("a", shape=(2,), dtype="f4", chunks=(2,), dims=("V",))
        monkeypatch.setattr(os, "fsync", watched)
        array[...] = 1
        writer.record("b", {})
        monkeypatch.undo()
    chunk, folder, ledger = synced
    assert chunk.startswith("c.0.")
    assert (folder, ledger) == ("a", "ledger.jsonl")


def test_a_full_disk_surfaces_as_oserror_at_every_write_and_the_next_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tmp_path / "reference")
    real = os.fsync
    failures = 0
    while True:
        path = tmp_path / f"{failures}.zarr"
        left = failures

        def full(descriptor: int) -> None:
            nonlocal left
            left -= 1
            if left < 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            real(descriptor)

        monkeypatch.setattr(os, "fsync", full)
        with contextlib.suppress(OSError):
            run(path)
            break
        monkeypatch.undo()
        if path.exists():  # the failure came after the final name was taken
            assert open_store(path).verify() == []
        run(path)
        assert array_files(path) == array_files(tmp_path / "reference")
        failures += 1
    monkeypatch.undo()
    # At least one sync for each of 4 chunks, 5 documents, 3 ledger lines and 3 roots.
    assert failures >= 15


@pytest.mark.skipif(not Path("/sys").is_dir(), reason="needs a folder where nobody may write")
def test_no_permission_is_an_oserror() -> None:
    with pytest.raises(OSError, match="relight-test"):
        start(Path("/sys/relight-test.zarr"))


def test_metadata_on_disk_is_in_the_documented_spelling(tmp_path: Path) -> None:
    writer = start(tmp_path / "store")
    assert writer is not None
    with writer:
        write(writer)
        writer.commit({})
    for file in (tmp_path / "store").rglob("zarr.json"):
        document = json.loads(file.read_bytes())
        assert file.read_text() == json.dumps(document, indent=2, sort_keys=True) + "\n"


def test_abandoned_work_is_deleted_and_a_finished_store_is_not(tmp_path: Path) -> None:
    writer = start(tmp_path / "store")
    assert writer is not None
    writer.abandon()
    writer.abandon()
    assert list(tmp_path.iterdir()) == []
    run(tmp_path / "store")
    with new(tmp_path / "other") as writer:
        writer.commit({})
        writer.abandon()  # interrupted between the commit and the end
    assert open_store(tmp_path / "store").fingerprint
    assert open_store(tmp_path / "other").fingerprint
