"""The ledger of a store being written: one line per finished block, appended, each with its own checksum.

A line is eight hexadecimal digits (CRC-32 of the rest), a space, and a JSON object with at least `id`. A line that does
not check was torn by a crash: its block counts as not done.
"""

import json
import os
import zlib
from pathlib import Path
from typing import Any

from relight_formats.files import write_durably
from relight_formats.fingerprint import canonical_json

FILE_NAME = "ledger.jsonl"
"""The finished blocks."""

DOCUMENTS = "documents.jsonl"
"""The fingerprints of the arrays' metadata, in the same form: `id` is the array's name."""


def _encode(block: dict[str, Any]) -> bytes:
    text = canonical_json(block).encode("ascii")
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _decode(line: bytes) -> dict[str, Any] | None:
    checksum, _, text = line.partition(b" ")
    if checksum != b"%08x" % zlib.crc32(text):
        return None
    try:
        block = json.loads(text)
    except ValueError:
        return None
    return block if isinstance(block, dict) and isinstance(block.get("id"), str) else None


def read_ledger(path: Path) -> tuple[list[dict[str, Any]], bool]:
    """Blocks of a ledger file in order of completion, and whether every byte of it was sound. No file: no blocks."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return [], True
    *lines, rest = content.split(b"\n")
    blocks: dict[str, dict[str, Any]] = {}
    sound = not rest  # text after the last line feed is a torn line
    for line in lines:
        block = _decode(line)
        if block is None:
            sound = False
        else:
            blocks.setdefault(block["id"], block)
    return list(blocks.values()), sound


class LedgerFile:
    """An open ledger. `blocks` is what it holds, `ids` by name; `append` adds to all, durably."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.blocks, sound = read_ledger(path)
        if not sound:  # appending after a torn line would tear the next one too
            write_durably(path, b"".join(map(_encode, self.blocks)))
        self.ids = dict.fromkeys(block["id"] for block in self.blocks)
        self._descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o666)

    def append(self, block: dict[str, Any]) -> None:
        """Write one line and wait until it is on disk. Raises OSError; a line half written is taken back."""
        line = _encode(block)
        size = os.fstat(self._descriptor).st_size
        try:
            if os.write(self._descriptor, line) != len(line):
                raise OSError(28, "No space left on device", str(self.path))
            os.fsync(self._descriptor)
        except OSError as error:
            error.filename = str(self.path)
            os.ftruncate(self._descriptor, size)
            raise
        self.blocks.append(block)
        self.ids[block["id"]] = None

    def close(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
