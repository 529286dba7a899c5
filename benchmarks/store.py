"""Writing and reading the visibility bits through the store, against raw files; and what other codecs would give.

Both sides are made durable (fsync) when written; both are read while the system still has the file in memory. Codecs
are timed in memory, in CPU seconds of one thread, on chunks as the store has them.
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

from benchmarks.asset import metal_scene, offline
from benchmarks.report import Report, Row, Table
from benchmarks.scenes import Setting, main_store, write_scene

BLOCK = 1024  # receivers in a chunk at R = 64
REPEATS = 3
MOST_CHUNKS = 8  # of an array that codecs are tried on
LARGEST = 6  # arrays of a store that codecs are tried on


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


def codecs() -> dict[str, Any]:
    """What is tried; the format has lz4 (blosc, level 5), zstd (level 3) and zstd in blosc, bytes shuffled."""
    from numcodecs import Blosc, Zstd

    return {
        "lz4": Blosc("lz4", 5, Blosc.SHUFFLE),
        "zstd": Zstd(3),
        "zstd 1": Zstd(1),
        "zstd 9": Zstd(9),
        "blosc lz4, bits": Blosc("lz4", 5, Blosc.BITSHUFFLE),
        "blosc zstd 3, bytes": Blosc("zstd", 3, Blosc.SHUFFLE),
        "blosc zstd 3, bits": Blosc("zstd", 3, Blosc.BITSHUFFLE),
    }


def codec_rows(path: Path) -> list[tuple[str, str, float, float, float, float]]:
    """For the largest arrays of a store and each codec: bytes of the values, how many times smaller, MB/s of values
    compressed and decompressed."""
    from numcodecs import blosc

    import relight_formats as formats

    blosc.use_threads = False
    store = formats.open_store(path)
    sizes = store.sizes()
    rows = []
    for name in sorted(store.names(), key=lambda n: -sizes[n].stored)[:LARGEST]:
        layout, array = store.layouts[name], store.array(name)
        starts = range(0, layout.shape[0], layout.chunks[0])
        starts = starts[:: max(1, len(starts) // MOST_CHUNKS)]
        parts: list[Any] = [np.ascontiguousarray(array[a : a + layout.chunks[0]]) for a in starts]
        raw = sum(part.nbytes for part in parts)
        for label, codec in codecs().items():
            seconds = [0.0, 0.0]
            clock = time.thread_time()
            packed = [codec.encode(part) for part in parts]
            seconds[0] = time.thread_time() - clock
            clock = time.thread_time()
            for data in packed:
                codec.decode(data)
            seconds[1] = time.thread_time() - clock
            speed = [raw / 1e6 / max(s, 1e-9) for s in seconds]
            what = f"{name} ({layout.data_type})"
            rows.append((what, label, sizes[name].raw / 1e6, raw / sum(map(len, packed)), *speed))
    return rows


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
    metal, _ = metal_scene(setting)
    folder = setting.work / "codecs"
    folder.mkdir()
    offline(metal, folder, setting.options)
    head = ("array", "codec", "MB of values", "times smaller", "compressed, MB/s", "decompressed, MB/s")
    for kind in ("transfer", "asset"):
        rows = codec_rows(folder / f"{kind}.zarr")
        report.tables.append(Table(f"codecs: the largest arrays of a {kind} store with two bounces", head, tuple(rows)))
    return report
