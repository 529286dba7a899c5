"""A program run to its end in a process of its own: wall seconds, CPU seconds, peak memory, what it printed."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass

PATIENCE = 10.0  # seconds that an interrupted program gets to put things in order
# A small interpreter asks for SIGTERM (15) at its caller's death (PR_SET_PDEATHSIG, 1) and becomes the program. Python
# code between fork and exec would do the same, but is not safe in a process with threads.
_BOUND = (
    "import ctypes, os, sys; ctypes.CDLL(None).prctl(1, 15);"
    "os.getppid() == int(sys.argv[1]) or sys.exit(1); os.execvp(sys.argv[2], sys.argv[2:])"
)


@dataclass(frozen=True)
class Finished:
    """seconds from start to end; cpu_seconds of it and its workers; peak_bytes of the largest process among them."""

    code: int
    seconds: float
    cpu_seconds: float
    peak_bytes: int
    stdout: str
    stderr: str


def run_program(command: Sequence[str]) -> Finished:
    """Runs a program to its end, without input. An interrupt ends it too; so does, on Linux, the caller's death.

    On Linux its seconds include the start of an interpreter without modules, some hundredths. The kernel may count the
    caller's memory at the fork into the peak: call this from a process smaller than the program.
    """
    if sys.platform == "linux":
        command = [sys.executable, "-I", "-S", "-c", _BOUND, str(os.getpid()), *command]
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        started = time.perf_counter()
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=err)
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except BaseException:
            _end(process)
            raise
        seconds = time.perf_counter() - started
        process.returncode = os.waitstatus_to_exitcode(status)
        unit = 1 if sys.platform == "darwin" else 1024
        out.seek(0)
        err.seek(0)
        return Finished(
            process.returncode,
            seconds,
            usage.ru_utime + usage.ru_stime,
            usage.ru_maxrss * unit,
            out.read().decode("utf-8", "replace"),
            err.read().decode("utf-8", "replace"),
        )


def _end(process: subprocess.Popen[bytes]) -> None:
    """Asks the program to end, and kills it if it does not."""
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    try:
        process.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
