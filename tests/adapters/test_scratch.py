"""Arrays that outgrow memory: the same values, held by files, and gone with the last use."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from relightcli.adapters.scratch import Scratch

MB = 1 << 20


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_small_arrays_stay_in_memory(tmp_path: Path) -> None:
    scratch = Scratch(tmp_path)
    array = scratch.zeros((3, 4), np.float32)
    assert not scratch.used
    assert (array == 0).all()
    scratch.let_go()


def test_memory_that_is_free_again_is_given_out_again(tmp_path: Path) -> None:
    scratch = Scratch(tmp_path, limit=3 * MB)
    first = scratch.zeros((MB,), np.int16)
    second = scratch.zeros((MB,), np.int16)
    assert scratch.used  # together they are too much
    del first, second
    assert not scratch.used
    third = scratch.zeros((MB,), np.int16)
    assert not scratch.used
    del third


def test_large_ones_keep_their_values_and_not_their_memory(tmp_path: Path) -> None:
    scratch = Scratch(tmp_path, limit=MB, pages=50 * MB)
    array = scratch.zeros((16 * MB, 8), np.float32)
    assert scratch.used
    assert list(tmp_path.iterdir()) == []
    before = resident()
    for k in range(16):
        rows = slice(k * MB, (k + 1) * MB)
        assert (array[rows] == 0).all()
        array[rows] = np.arange(k, k + 8)
        scratch.let_go()
        assert resident() - before < 150 * MB
    assert all((array[k * MB] == np.arange(k, k + 8)).all() for k in range(16))
    del array
    assert not scratch.used


def test_a_disk_without_room_is_an_error_at_once(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"No space|too large"):
        Scratch(tmp_path).zeros((1 << 58,), np.float32)
    assert list(tmp_path.iterdir()) == []
