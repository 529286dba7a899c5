"""Processes that are timed: a program from its start to its end, and a function in all cores at the same time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from threading import Barrier
from typing import Any

PATIENCE = 900.0  # seconds that a process waits for the others before it gives up


@dataclass(frozen=True)
class Finished:
    """seconds from start to end; cpu_seconds of the program and its workers; peak_bytes of the largest process among
    them; its stdout."""

    seconds: float
    cpu_seconds: float
    peak_bytes: int
    stdout: bytes


def cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_program(*command: str | Path, stdin: bytes | None = None, env: dict[str, str] | None = None) -> Finished:
    """Runs a program to its end. Raises RuntimeError with its stderr if it fails.

    The kernel counts the caller's memory at the fork into the child's peak: call this from a small process.
    """
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err, tempfile.TemporaryFile() as given:
        given.write(stdin or b"")
        given.seek(0)
        started = time.perf_counter()
        process = subprocess.Popen(
            [str(part) for part in command], stdin=given, stdout=out, stderr=err, env={**os.environ, **(env or {})}
        )
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - started
        process.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0)
        err.seek(0)
        if process.returncode != 0:
            raise RuntimeError(f"{command[0]} ended with {process.returncode}: {err.read().decode()[-2000:]}")
        return Finished(seconds, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024, out.read())


def run_tool(*arguments: str | Path, env: dict[str, str] | None = None) -> tuple[Finished, dict[str, Any]]:
    """Runs `relightcli ... --json`; what it took and what it said."""
    finished = run_program(sys.executable, "-m", "relightcli", *arguments, "--json", env=env)
    return finished, json.loads(finished.stdout)


_barrier: Barrier | None = None


def _join(barrier: Barrier) -> None:
    global _barrier
    _barrier = barrier


def meet() -> None:
    """Waits until every process of `together` is here."""
    assert _barrier is not None
    _barrier.wait(PATIENCE)


def _call(function: Callable[..., Any], rank: int, count: int, arguments: tuple[Any, ...]) -> Any:
    try:
        return function(rank, count, *arguments)
    except BaseException:
        assert _barrier is not None
        _barrier.abort()  # the others shall not wait for this one
        raise


def together(function: Callable[..., Any], *arguments: Any, count: int | None = None) -> list[Any]:
    """function(rank, count, *arguments) in `count` processes (one per core) at once; results by rank.

    The function calls `meet` at least once before anything it times, so that no process does the work of two.
    """
    count = count or cores()
    # One BLAS thread a process, as the program's own workers have; set before they import NumPy.
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ[name] = "1"
    context = get_context("spawn")
    with ProcessPoolExecutor(count, context, _join, (context.Barrier(count),)) as pool:
        futures = [pool.submit(_call, function, rank, count, arguments) for rank in range(count)]
        return [future.result() for future in futures]
