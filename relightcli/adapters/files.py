"""Files that are either not there or complete: a temporary file beside, fsync, one rename."""

from __future__ import annotations

import contextlib
import fcntl
import glob
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from relightcli.errors import InputError


def need_output(path: str | Path, store: bool = False) -> None:
    """Refuse an output that cannot be made, before work goes into it. Raises InputError.

    store: a store is to be made, for which a URL will do.
    """
    if "://" in str(path):
        if not store:
            raise InputError(f"--output {path}: expected a path; only stores are written to a URL")
        _need_scheme(str(path))
        return
    target = Path(os.path.realpath(path))
    if not str(path) or not target.name:
        raise InputError(f"--output {str(path)!r}: expected the name of a file or store to write")
    if not target.parent.is_dir():
        found = "is a file" if target.parent.exists() else "does not exist; create it first"
        raise InputError(f"--output {path}: expected a folder to write into, but {target.parent} {found}")


def _need_scheme(url: str) -> None:
    try:
        from fsspec import get_filesystem_class
        from fsspec.utils import get_protocol
    except ImportError:
        raise InputError(
            f"--output {url}: stores at a URL need fsspec, which is not installed: pip install 'relightcli[cluster]'"
        ) from None
    try:
        get_filesystem_class(get_protocol(url))
    except (ImportError, ValueError) as error:
        raise InputError(f"--output {url}: expected a path, or a URL that fsspec can open; {error}") from None


def write_atomic(path: str | Path, data: bytes) -> None:
    """Put `data` at `path` in one step, so that a reader or a crash never sees half a file.

    A symbolic link keeps pointing at its target. A device or a pipe is written to directly. What writers of `path`
    left that were killed amid this (`.NAME.PID.partial`) is removed.
    Raises InputError if the folder is missing or `path` is a folder; OSError (disk full, no permission) as it comes.
    """
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise InputError(f"{path}: is a folder; expected the name of a file to write.")
    if not target.parent.is_dir():
        raise InputError(f"{path}: the folder {target.parent} does not exist; create it first.")
    temporary = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        if target.exists() and not stat.S_ISREG(target.stat().st_mode):
            target.write_bytes(data)
            return
        with _locked(temporary) as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
            os.replace(temporary, target)
        _sweep(target)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):  # a full disk names no file, the others the temporary one
            error.filename, error.filename2 = str(path), None
        raise


@contextlib.contextmanager
def _locked(temporary: Path) -> Iterator[BinaryIO]:
    """A new file, locked while its writer lives. A file system without locks keeps what killed writers leave."""
    while True:
        with open(temporary, "wb") as stream:
            with contextlib.suppress(OSError):
                fcntl.flock(stream.fileno(), fcntl.LOCK_EX)
            if os.fstat(stream.fileno()).st_nlink:  # else another writer swept it away before it was locked
                yield stream
                return


def _sweep(target: Path) -> None:
    """Removes temporary files of `target` that no living process has locked."""
    for left in target.parent.glob(f".{glob.escape(target.name)}.*.partial"):
        if not left.name[len(target.name) + 2 : -len(".partial")].isdigit():
            continue
        # Opened for writing, because a lock on a network file system asks for that.
        with contextlib.suppress(OSError), open(left, "r+b") as stream:
            fcntl.flock(stream.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
            left.unlink()
