"""From `NAME.partial` to `NAME`, and putting right what a crash left half-way.

The steps of replacing a store: NAME -> NAME.replaced, NAME.partial -> NAME, delete NAME.replaced. At every point a
complete store exists under one of the names, and `tidy` finishes the job.
"""

import contextlib
import os
from pathlib import Path
from typing import Any

from relight_formats.errors import StoreError
from relight_formats.files import REPLACED, fsync_folder, local_path, remove_store, sibling
from relight_formats.header import is_store, read_root
from relight_formats.ledger import DOCUMENTS, FILE_NAME
from relight_formats.lock import Busy, Lock
from relight_formats.store import need_whole


def publish(path: Path, partial: Path) -> None:
    """Give a sealed store its final name, replacing the one that may be there."""
    _drop_notes(partial)
    replaced = sibling(path, REPLACED)
    if path.exists():
        if not is_store(path):
            raise StoreError(f"{path}: expected a relight store or nothing, found something else; move it away.")
        os.rename(path, replaced)
    os.rename(partial, path)
    fsync_folder(path.parent)
    if replaced.exists():
        _need_ours(replaced)
        remove_store(replaced)


def discard(path: Path, folder: Path) -> None:
    """Delete unfinished work on `path`, or the store at `path` itself. One rename first: half of a deleted store is
    never taken for a whole one. Needs the writer's lock."""
    replaced = sibling(path, REPLACED)
    os.rename(folder, replaced)
    remove_store(replaced)


def drop(path: Path) -> None:
    """Delete the finished store at `path`, which has served. Gone already: nothing is done; nor while another writer
    has its lock: what is there is then that writer's to delete.

    Raises:
        StoreError: `NAME.replaced` is in the way and is no relight store.
    """
    path = local_path(path)
    if not path.exists():
        return
    try:
        lock = Lock(path)
    except Busy:
        return
    try:
        replaced = sibling(path, REPLACED)
        if replaced.exists():  # a crash came in the midst of this
            _need_ours(replaced)
            remove_store(replaced)
        if path.exists():
            discard(path, path)
    finally:
        lock.release()


def tidy(path: Path, partial: Path) -> bool:
    """Finish what a crash interrupted; whether a sealed store took its final name by that. Needs the writer's lock.

    Raises:
        StoreError: `NAME.replaced` is in the way and is no relight store; a sealed store was damaged since.
    """
    replaced = sibling(path, REPLACED)
    if replaced.exists():
        _need_ours(replaced)
        if path.exists() or sealed(partial) or not _whole(replaced):
            remove_store(replaced)
        else:
            os.rename(replaced, path)
    if not sealed(partial):
        return False
    _drop_notes(partial)
    need_whole(partial)
    publish(path, partial)
    return True


def sealed(folder: Path) -> bool:
    """Whether a whole store with its commit mark is there."""
    try:
        header: dict[str, Any] = read_root(folder)[0]
    except StoreError:
        return False
    return header["complete"] is True


def _whole(folder: Path) -> bool:
    """Whether a store is all there: a crash may have come while it was being deleted."""
    try:
        need_whole(folder)
    except StoreError:
        return False
    return sealed(folder)


def _drop_notes(partial: Path) -> None:
    """A sealed store holds in itself what they say."""
    for name in (FILE_NAME, DOCUMENTS):
        with contextlib.suppress(FileNotFoundError):
            os.unlink(partial / name)


def _need_ours(folder: Path) -> None:
    """Raises StoreError unless `NAME.replaced` is a store, or what is left of one."""
    # Empty: a crash came between deleting the root metadata, the last file, and deleting the folder.
    emptied = folder.is_dir() and not any(folder.iterdir())
    if not is_store(folder) and not emptied:
        raise StoreError(f"{folder}: expected a relight store or nothing, found something else; move it away.")
