"""Local files: atomic durable writes, syncing of folders, walks that follow no link, removal in a safe order.

Everything that touches the file system's namespace is here (and in `lock`), so that another kind of storage would
replace these two modules and leave the rest alone.
"""

import contextlib
import errno
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

from relight_formats.errors import StoreError

UNFINISHED = ".partial"
"""Suffix of work in progress: the store being written, and any file being written inside it."""

REPLACED = ".replaced"
"""Suffix of a store that was swapped out and is being deleted."""

LOCK = ".lock"
"""Suffix of the file that a writer holds locked."""


def local_path(path: str | os.PathLike[str]) -> Path:
    """The real, absolute path of a store. Raises StoreError for a URL."""
    text = os.fspath(path)
    if "://" in text:
        raise StoreError(
            f"{text}: expected a path, found a URL; work goes into folders, and only finished stores to URLs."
        )
    return Path(os.path.realpath(text))


def sibling(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)


def write_durably(path: Path, data: bytes | bytearray | memoryview, *, sync_folder: bool = True) -> None:
    """Replace a file's content so that a crash leaves the old content or the new, on disk when this returns.

    With `sync_folder=False` the content is on disk, and its name only after `sync_folder(path.parent)`.
    """
    temporary = path.with_name(f"{path.name}.{uuid.uuid4().hex}{UNFINISHED}")
    try:
        with open(temporary, "xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:  # as a full disk gives it
            error.filename = str(path)
        raise
    if sync_folder:
        fsync_folder(path.parent)


def fsync_folder(path: Path) -> None:
    """Make the names inside a folder durable."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some network and overlay file systems cannot sync a folder; they give no stronger promise by other means.
        if error.errno not in (errno.EINVAL, errno.EBADF, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


def walk(root: Path) -> Iterator[tuple[str, os.DirEntry[str]]]:
    """Every entry below `root` with its path relative to it ("/" between), in sorted order; follows no link."""
    pending = [("", root)]
    while pending:
        prefix, folder = pending.pop()
        with os.scandir(folder) as entries:
            ordered = sorted(entries, key=lambda entry: entry.name)
        for entry in ordered:
            yield prefix + entry.name, entry
            if entry.is_dir(follow_symlinks=False):
                pending.append((f"{prefix}{entry.name}/", Path(entry.path)))


def sweep_unfinished(root: Path) -> None:
    """Delete what killed writers left: files inside a store whose names end in `.partial`. Needs the writer's lock."""
    for relative, entry in walk(root):
        if relative.endswith(UNFINISHED) and entry.is_file(follow_symlinks=False):
            os.unlink(entry.path)


def tree_bytes(root: Path) -> int:
    """Sum of the sizes of all files below `root`, in bytes; a file that a writer renames meanwhile counts as 0."""
    total = 0
    for _, entry in walk(root):
        with contextlib.suppress(FileNotFoundError):
            if entry.is_file(follow_symlinks=False):
                total += entry.stat(follow_symlinks=False).st_size
    return total


def remove_store(root: Path) -> None:
    """Delete a store, its root metadata last: what a crash leaves behind is still known for a store."""
    for name in os.listdir(root):
        inner = root / name
        if name == "zarr.json":
            continue
        if inner.is_dir() and not inner.is_symlink():
            shutil.rmtree(inner)
        else:
            inner.unlink()
    shutil.rmtree(root)
