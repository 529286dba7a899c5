"""Several processes write blocks of one store: the bytes are those of one process."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from relight_formats import open_store
from tests.formats.jobs import PER_BLOCK, ROWS, array_files, run, start, write
from tests.formats.workers import write_block


def test_two_processes_write_what_one_writes(tmp_path: Path) -> None:
    path = tmp_path / "store.zarr"
    writer = start(path)
    assert writer is not None
    with writer:
        write(writer, blocks=0)  # makes the arrays, no block
        # Spawned, because pytest's process has threads; a forked one would work the same way.
        with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
            blocks = [pool.submit(write_block, writer.partial_path, first) for first in range(0, ROWS, PER_BLOCK)]
            for block in as_completed(blocks):
                writer.record(f"direct/{block.result()}", {})
        writer.commit({})
    run(tmp_path / "one.zarr")
    assert array_files(path) == array_files(tmp_path / "one.zarr")
    assert open_store(path).fingerprint == open_store(tmp_path / "one.zarr").fingerprint
    assert open_store(path).verify() == []
