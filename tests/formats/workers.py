"""What a worker process does for `test_workers`; a module of its own, so that a spawned process imports little."""

from __future__ import annotations

from pathlib import Path

from relight_formats import worker_array
from tests.formats.jobs import PER_BLOCK, values


def write_block(partial: Path, first: int) -> int:
    """Write one block of the job's array and report it."""
    worker_array(partial, "direct/transfer")[first : first + PER_BLOCK] = values()[first : first + PER_BLOCK]
    return first
