"""What the steps of a stage cost: seconds of the clock and of the processors, and the largest memory.

A `Meter` measures one piece of work in this process; an `Account` sums the steps of a stage, one after another. Work in
other processes is measured there, by block (`run.blocks`); a step in which it is done shows the time spent waiting for
it.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager


class Meter:
    """Starts when it is made."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def read(self) -> dict[str, float]:
        """seconds: since the start; cpu_seconds: of all threads of this process since then; peak_bytes: the most memory
        that this process has had in its whole life."""
        return {
            "seconds": time.perf_counter() - self._wall,
            "cpu_seconds": time.process_time() - self._cpu,
            "peak_bytes": peak_bytes(),
        }


def peak_bytes() -> float:
    """The most resident memory that this process has had.

    Linux keeps it by address space, where `getrusage` begins with that of the program which started this one.
    """
    try:
        with open("/proc/self/status", encoding="ascii", errors="replace") as status:
            for line in status:
                if line.startswith("VmHWM:"):
                    return 1024.0 * float(line.split()[1])
    except OSError:
        pass
    return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def children_seconds() -> float:
    """Seconds of the processors that this process's children took, of those that have ended, and theirs."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


class Account:
    """Costs by step, in the order in which they were begun. Steps do not overlap, so that they add up."""

    def __init__(self) -> None:
        self.steps: dict[str, dict[str, float]] = {}

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Counts what is done inside towards `name`, also when it fails."""
        meter = Meter()
        try:
            yield
        finally:
            before = self.steps.setdefault(name, {"seconds": 0.0, "cpu_seconds": 0.0, "peak_bytes": 0.0})
            found = meter.read()
            for key in ("seconds", "cpu_seconds"):
                before[key] += found[key]
            before["peak_bytes"] = max(before["peak_bytes"], found["peak_bytes"])

    def seconds(self, name: str) -> float:
        """Of a step; 0 if there was none."""
        return self.steps.get(name, {}).get("seconds", 0.0)
