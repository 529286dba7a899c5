"""One small job that writes a store block by block, shared by the tests of this room."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from relight_formats import Writer, begin, worker_array

ROWS, COLUMNS, PER_BLOCK = 30, 40, 10


def values(factor: float = 1.0) -> np.ndarray:
    """What the job's main array holds: (ROWS, COLUMNS) float32, the second block all zero (a chunk of fill values)."""
    result = np.arange(ROWS * COLUMNS, dtype=np.float32).reshape(ROWS, COLUMNS) * np.float32(factor)
    result[PER_BLOCK : 2 * PER_BLOCK] = 0
    return result


def start(path: Path, factor: float = 1.0, **changes: Any) -> Writer | None:
    """Begin the job's store. `factor` is its setting; `changes` go to `begin`."""
    given: dict[str, Any] = {
        "settings": {"factor": factor, "nested": {"list": [1, 2]}},
        "inputs": {"scene": "sha256:" + "0" * 64},
        "program": "test 1",
    }
    return begin(path, "test", **(given | changes))


def write(writer: Writer, factor: float = 1.0, *, blocks: int | None = None) -> None:
    """Write the first `blocks` blocks (all by default) that are not done yet, as a stage does."""
    writer.put("geometry/points", values()[:, :3], dims=("V", "xyz"), units="m")
    writer.array(
        "direct/transfer",
        shape=(ROWS, COLUMNS),
        dtype=np.float32,
        chunks=(PER_BLOCK, COLUMNS),
        dims=("V", "L"),
        units="sr",
    )
    writer.set_attrs({"scene": {"name": "test"}})
    for first in range(0, ROWS, PER_BLOCK)[:blocks]:
        block = f"direct/{first}"
        if block in writer.done:
            continue
        array = worker_array(writer.partial_path, "direct/transfer")
        array[first : first + PER_BLOCK] = values(factor)[first : first + PER_BLOCK]
        writer.record(block, {"seconds": 0.5, "error": 1e-05})


def run(path: Path, factor: float = 1.0, **changes: Any) -> bool:
    """The whole job, as a command would do it. False when there was nothing to do."""
    writer = start(path, factor, **changes)
    if writer is None:
        return False
    with writer:
        write(writer, factor)
        writer.commit({"seconds": 1.0, "error": 1e-05})
    return True


def array_files(path: Path) -> dict[str, str]:
    """SHA-256 of every file that must not depend on time, workers or interruptions: all but root and ledger."""
    return {
        str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(path.rglob("*"))
        if file.is_file() and file.relative_to(path).parts[0] not in ("zarr.json", "ledger")
    }
