"""The same blocks on two local processes and on two Dask workers, turn about.

The workers run before the clock starts, as on a cluster; local processes start with each run. Both sides are the whole
program, from its start to its end.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.processes import run_tool
from benchmarks.report import Report, Row
from benchmarks.scenes import Setting, write_scene

WORKERS = 2
ROUNDS = 3
LIMIT = 1.1
START_SECONDS = 60


class _Cluster:
    """A scheduler and its workers, one thread each."""

    def __init__(self, folder: Path) -> None:
        file = folder / "scheduler.json"
        common = ["--scheduler-file", str(file), "--no-dashboard"]
        self.processes = [
            _start("scheduler", *common, "--host", "127.0.0.1", "--port", "0"),
            *(_start("worker", *common, "--nthreads", "1", "--no-nanny") for _ in range(WORKERS)),
        ]
        deadline = time.monotonic() + START_SECONDS
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        self.address: str = json.loads(file.read_text())["address"]

    def cpu_seconds(self) -> float:
        """Of all its processes so far."""
        total = 0
        for process in self.processes:
            fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
            total += int(fields[11]) + int(fields[12])
        return total / os.sysconf("SC_CLK_TCK")

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


def _start(kind: str, *options: str) -> subprocess.Popen[bytes]:
    # One BLAS thread, as the program's own workers have.
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    return subprocess.Popen(
        [sys.executable, "-m", f"distributed.cli.dask_{kind}", *options],
        env={**os.environ, **dict.fromkeys(names, "1")},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def measure(setting: Setting) -> Report:
    from resource import RUSAGE_CHILDREN, getrusage

    scene, subject = write_scene(setting)
    report = Report(f"precompute of {subject}, {WORKERS} processes: Dask workers that run against local processes")
    try:
        import distributed  # noqa: F401
    except ImportError:
        report.skipped.append("Dask is not installed: pip install 'relightcli[cluster]'")
        return report
    cluster = _Cluster(setting.work)
    wall: dict[str, list[float]] = {"local": [], "dask": []}
    cpu: dict[str, list[float]] = {"local": [], "dask": []}

    def spent() -> float:
        usage = getrusage(RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime + cluster.cpu_seconds()

    try:
        for turn in range(-1, ROUNDS):  # the first of each compiles, and imports in the cluster's workers
            for name, options in (
                ("local", ("--workers", str(WORKERS))),
                ("dask", ("--workers", str(WORKERS), "--scheduler", cluster.address)),
            ):
                store = setting.work / f"{name}.zarr"
                shutil.rmtree(store, ignore_errors=True)
                before = spent()
                finished, _ = run_tool("precompute", scene, "-o", store, *options, *setting.options)
                if turn >= 0:
                    wall[name].append(finished.seconds)
                    cpu[name].append(spent() - before)
    finally:
        cluster.close()
    for what, clocks in (("from start to end", wall), ("CPU of all processes", cpu)):
        dask, local = (statistics.median(clocks[name]) for name in ("dask", "local"))
        target = f"<= {LIMIT:g} times as long" if clocks is wall else ""
        met = dask <= LIMIT * local if clocks is wall else None
        report.rows.append(Row(what, dask, "s", f"local processes: {local:.2f} s", local / dask, target, met))
    return report
