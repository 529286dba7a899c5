"""Stores at a URL, for reading: any file system that fsspec knows, with what of pathlib reading needs.

fsspec and what it needs for a protocol (s3fs, gcsfs, ...) load when the first URL is opened.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from relight_formats.errors import StoreError
from relight_formats.files import local_path


@dataclass(frozen=True)
class RemotePath:
    """A file or folder of an fsspec file system. Documents that were fetched together are kept: they do not change."""

    fs: Any
    path: str
    fetched: dict[str, bytes] = field(default_factory=dict, compare=False, repr=False)

    def __str__(self) -> str:
        return str(self.fs.unstrip_protocol(self.path))

    @property
    def name(self) -> str:
        return self.path.rstrip("/").rpartition("/")[2]

    @property
    def parent(self) -> RemotePath:
        return RemotePath(self.fs, self.path.rstrip("/").rpartition("/")[0], self.fetched)

    def __truediv__(self, name: str) -> RemotePath:
        return RemotePath(self.fs, f"{self.path.rstrip('/')}/{name}", self.fetched)

    def with_name(self, name: str) -> RemotePath:
        return self.parent / name

    def exists(self) -> bool:
        return bool(self.fs.exists(self.path))

    def is_dir(self) -> bool:
        return bool(self.fs.isdir(self.path))

    def read_bytes(self) -> bytes:
        """The whole file. Raises OSError."""
        data = self.fetched.get(self.path)
        return bytes(self.fs.cat_file(self.path)) if data is None else data

    def head(self, count: int) -> bytes:
        """At most that many bytes from the start of a file. Raises OSError."""
        data = self.fetched.get(self.path)
        return bytes(self.fs.cat_file(self.path, start=0, end=count)) if data is None else data[:count]

    def fetch(self, names: list[str]) -> None:
        """Reads files below this folder, at the same time where the file system can; those that are missing later."""
        paths = {self.fs._strip_protocol(str(self / name)): (self / name).path for name in names}
        found = self.fs.cat(list(paths), on_error="omit") if paths else {}
        for path, data in found.items():
            self.fetched[paths[path]] = data

    def size_and_end(self, count: int) -> tuple[int, bytes]:
        """Size of a file, and its last bytes. Raises FileNotFoundError."""
        size = int(self.fs.info(self.path)["size"])
        return size, self.fs.cat_file(self.path, start=max(0, size - count), end=size)

    def files(self) -> set[str]:
        """Paths of all files below this folder, relative to it."""
        top = self.path.rstrip("/") + "/"
        return {found.removeprefix(top) for found in self.fs.find(self.path)}


Place = Path | RemotePath


def place(path: str | os.PathLike[str]) -> Place:
    """Where a store to be read is: a folder (a path, or a URL of the scheme `file`), or a place at another URL.

    Raises:
        StoreError: fsspec is not installed, or does not know the scheme, or lacks a package for it.
    """
    text = os.fspath(path)
    if "://" not in text:
        return local_path(text)
    if text.startswith("file://"):
        return local_path(unquote(urlsplit(text).path))
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        raise StoreError(
            f"{text}: stores at a URL need fsspec, which is not installed: pip install 'relightcli[cluster]'"
        ) from None
    try:
        fs, inside = url_to_fs(text.rstrip("/"))
    except (ImportError, ValueError) as error:
        raise StoreError(f"{text}: expected a path, or a URL that fsspec can open; {error}") from None
    return RemotePath(fs, inside)
