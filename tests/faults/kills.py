"""Killed. Each fault starts with nothing written and returns what happened, in a word or two."""

from __future__ import annotations

import os
import random
import shutil
import signal
import time

from tests.faults import harness
from tests.faults.bench import HANG, Bench, Fault, Violation, need
from tests.faults.children import Result, dies
from tests.faults.stations import Station

SIGNALS = {"SIGKILL": signal.SIGKILL, "SIGINT": signal.SIGINT, "SIGTERM": signal.SIGTERM}


def killed_at_an_operation(bench: Bench, station: Station, rng: random.Random) -> str:
    name = rng.choice(tuple(SIGNALS))
    total = bench.expected[station.name].operations
    # Half of them where a store or file takes its name, among the last operations.
    at = rng.randint(max(1, total - 8), total) if rng.random() < 0.4 else rng.randint(1, total)
    result = bench.end(
        bench.child(station, dies(at, SIGNALS[name])), bench.ends(station, SIGNALS[name]), f"{name} at {at}"
    )
    _after_signal(bench, station, name, result)
    return name


def killed_at_a_time(bench: Bench, station: Station, rng: random.Random) -> str:
    name = rng.choice(tuple(SIGNALS))
    child = bench.child(station)
    time.sleep(rng.uniform(0.0, 1.0) * bench.expected[station.name].seconds)
    child.signal(SIGNALS[name])
    result = bench.end(child, (0, 130, -SIGNALS[name]), name)
    _after_signal(bench, station, name, result)
    return name


def _after_signal(bench: Bench, station: Station, name: str, result: Result) -> None:
    if result.code == 130:
        need("run the same command again" in result.stderr, f"{name}: does not say how to go on: {result.stderr}")
    bench.need_right(station, f"after {name}", partly=True)
    bench.again(station)


def killed_twice(bench: Bench, station: Station, rng: random.Random) -> str:
    total = bench.expected[station.name].operations
    for at in (rng.randint(1, total), rng.randint(1, total)):
        bench.end(bench.child(station, dies(at, signal.SIGKILL)), bench.ends(station), f"SIGKILL at {at}")
    bench.again(station)
    return "SIGKILL"


def killed_while_replacing(bench: Bench, station: Station, rng: random.Random) -> str:
    """With --overwrite over the finished output: the old one or the new one is there, whole, at any time."""
    for name in station.writes:
        source, target = bench.place / name, bench.out / name
        shutil.copytree(source, target) if source.is_dir() else shutil.copy(source, target)
    overwrite = station.name != "diff"
    at = rng.randint(1, bench.expected[station.name].operations + 6)
    bench.end(
        bench.child(station, dies(at, signal.SIGKILL), overwrite=overwrite), bench.ends(station), f"SIGKILL at {at}"
    )
    replaced = bench.out / f"{station.writes[0]}.replaced"
    if station.is_store and not (bench.out / station.writes[0]).exists():
        need(replaced.exists(), "between two names: neither the old store nor the new one is there")
    else:
        bench.need_right(station, "after SIGKILL", partly=station.name == "tradeoff")
    bench.again(station)
    return "SIGKILL"


def program_killed(bench: Bench, station: Station, rng: random.Random) -> str:
    """The real program with two workers; all of it or its parent alone."""
    name = rng.choice(tuple(SIGNALS))
    process = harness.start(bench.place, *station.command(workers=2))
    try:
        time.sleep(rng.uniform(0.3, 1.0) * (2.0 + 2.0 * bench.expected[station.name].seconds))
        orphans = harness.descendants(process.pid)
        if rng.random() < 0.5 and name == "SIGKILL":
            process.kill()
        else:
            os.killpg(process.pid, SIGNALS[name])
        code, stderr = harness.finish(process, HANG)
        need(code in (0, 130, -SIGNALS[name]), f"{name}: exit code {code}: {stderr}")
        deadline = time.monotonic() + 10
        while left := [pid for pid in orphans if harness.alive(pid)]:
            need(time.monotonic() < deadline, f"{name}: processes {left} outlive their parent")
            time.sleep(0.02)
    except AssertionError as error:
        raise Violation(str(error)) from None
    finally:
        harness.clear()
    bench.need_right(station, f"after {name}", partly=True)
    bench.again(station)
    return name


# Fault and weight.
KILLS: tuple[tuple[Fault, float], ...] = (
    (killed_at_an_operation, 10),
    (killed_at_a_time, 5),
    (killed_twice, 2),
    (killed_while_replacing, 2),
    (program_killed, 1),
)
