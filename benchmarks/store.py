"""Writing and reading the visibility bits through the store, against raw files.

Both sides are made durable (fsync) when written; both are read while the system still has the file in memory.
"""

from __future__ import annotations

import os
import shutil
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Report, Row
from benchmarks.scenes import Setting, main_store, write_scene

BLOCK = 1024  # receivers in a chunk at R = 64
REPEATS = 3


def write_store(path: Path, bits: NDArray[np.uint8]) -> None:
    """The bits as `precompute` lays them out, in one process, committed."""
    import relight_formats as formats

    writer = formats.begin(path, "transfer", settings={}, inputs={}, program="benchmarks")
    assert writer is not None
    with writer:
        array = writer.array(
            "visibility/bits",
            shape=bits.shape,
            dtype=np.uint8,
            chunks=(BLOCK, *bits.shape[1:]),
            dims=("receiver", "cube_face", "texel_row", "texel_column_byte"),
            codec="zstd",
        )
        for start in range(0, len(bits), BLOCK):
            array[start : start + BLOCK] = bits[start : start + BLOCK]
        writer.commit({})


def write_raw(path: Path, bits: NDArray[np.uint8]) -> None:
    with path.open("wb") as file:
        bits.tofile(file)
        os.fsync(file.fileno())


def measure(setting: Setting) -> Report:
    import relight_formats as formats

    _, subject = write_scene(setting)
    bits: Any = formats.open_store(main_store(setting)).read("visibility/bits")
    store, raw = setting.work / "bits.zarr", setting.work / "bits.raw"
    clocks: dict[str, list[float]] = {"write": [], "read": [], "raw write": [], "raw read": []}
    for _ in range(REPEATS):
        shutil.rmtree(store, ignore_errors=True)
        raw.unlink(missing_ok=True)
        for name, action in (
            ("write", lambda: write_store(store, bits)),
            ("raw write", lambda: write_raw(raw, bits)),
            ("read", lambda: formats.open_store(store).read("visibility/bits")),
            ("raw read", lambda: np.fromfile(raw, np.uint8)),
        ):
            clock = time.perf_counter()
            action()
            clocks[name].append(time.perf_counter() - clock)
    speed = {name: bits.nbytes / 1e6 / statistics.median(seconds) for name, seconds in clocks.items()}
    stored = formats.open_store(store).sizes()["visibility/bits"].stored
    report = Report(f"visibility bits of {subject}, {bits.nbytes / 1e6:.0f} MB raw; speeds in raw bytes, one process")
    for name in ("write", "read"):
        peer = speed[f"raw {name}"]
        report.rows.append(Row(name, speed[name], "MB/s", f"raw file: {peer:,.0f} MB/s", speed[name] / peer))
    size = f"raw bits: {bits.nbytes / len(bits):,.0f} bytes"
    report.rows.append(Row("stored", stored / len(bits), "bytes a receiver", size, bits.nbytes / stored))
    return report
