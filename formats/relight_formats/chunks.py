"""Zarr over a store's folder: every chunk written is durable, every chunk read has passed its checksum."""

import asyncio
import math
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import zarr
from zarr.abc.store import ByteRequest
from zarr.core.buffer import Buffer, BufferPrototype, default_buffer_prototype
from zarr.storage import LocalStore

from relight_formats.errors import AGAIN, StoreError
from relight_formats.files import write_durably


def is_chunk(key: str) -> bool:
    """Whether a path inside a store names a chunk file (`c`, `c.0`, `c.3.0`)."""
    name = key.rpartition("/")[2]
    return name == "c" or name.startswith("c.")


def chunk_problem(data: bytes) -> str | None:
    """What is wrong with the bytes of a chunk file, or None: its last four bytes are the CRC-32C of the others."""
    if len(data) < 4:
        return f"is cut short to {len(data)} bytes"
    computed = google_crc32c.value(np.frombuffer(data, dtype=np.uint8, count=len(data) - 4))
    if computed != int.from_bytes(data[-4:], "little"):
        return "does not match its checksum"
    return None


def unpacked_bytes(data: bytes, packing: str) -> int | None:
    """Bytes that a packed chunk says it unpacks to, from its first bytes; None where it does not say.

    packing: `blosc` (four bytes at 4, c-blosc 1) or `zstd` (Frame_Content_Size, RFC 8878 sec. 3.1.1.1).
    """
    if packing == "blosc":
        return int.from_bytes(data[4:8], "little") if len(data) >= 16 else None
    if len(data) < 6 or data[:4] != b"\x28\xb5\x2f\xfd":
        return None
    flags = data[4]
    single = bool(flags & 0x20)
    at = 5 + (not single) + (0, 1, 2, 4)[flags & 3]  # after the window and the dictionary's number
    width = (int(single), 2, 4, 8)[flags >> 6]
    if width == 0 or len(data) < at + width:
        return None
    return int.from_bytes(data[at : at + width], "little") + (256 if width == 2 else 0)


class WrittenFolder(LocalStore):
    """For writing: a chunk's content is on disk when the assignment that wrote it returns (its name after the next
    `Writer.record`), and a crash leaves no half chunk under a chunk's name."""

    async def _set(self, key: str, value: Buffer, exclusive: bool = False) -> None:
        self._check_writable()
        await asyncio.to_thread(self.set_sync, key, value)

    def set_sync(self, key: str, value: Buffer) -> None:
        write_durably(self.root / key, value.as_buffer_like(), sync_folder=False)


class CommittedFolder(LocalStore):
    """For reading a finished store: a chunk that is missing or does not match its checksum raises StoreError."""

    packing: str | None = None
    """How the chunks of the one array that is read are packed, and"""
    chunk_bytes = 0
    """what each of them unpacks to. Checked before a library allocates what a chunk asks for."""

    def __init__(self, root: Path | str, *, read_only: bool = True) -> None:
        super().__init__(root, read_only=True)

    async def get(
        self, key: str, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        return await asyncio.to_thread(self.get_sync, key, prototype=prototype, byte_range=byte_range)

    def get_sync(
        self, key: str, *, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        if not is_chunk(key):
            return super().get_sync(key, prototype=prototype, byte_range=byte_range)
        assert byte_range is None, "chunks are read whole"
        path = self.root / key
        array = key.rpartition("/")[0]
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            problem: str | None = "is missing"
        else:
            problem = chunk_problem(data)
            if problem is None and self.packing is not None:
                unpacked = unpacked_bytes(data, self.packing)
                if unpacked != self.chunk_bytes:
                    problem = f"unpacks to {unpacked} bytes where {self.chunk_bytes} are expected"
        if problem:
            raise StoreError(f"{self.root}: array {array}: chunk file {path} {problem}; the store is damaged. {AGAIN}")
        return (prototype or default_buffer_prototype()).buffer.from_bytes(data)


def open_written(folder: Path, name: str) -> zarr.Array[Any]:
    """An array of a store being written, for reading and writing. Chunks of fill values are written too, so that a
    missing chunk file always means a chunk that was never written."""
    array: zarr.Array[Any] = zarr.open_array(WrittenFolder(folder), path=name, mode="r+", zarr_format=3)
    return array.with_config({"write_empty_chunks": True})  # `open_array` ignores this setting


def open_committed(folder: Path, name: str) -> zarr.Array[Any]:
    """An array of a finished store, for reading."""
    store = CommittedFolder(folder)
    array: zarr.Array[Any] = zarr.open_array(store, path=name, mode="r", zarr_format=3)
    codecs: Any = array.metadata.to_dict()["codecs"]
    packing = [codec["name"] for codec in codecs][1:-1]
    store.packing = packing[0] if packing else None
    store.chunk_bytes = math.prod(array.chunks) * array.dtype.itemsize
    return array
