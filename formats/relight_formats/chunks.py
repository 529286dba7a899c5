"""Zarr over a store's folder: every chunk written is durable, every chunk read has passed its checksum."""

import asyncio
import math
from collections.abc import AsyncIterator, Iterable
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import zarr
from zarr.abc.store import ByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype, default_buffer_prototype
from zarr.storage import LocalStore

from relight_formats.errors import AGAIN, StoreError
from relight_formats.files import write_durably
from relight_formats.remote import Place, RemotePath


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


class _Packed:
    packing: str | None = None
    """How the chunks of the one array that is read are packed, and"""
    chunk_bytes = 0
    """what each of them unpacks to. Checked before a library allocates what a chunk asks for."""


class CommittedFolder(_Packed, LocalStore):
    """For reading a finished store: a chunk that is missing or does not match its checksum raises StoreError."""

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
        return (prototype or default_buffer_prototype()).buffer.from_bytes(_checked_chunk(self.root, key, self))


class CommittedRemote(_Packed, Store):
    """As `CommittedFolder`, at a URL."""

    supports_writes = False
    supports_deletes = False
    supports_listing = False

    def __init__(self, root: RemotePath) -> None:
        super().__init__(read_only=True)
        self.root = root

    def __eq__(self, other: object) -> bool:
        return isinstance(other, CommittedRemote) and other.root == self.root

    async def get(
        self, key: str, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        assert byte_range is None, "everything is read whole"
        if is_chunk(key):
            data = await asyncio.to_thread(_checked_chunk, self.root, key, self)
        else:
            try:
                data = await asyncio.to_thread((self.root / key).read_bytes)
            except FileNotFoundError:
                return None
        return (prototype or default_buffer_prototype()).buffer.from_bytes(data)

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]

    async def exists(self, key: str) -> bool:
        return await asyncio.to_thread((self.root / key).exists)

    async def set(self, key: str, value: Buffer) -> None:
        self._check_writable()

    async def delete(self, key: str) -> None:
        self._check_writable()

    def list(self) -> AsyncIterator[str]:
        raise NotImplementedError

    def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        raise NotImplementedError

    def list_dir(self, prefix: str) -> AsyncIterator[str]:
        raise NotImplementedError


def _checked_chunk(root: Place, key: str, expected: _Packed) -> bytes:
    """The bytes of a chunk file. Raises StoreError where it is missing, does not match its checksum, or would unpack to
    another size."""
    path = root / key
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        problem: str | None = "is missing"
    else:
        problem = chunk_problem(data)
        if problem is None and expected.packing is not None:
            unpacked = unpacked_bytes(data, expected.packing)
            if unpacked != expected.chunk_bytes:
                problem = f"unpacks to {unpacked} bytes where {expected.chunk_bytes} are expected"
    if problem:
        array = key.rpartition("/")[0]
        raise StoreError(f"{root}: array {array}: chunk file {path} {problem}; the store is damaged. {AGAIN}")
    return data


def open_written(folder: Path, name: str) -> zarr.Array[Any]:
    """An array of a store being written, for reading and writing. Chunks of fill values are written too, so that a
    missing chunk file always means a chunk that was never written."""
    array: zarr.Array[Any] = zarr.open_array(WrittenFolder(folder), path=name, mode="r+", zarr_format=3)
    return array.with_config({"write_empty_chunks": True})  # `open_array` ignores this setting


def open_committed(folder: Place, name: str) -> zarr.Array[Any]:
    """An array of a finished store, for reading."""
    source = CommittedFolder(folder) if isinstance(folder, Path) else CommittedRemote(folder)
    array: zarr.Array[Any] = zarr.open_array(source, path=name, mode="r", zarr_format=3)
    codecs: Any = array.metadata.to_dict()["codecs"]
    packing = [codec["name"] for codec in codecs][1:-1]
    source.packing = packing[0] if packing else None
    source.chunk_bytes = math.prod(array.chunks) * array.dtype.itemsize
    return array
