"""Files that are either not there or complete: a temporary file beside, fsync, one rename."""

from __future__ import annotations

import contextlib
import os
import stat
from pathlib import Path

from relightcli.errors import InputError


def need_output(path: str | Path) -> None:
    """Refuse an output that cannot be made, before work goes into it. Raises InputError."""
    if "://" in str(path):
        raise InputError(f"--output {path}: expected a path; what is finished can be copied to a URL, and read there")
    target = Path(os.path.realpath(path))
    if not str(path) or not target.name:
        raise InputError(f"--output {str(path)!r}: expected the name of a file or store to write")
    if not target.parent.is_dir():
        found = "is a file" if target.parent.exists() else "does not exist; create it first"
        raise InputError(f"--output {path}: expected a folder to write into, but {target.parent} {found}")


def write_atomic(path: str | Path, data: bytes) -> None:
    """Put `data` at `path` in one step, so that a reader or a crash never sees half a file.

    A symbolic link keeps pointing at its target. A device or a pipe is written to directly.
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
        with open(temporary, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, target)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):  # a full disk names no file, the others the temporary one
            error.filename, error.filename2 = str(path), None
        raise
