"""Arrays for work in progress that may outgrow memory: large ones lie in files without a name."""

from __future__ import annotations

import mmap
import os
import tempfile
import weakref
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

LIMIT = 1 << 30  # bytes that stay in memory
PAGES = 1 << 28  # bytes of files that may be in memory at a time
_STATUS = Path("/proc/self/statm")


class Scratch:
    """Gives out arrays of zeros; those that memory has no more of `limit` bytes for lie in files in `folder` (None:
    where the system keeps temporary ones), which go with them.

    `let_go` hands their pages back to the system if they are more than `pages` bytes. The system keeps them as long as
    it has memory to spare, and on disk from then on.
    """

    def __init__(self, folder: Path | None = None, limit: int = LIMIT, pages: int = PAGES) -> None:
        self.folder, self.limit, self.pages = folder, limit, pages
        self._held = 0
        self._maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()

    def zeros(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """In memory or a file. Raises OSError where the disk has no room: later it would end the process."""
        size = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        if self._held + size > self.limit:
            return self.filed(shape, dtype)
        array = np.zeros(shape, dtype)
        self._held += size
        weakref.finalize(array, self._freed, size)
        return array

    def filed(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """`zeros`, but in a file, unless there are no values."""
        kind = np.dtype(dtype)
        size = int(np.prod(shape, dtype=np.int64)) * kind.itemsize
        if size == 0:
            return np.zeros(shape, kind)
        with tempfile.TemporaryFile(dir=self.folder) as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
            else:
                file.truncate(size)
            mapped = mmap.mmap(file.fileno(), size)
        self._maps.add(mapped)
        return np.frombuffer(mapped, kind).reshape(shape)

    def _freed(self, size: int) -> None:
        self._held -= size

    @property
    def used(self) -> bool:
        """Whether any array lies in a file."""
        return len(self._maps) > 0

    def let_go(self) -> None:
        if not self.used or not hasattr(mmap, "MADV_DONTNEED"):
            return
        if _STATUS.exists() and int(_STATUS.read_text().split()[2]) * mmap.PAGESIZE <= self.pages:
            return
        for mapped in self._maps:
            mapped.madvise(mmap.MADV_DONTNEED)
