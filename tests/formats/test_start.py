"""Beginning a store: nothing to do, resume, refuse, overwrite."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from relight_formats import Status, StoreError, begin, open_store, progress
from relight_formats.header import read_root, write_root
from relight_formats.lock import Lock
from tests.formats.jobs import ROWS, array_files, run, start, values, write


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "store.zarr"


def interrupt(path: Path, factor: float = 1.0, **changes: Any) -> None:
    """Leave unfinished work with one block of three."""
    writer = start(path, factor, **changes)
    assert writer is not None

    def killed_by_the_user() -> None:
        with writer:
            write(writer, factor, blocks=1)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        killed_by_the_user()


def test_a_finished_store_is_left_alone_and_its_time_stamp_refreshed(path: Path) -> None:
    assert run(path)
    before = array_files(path)
    os.utime(path / "zarr.json", (1, 1))
    assert start(path) is None
    assert (path / "zarr.json").stat().st_mtime > 1e9
    assert array_files(path) == before
    assert sorted(p.name for p in path.parent.iterdir()) == ["store.zarr"]


def test_other_program_versions_do_not_disturb_a_finished_store(path: Path) -> None:
    run(path)
    assert start(path, program="test 2") is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"factor": 2.0}, "setting factor: 1.0 there, 2.0 asked for"),
        ({"settings": {"factor": 1.0}}, "setting nested: .* there, nothing asked for"),
        (
            {"settings": {"factor": 1.0, "nested": {"list": [1, 3]}}},
            r"setting nested.list: \[1, 2\] there, \[1, 3\] asked",
        ),
        ({"inputs": {"scene": "sha256:11"}}, 'input scene: "?sha256:0{12} there, "?sha256:11 asked for'),
        ({"inputs": {}}, "input scene: sha256:0+ there, nothing asked for"),
    ],
)
@pytest.mark.parametrize("finished", [True, False])
def test_other_inputs_or_settings_are_refused_by_name(
    path: Path, changes: dict[str, Any], words: str, finished: bool
) -> None:
    (run if finished else interrupt)(path)
    before = sorted(p.name for p in path.parent.rglob("*"))
    with pytest.raises(StoreError, match=words) as error:
        start(path, **changes)
    assert "--overwrite" in str(error.value)
    assert sorted(p.name for p in path.parent.rglob("*")) == before


def test_another_kind_is_refused_by_name(path: Path) -> None:
    run(path)
    with pytest.raises(StoreError, match="kind: test there, clusters asked for"):
        begin(path, "clusters", settings={}, inputs={}, program="test 1")


def test_resuming_keeps_finished_blocks_and_ends_in_the_same_bytes(path: Path, tmp_path: Path) -> None:
    interrupt(path)
    assert not path.exists()
    assert [block["id"] for block in progress(path)["blocks"]] == ["direct/0"]
    chunk = path.with_name("store.zarr.partial") / "direct/transfer/c.0.0"
    before = chunk.stat().st_mtime_ns
    writer = start(path)
    assert writer is not None
    statuses = [writer.status]
    assert writer.done == {"direct/0"}
    with writer:
        write(writer)
        writer.commit({})
    statuses.append(writer.status)
    assert statuses == [Status.RESUMED, Status.DONE]
    run(tmp_path / "reference.zarr")
    assert array_files(path) == array_files(tmp_path / "reference.zarr")
    assert (path / "direct/transfer/c.0.0").stat().st_mtime_ns == before
    assert open_store(path).fingerprint == open_store(tmp_path / "reference.zarr").fingerprint


def test_unfinished_work_of_another_program_version_is_not_mixed_in(path: Path) -> None:
    interrupt(path)
    with pytest.raises(StoreError, match="program: test 1 there, test 2 asked for"):
        start(path, program="test 2")
    assert run(path, program="test 2", overwrite=True)


def test_an_array_made_otherwise_is_refused_when_resuming(path: Path) -> None:
    interrupt(path)
    writer = start(path)
    assert writer is not None
    with writer, pytest.raises(StoreError, match="another shape, type, chunks"):
        writer.array("direct/transfer", shape=(ROWS, 40), dtype="f8", chunks=(10, 40), dims=("V", "L"))


def test_overwriting_keeps_the_old_store_until_commit(path: Path) -> None:
    run(path)
    writer = start(path, 2.0, overwrite=True)
    assert writer is not None
    assert writer.status is Status.FRESH
    with writer:
        write(writer, 2.0)
        np.testing.assert_array_equal(open_store(path).read("direct/transfer"), values(1.0))
        writer.commit({})
    np.testing.assert_array_equal(open_store(path).read("direct/transfer"), values(2.0))
    assert sorted(p.name for p in path.parent.iterdir()) == ["store.zarr"]


def test_an_interrupted_overwrite_is_taken_up(path: Path) -> None:
    run(path)
    interrupt(path, 2.0, overwrite=True)
    assert open_store(path).settings["factor"] == 1.0
    writer = start(path, 2.0, overwrite=True)
    assert writer is not None
    assert writer.done == {"direct/0"}
    writer.close()


def test_overwriting_drops_unfinished_work_of_other_settings(path: Path) -> None:
    interrupt(path, 1.0)
    writer = start(path, 2.0, overwrite=True)
    assert writer is not None
    assert writer.status is Status.FRESH
    assert writer.done == frozenset()
    writer.close()


def test_overwriting_replaces_a_damaged_store(path: Path) -> None:
    run(path)
    root = path / "zarr.json"
    root.write_bytes(root.read_bytes().replace(b'"test 1"', b'"test 9"'))
    with pytest.raises(StoreError, match="digest"):
        start(path)
    assert run(path, overwrite=True)
    assert open_store(path).verify() == []


@pytest.mark.parametrize("overwrite", [True, False])
@pytest.mark.parametrize("suffix", ["", ".partial", ".replaced"])
def test_what_is_no_relight_store_is_never_touched(path: Path, suffix: str, overwrite: bool) -> None:
    mine = path.with_name(path.name + suffix)
    mine.mkdir()
    (mine / "thesis.txt").write_text("years of work")
    with pytest.raises(StoreError, match=r"move it|another output"):
        start(path, overwrite=overwrite)
    assert (mine / "thesis.txt").read_text() == "years of work"
    assert not path.with_name("store.zarr.lock").exists()


@pytest.mark.parametrize("overwrite", [True, False])
def test_a_plain_file_is_never_replaced(path: Path, overwrite: bool) -> None:
    path.write_text("mine")
    with pytest.raises(StoreError, match="expected a relight store or nothing"):
        start(path, overwrite=overwrite)
    assert path.read_text() == "mine"


def test_a_plain_file_in_place_of_the_unfinished_work_is_named(path: Path) -> None:
    path.with_name("store.zarr.partial").write_text("mine")
    with pytest.raises(StoreError, match="move it away"):
        start(path)


def test_unfinished_work_of_another_format_is_refused_and_can_be_dropped(path: Path) -> None:
    interrupt(path)
    partial = path.with_name("store.zarr.partial")
    header, attributes = read_root(partial)
    write_root(partial, header | {"format": 2}, attributes)
    with pytest.raises(StoreError, match="expected store format 1, found 2"):
        start(path)
    assert run(path, overwrite=True)


def test_a_second_writer_is_refused_and_the_first_goes_on(path: Path) -> None:
    writer = start(path)
    assert writer is not None
    with writer:
        with pytest.raises(StoreError, match=f"another process is writing this store .process {os.getpid()} on "):
            start(path)
        write(writer)
        writer.commit({})
    assert start(path) is None


def test_a_finished_store_can_be_asked_for_while_it_is_being_replaced(path: Path) -> None:
    run(path)
    writer = start(path, 2.0, overwrite=True)
    assert writer is not None
    with writer:
        assert start(path) is None


def test_the_lock_of_another_process_refuses_and_dies_with_it(path: Path) -> None:
    code = (
        "import sys, time; from relight_formats.lock import Lock; from pathlib import Path\n"
        "lock = Lock(Path(sys.argv[1])); print('held', flush=True); time.sleep(60)"
    )
    holder = subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(StoreError, match=f"process {holder.pid} on "):
            start(path)
    finally:
        holder.kill()
        holder.communicate()
    assert path.with_name("store.zarr.lock").exists()  # a file alone locks nothing
    assert run(path)
    assert not path.with_name("store.zarr.lock").exists()


def test_a_forked_child_does_not_keep_the_lock(tmp_path: Path) -> None:
    """A worker that outlives its killed parent must not refuse the next run."""
    code = (
        "import os, sys, time; from relight_formats.lock import Lock; from pathlib import Path\n"
        "lock = Lock(Path(sys.argv[1]))\n"
        "if os.fork() == 0:\n"
        "    print('forked', flush=True); time.sleep(60); os._exit(0)\n"
        "os.wait()"
    )
    path = tmp_path / "store.zarr"
    holder = subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "forked\n"
        holder.kill()
        holder.wait()
        Lock(path).release()
    finally:
        os.killpg(holder.pid, signal.SIGKILL)
        holder.communicate()


def test_a_lock_won_on_a_file_that_was_just_removed_does_not_count(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = Lock(path)
    really_lock = fcntl.flock

    def first_lets_go(descriptor: int, operation: int) -> None:
        monkeypatch.undo()
        first.release()  # removes the file that the second has opened already
        really_lock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", first_lets_go)
    second = Lock(path)
    with pytest.raises(StoreError, match="another process is writing"):
        Lock(path)
    second.release()


def test_a_missing_folder_is_a_system_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="the folder to write into does not exist") as error:
        start(tmp_path / "nowhere" / "store.zarr")
    assert error.value.filename == str(tmp_path / "nowhere")


def test_a_symbolic_link_to_a_store_is_followed(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    link = tmp_path / "link.zarr"
    run(tmp_path / "disk/store.zarr")
    link.symlink_to(tmp_path / "disk/store.zarr")
    assert run(link, 2.0, overwrite=True)
    assert link.is_symlink()
    assert open_store(link).settings["factor"] == 2.0
    assert [p.name for p in (tmp_path / "disk").iterdir()] == ["store.zarr"]


@pytest.mark.parametrize("settings", [{"x": float("nan")}, {"x": {1: 2}}, {"x": object()}])
def test_settings_are_plain_json(path: Path, settings: dict[str, Any]) -> None:
    with pytest.raises((ValueError, TypeError), match=r"settings\.x"):
        begin(path, "test", settings=settings, inputs={}, program="test 1")
    assert list(path.parent.iterdir()) == []


def test_numpy_scalars_and_tuples_mean_the_same_as_plain_values(path: Path) -> None:
    run(path)
    same = {"factor": np.float64(1.0), "nested": {"list": (np.int32(1), 2)}}
    assert start(path, settings=same) is None


def test_a_finished_name_without_a_commit_mark_is_refused_and_can_be_replaced(path: Path) -> None:
    interrupt(path)
    path.with_name("store.zarr.partial").rename(path)
    with pytest.raises(StoreError, match="carries no commit mark"):
        start(path)
    assert run(path, overwrite=True)
    assert open_store(path).verify() == []


def test_a_store_that_was_moved_aside_and_lost_its_successor_comes_back(path: Path) -> None:
    run(path)
    path.rename(path.with_name("store.zarr.replaced"))
    assert start(path) is None
    assert open_store(path).verify() == []
    assert [p.name for p in path.parent.iterdir()] == ["store.zarr"]


def test_a_long_list_of_differences_is_cut_short(path: Path) -> None:
    run(path)
    with pytest.raises(StoreError, match="and 17 more") as error:
        start(path, settings={f"option{i}": i for i in range(18)})
    assert len(str(error.value)) < 600
