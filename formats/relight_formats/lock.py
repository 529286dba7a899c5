"""One writer per store: an advisory lock on the file `NAME.lock` beside it.

The operating system releases the lock when its holder ends, however it ends; a lock file alone locks nothing.
"""

import contextlib
import errno
import fcntl
import os
import socket
import weakref
from pathlib import Path

from relight_formats.errors import StoreError
from relight_formats.files import LOCK, sibling

_held: "weakref.WeakSet[Lock]" = weakref.WeakSet()


class Busy(StoreError):
    """Another writer has the lock."""


class Lock:
    """Held from construction until `release`.

    Raises:
        Busy: another process (or another writer of this one) holds it.
        OSError: the folder does not exist or cannot be written.
    """

    def __init__(self, store: Path) -> None:
        self.path = sibling(store, LOCK)
        if not store.parent.is_dir():
            raise FileNotFoundError(errno.ENOENT, "the folder to write into does not exist", str(store.parent))
        self._descriptor: int | None = None
        while self._descriptor is None:
            self._descriptor = self._try(store)
        _held.add(self)

    def _try(self, store: Path) -> int | None:
        descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                holder = os.pread(descriptor, 200, 0).decode("utf-8", "replace").strip() or "unknown"
                raise Busy(
                    f"{store}: another process is writing this store ({holder}). Wait for it to end, or stop it; "
                    f"the lock goes with the process."
                ) from None
            if not self._still_named(descriptor):  # the last holder removed the file between our open and our lock
                os.close(descriptor)
                return None
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
        except BaseException:
            with contextlib.suppress(OSError):
                os.close(descriptor)
            raise
        return descriptor

    def _still_named(self, descriptor: int) -> bool:
        try:
            return os.path.samestat(os.fstat(descriptor), os.stat(self.path))
        except FileNotFoundError:
            return False

    @property
    def released(self) -> bool:
        return self._descriptor is None

    def release(self) -> None:
        """Remove the lock file and let go. Harmless when repeated."""
        if self._descriptor is None:
            return
        with contextlib.suppress(FileNotFoundError):
            os.unlink(self.path)
        self._close()

    def _close(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _close_inherited() -> None:
    # A forked worker shares the lock with its parent; one that outlives a killed parent would hold it for ever.
    for lock in list(_held):
        lock._close()


os.register_at_fork(after_in_child=_close_inherited)
