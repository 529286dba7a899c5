"""The append-only ledger: torn lines are forgotten, sound ones never."""

from pathlib import Path
from typing import Any

import pytest

from relight_formats.ledger import LedgerFile, read_ledger

BLOCKS: list[dict[str, Any]] = [{"id": "first", "seconds": 1.5}, {"id": "second", "note": "ä\n"}, {"id": "third"}]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    ledger = LedgerFile(tmp_path / "ledger.jsonl")
    for block in BLOCKS:
        ledger.append(block)
    ledger.close()
    return ledger.path


def test_round_trip(file: Path) -> None:
    assert read_ledger(file) == (BLOCKS, True)


def test_cut_at_any_byte_keeps_the_whole_lines_and_goes_on(file: Path, tmp_path: Path) -> None:
    content = file.read_bytes()
    for length in range(len(content) + 1):
        torn = tmp_path / "torn"
        torn.write_bytes(content[:length])
        ledger = LedgerFile(torn)
        assert ledger.blocks == BLOCKS[: content[:length].count(b"\n")]
        ledger.append({"id": "next"})
        ledger.close()
        assert read_ledger(torn) == ([*BLOCKS[: content[:length].count(b"\n")], {"id": "next"}], True)


def test_any_flipped_bit_loses_no_more_than_two_lines_and_invents_nothing(file: Path) -> None:
    content = file.read_bytes()
    for position in range(len(content)):
        for bit in range(8):
            damaged = bytearray(content)
            damaged[position] ^= 1 << bit
            file.write_bytes(damaged)
            blocks, sound = read_ledger(file)
            assert not sound
            assert len(blocks) >= len(BLOCKS) - 2  # a flipped line feed joins two lines
            assert all(block in BLOCKS for block in blocks)


def test_no_file_is_an_empty_ledger(tmp_path: Path) -> None:
    assert read_ledger(tmp_path / "nothing") == ([], True)
