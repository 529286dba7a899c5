"""Receivers of a store for the benchmarks that trace by themselves, and samples of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

BLOCK = 1024  # receivers handed to a process at once
RUN = 64  # neighbours in a sample: rays' coherence and refinement are shared among them, as in the real work


@dataclass(frozen=True)
class Traceable:
    """A mesh (V, 3), (F, 3) and points with normals (N, 3) on it."""

    mesh: NDArray[np.float64]
    faces: NDArray[np.int32]
    position: NDArray[np.float64]
    normal: NDArray[np.float32]

    def tracer(self) -> Any:
        from relightcli.adapters.rays import Tracer

        return Tracer(self.mesh, self.faces)

    def at(self, rows: NDArray[np.intp]) -> Traceable:
        return Traceable(self.mesh, self.faces, self.position[rows], self.normal[rows])


def read_traceable(store: Path) -> Traceable:
    import relight_formats as formats

    opened = formats.open_store(store)
    read: Any = opened.read
    return Traceable(
        read("mesh/position"),
        read("mesh/face"),
        read("receivers/position"),
        read("receivers/normal").astype(np.float32),
    )


def sample(count: int, wanted: int) -> NDArray[np.intp]:
    """About `wanted` of `count` receivers: runs of neighbours, evenly spread."""
    runs = max(1, wanted // RUN)
    if runs * RUN >= count:
        return np.arange(count)
    starts = np.linspace(0, count - RUN, runs).astype(np.intp)
    return np.unique((starts[:, None] + np.arange(RUN)).reshape(-1))


def share(count: int, rank: int, processes: int, block: int = BLOCK) -> list[slice]:
    """The blocks of one process out of many."""
    return [slice(a, min(a + block, count)) for a in range(0, count, block)][rank::processes]
