"""Any sequence of begin, write, leave, commit and overwrite, against a model of what must be there."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from relight_formats import Status, StoreError, Writer, open_store
from relight_formats.files import REPLACED, sibling
from relight_formats.lock import Lock
from relight_formats.publish import drop
from tests.formats.jobs import PER_BLOCK, start, values, write


class Lifecycle(RuleBasedStateMachine):
    """The model: factor of the finished store, factor and finished blocks of the unfinished one, the open writer."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        self.path = self.folder / "store.zarr"
        self.finished: float | None = None
        self.unfinished: tuple[float, int] | None = None
        self.writer: Writer | None = None

    def teardown(self) -> None:
        if self.writer is not None:
            self.writer.close()
        shutil.rmtree(self.folder)

    def expected(self, factor: float, overwrite: bool) -> Status | int | None:
        """What `begin` must do: refuse (None), find it done, start afresh, or resume after so many blocks."""
        if self.finished is not None and not overwrite:
            return Status.DONE if self.finished == factor else None
        if self.writer is not None:
            return None
        if self.unfinished is None:
            return Status.FRESH
        if self.unfinished[0] == factor:
            return self.unfinished[1]
        return Status.FRESH if overwrite else None

    @rule(factor=st.sampled_from([1.0, 2.0]), overwrite=st.booleans())
    def begin(self, factor: float, overwrite: bool) -> None:
        expected = self.expected(factor, overwrite)
        if expected is None:
            with pytest.raises(StoreError):
                start(self.path, factor, overwrite=overwrite)
            return
        writer = start(self.path, factor, overwrite=overwrite)
        if expected is Status.DONE:
            assert writer is None
            if self.writer is None and self.unfinished is not None and self.unfinished[0] == factor:
                self.unfinished = None  # work on another store like the one that is there
            return
        assert writer is not None
        blocks = expected if isinstance(expected, int) else 0
        assert writer.status is (Status.RESUMED if isinstance(expected, int) else Status.FRESH)
        assert writer.done == {f"direct/{PER_BLOCK * block}" for block in range(blocks)}
        self.writer, self.unfinished = writer, (factor, blocks)

    @precondition(lambda self: self.writer is not None)
    @rule(blocks=st.integers(1, 3))
    def work(self, blocks: int) -> None:
        assert self.writer is not None
        assert self.unfinished is not None
        factor, done = self.unfinished
        write(self.writer, factor, blocks=blocks)
        self.unfinished = factor, max(done, blocks)

    @precondition(lambda self: self.writer is not None)
    @rule()
    def leave(self) -> None:
        assert self.writer is not None
        self.writer.close()
        self.writer = None

    @precondition(lambda self: self.writer is not None)
    @rule()
    def finish(self) -> None:
        assert self.writer is not None
        assert self.unfinished is not None
        write(self.writer, self.unfinished[0])
        self.writer.commit({})
        self.finished, self.unfinished, self.writer = self.unfinished[0], None, None

    @invariant()
    def the_final_name_holds_a_whole_store_or_nothing(self) -> None:
        if self.finished is None:
            assert not self.path.exists()
        else:
            np.testing.assert_array_equal(open_store(self.path).read("direct/transfer"), values(self.finished))

    @invariant()
    def nothing_lies_about(self) -> None:
        expected = {"store.zarr"} if self.finished is not None else set()
        expected |= {"store.zarr.partial"} if self.unfinished is not None else set()
        expected |= {"store.zarr.lock"} if self.writer is not None else set()
        assert {entry.name for entry in self.folder.iterdir()} == expected


TestLifecycle = Lifecycle.TestCase
# Each step writes and syncs files; 25 sequences of 12 steps take a few seconds and reach every pair of rules.
TestLifecycle.settings = settings(max_examples=25, stateful_step_count=12, deadline=None)


def finished(path):
    with start(path) as writer:
        write(writer)
        writer.commit({})


def test_dropped_store_leaves_nothing(tmp_path):
    path = tmp_path / "store.zarr"
    finished(path)
    shutil.copytree(path, sibling(path, REPLACED))  # as a crash in the midst of it leaves
    drop(path)
    assert not list(tmp_path.iterdir())
    drop(path)  # gone already, as when two programs had the same use for it


def test_dropped_store_is_left_to_a_writer_at_work(tmp_path):
    path = tmp_path / "store.zarr"
    finished(path)
    with start(path, 2.0, overwrite=True) as writer:
        drop(path)
        assert open_store(path).settings["factor"] == 1.0
        write(writer, 2.0)
        writer.commit({})
    assert open_store(path).settings["factor"] == 2.0


def test_what_another_writer_takes_between_two_looks_is_its_own(tmp_path, monkeypatch):
    """The store goes after it was seen and before the lock is held."""
    path = tmp_path / "store.zarr"
    finished(path)

    class Late(Lock):
        def __init__(self, store):
            shutil.rmtree(store)
            super().__init__(store)

    monkeypatch.setattr("relight_formats.publish.Lock", Late)
    drop(path)
    assert not list(tmp_path.iterdir())
