"""Opening, reading and verifying finished stores; damage of any kind is found."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from relight_formats import CONVENTIONS, ArraySize, StoreError, open_store, progress
from tests.formats.jobs import run, start, values, write


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sound") / "store.zarr"
    run(path)
    return path


@pytest.fixture
def path(sound: Path, tmp_path: Path) -> Path:
    shutil.copytree(sound, tmp_path / "store.zarr")
    return tmp_path / "store.zarr"


def test_everything_that_was_written_is_there(sound: Path) -> None:
    store = open_store(sound, kind="test")
    assert (store.path, store.kind, store.program) == (sound, "test", "test 1")
    assert store.settings == {"factor": 1.0, "nested": {"list": [1, 2]}}
    assert store.inputs == {"scene": "sha256:" + "0" * 64}
    assert store.attrs == {"scene": {"name": "test"}}
    assert [block["id"] for block in store.blocks] == ["direct/0", "direct/10", "direct/20"]
    assert store.names() == ["direct/transfer", "geometry/points"]
    assert "direct/transfer" in store
    assert "direct" not in store
    np.testing.assert_array_equal(store.read("direct/transfer"), values())
    np.testing.assert_array_equal(store.array("direct/transfer")[5:8, 3], values()[5:8, 3])
    assert store.verify() == []


def test_sizes_are_those_on_disk(sound: Path) -> None:
    chunks = (sound / "direct/transfer").glob("c.*")
    expected = ArraySize(stored=sum(chunk.stat().st_size for chunk in chunks), raw=values().nbytes)
    assert open_store(sound).sizes()["direct/transfer"] == expected


def test_the_header_repeats_the_conventions(sound: Path) -> None:
    header = json.loads((sound / "zarr.json").read_bytes())["attributes"]["relight"]
    assert header["conventions"] == CONVENTIONS


def test_stores_cannot_be_written_through(sound: Path) -> None:
    with pytest.raises(ValueError, match=r"read-only|read only"):
        open_store(sound).array("direct/transfer")[0, 0] = 1


def test_another_kind_is_refused(sound: Path) -> None:
    with pytest.raises(StoreError, match="expected a store of kind asset, found test"):
        open_store(sound, kind="asset")


def test_an_unknown_array_is_named_with_those_there(sound: Path) -> None:
    with pytest.raises(StoreError, match="expected an array nothing, found direct/transfer, geometry/points"):
        open_store(sound).read("nothing")


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="expected a relight store, found nothing"):
        open_store(tmp_path / "nothing")
    (tmp_path / "file").write_text("x")
    with pytest.raises(StoreError, match="expected a relight store, found a file"):
        open_store(tmp_path / "file")
    with pytest.raises(StoreError, match="a URL that fsspec can open"):
        open_store("nothing://example.org/store.zarr")


def test_unfinished_work_does_not_open_and_shows_its_progress(tmp_path: Path) -> None:
    path = tmp_path / "store.zarr"
    writer = start(path)
    assert writer is not None
    with writer:
        write(writer, blocks=2)
    for name in (path, writer.partial_path):
        with pytest.raises(StoreError, match="unfinished"):
            open_store(name)
        seen = progress(name)
        assert seen["kind"] == "test"
        assert [block["id"] for block in seen["blocks"]] == ["direct/0", "direct/10"]
        assert seen["bytes"] == sum(f.stat().st_size for f in writer.partial_path.rglob("*") if f.is_file())
    run(path)
    with pytest.raises(StoreError, match="found a finished store"):
        progress(path)


def test_a_copy_or_a_moved_store_is_the_same_store(path: Path, sound: Path) -> None:
    assert open_store(path).fingerprint == open_store(sound).fingerprint
    assert open_store(path).verify() == []


def test_the_fingerprint_tells_results_apart_and_leaves_out_costs(sound: Path, tmp_path: Path) -> None:
    run(tmp_path / "other", 2.0)
    assert open_store(tmp_path / "other").fingerprint != open_store(sound).fingerprint
    writer = start(tmp_path / "again")
    assert writer is not None
    with writer:
        write(writer)
        writer.record("more", {"seconds": 99})
        writer.commit({"seconds": 99})
    assert open_store(tmp_path / "again").fingerprint == open_store(sound).fingerprint


def problems(path: Path) -> list[str]:
    try:
        return open_store(path).verify()
    except StoreError as error:
        return [str(error)]


def test_a_flipped_bit_anywhere_is_found(path: Path) -> None:
    flips = 0
    for file in sorted(f for f in path.rglob("*") if f.is_file()):
        content = file.read_bytes()
        # Every 13th byte and the last: more than a hundred places in the root alone, all digests and spaces among them.
        for position in [*range(0, len(content), 13), len(content) - 1]:
            damaged = bytearray(content)
            damaged[position] ^= 1 << (position % 8)
            file.write_bytes(damaged)
            assert problems(path), f"{file.name} byte {position}"
            flips += 1
        file.write_bytes(content)
    assert flips > 300
    assert problems(path) == []


def test_a_letter_changed_to_one_that_json_reads_alike_is_found(path: Path) -> None:
    root = path / "zarr.json"
    content = root.read_bytes()
    assert content.count(b"1e-05") == 1
    root.write_bytes(content.replace(b"1e-05", b"1E-05"))
    assert problems(path) == [f"{path}: zarr.json is not spelled as it was written."]


def test_every_file_cut_short_emptied_or_deleted_is_found(path: Path) -> None:
    files = sorted(f for f in path.rglob("*") if f.is_file())
    assert len(files) == 10
    for file in files:
        content = file.read_bytes()
        for cut in (0, 3, len(content) // 2, len(content) - 1):
            file.write_bytes(content[:cut])
            assert problems(path), f"{file} cut to {cut}"
        file.unlink()
        assert problems(path), f"{file} deleted"
        file.write_bytes(content)
    assert problems(path) == []


@pytest.mark.parametrize("damage", ["flip", "cut", "delete"])
def test_reading_names_array_file_and_remedy(path: Path, damage: str) -> None:
    chunk = path / "direct/transfer/c.1.0"
    content = bytearray(chunk.read_bytes())
    if damage == "delete":
        chunk.unlink()
    elif damage == "cut":
        chunk.write_bytes(content[:-1])
    else:
        content[len(content) // 2] ^= 16
        chunk.write_bytes(content)
    store = open_store(path)
    for read in (lambda: store.read("direct/transfer"), lambda: store.array("direct/transfer")[12]):
        with pytest.raises(StoreError, match=r"array direct/transfer: chunk file .*c\.1\.0 .*--overwrite"):
            read()
    # The damage is where it is: other chunks read as they were.
    np.testing.assert_array_equal(store.array("direct/transfer")[:10], values()[:10])


def test_the_errors_load_neither_numpy_nor_zarr_and_opening_no_zarr(sound: Path) -> None:
    code = (
        "import sys, relight_formats; relight_formats.StoreError; assert not {'numpy', 'zarr'} & set(sys.modules)\n"
        "relight_formats.open_store(sys.argv[1]); assert 'zarr' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code, str(sound)], check=True)


def test_every_public_name_is_there() -> None:
    import relight_formats

    for name in relight_formats.__all__:
        assert getattr(relight_formats, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = relight_formats.nothing
