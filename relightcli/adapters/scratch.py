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

LIMIT = 1 << 28  # bytes of an array that stays in memory


class Scratch:
    """Gives out arrays of zeros; those of more than `limit` bytes lie in files in `folder` (None: where the system
    keeps temporary ones), which go with them.

    `let_go` hands their pages back to the system, which keeps them as long as it has memory to spare, and on disk from
    then on: what a process holds is what it has touched since the last call.
    """

    def __init__(self, folder: Path | None = None, limit: int = LIMIT) -> None:
        self.folder, self.limit = folder, limit
        self._maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()

    def zeros(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Raises OSError where the disk has no room: later it would end the process."""
        kind = np.dtype(dtype)
        size = int(np.prod(shape, dtype=np.int64)) * kind.itemsize
        if size <= self.limit:
            return np.zeros(shape, kind)
        with tempfile.TemporaryFile(dir=self.folder) as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
            else:
                file.truncate(size)
            mapped = mmap.mmap(file.fileno(), size)
        self._maps.add(mapped)
        return np.frombuffer(mapped, kind).reshape(shape)

    @property
    def used(self) -> bool:
        """Whether any array lies in a file."""
        return len(self._maps) > 0

    def let_go(self) -> None:
        for mapped in self._maps:
            if hasattr(mmap, "MADV_DONTNEED"):
                mapped.madvise(mmap.MADV_DONTNEED)
