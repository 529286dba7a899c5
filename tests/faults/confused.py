"""Inputs that change, a second writer, other versions, another order of blocks. Faults as in `kills`."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import time

from relight_formats.header import dump
from tests.faults import harness
from tests.faults.bench import HANG, Bench, Fault, need
from tests.faults.children import Child, calls, dies
from tests.faults.stations import BY_NAME, Station, clear


def changed_input(bench: Bench, station: Station, rng: random.Random) -> str:
    """An input changes between an interrupted run and the next one, or amid one."""
    if not station.inputs:
        return changed_source(bench, station, rng)
    path = bench.place / rng.choice(station.inputs)
    original = path.read_bytes()

    def change() -> None:
        with open(path, "ab") as file:
            file.write(b" ")

    at = rng.randint(1, bench.expected[station.name].operations)
    amid = rng.random() < 0.5
    try:
        if amid:
            result = bench.end(bench.child(station, calls(at, change)), (0, 2, 3), f"{path.name} changed at {at}")
            bench.need_right(station, "changed amid", partly=True)
        else:
            bench.end(bench.child(station, dies(at, signal.SIGKILL)), bench.ends(station), f"SIGKILL at {at}")
            change()
        result = bench.end(bench.child(station), (0, 2, 3), "with a changed input")
        if result.code == 3:
            need(path.name in result.stderr or "input" in result.stderr, f"does not name the input: {result.stderr}")
            need("--overwrite" in result.stderr or "another" in result.stderr, f"no way out: {result.stderr}")
    finally:
        path.write_bytes(original)
    if result.code != 3:  # what was made from the other file is another store
        clear(bench.place)
    bench.again(station, refused=True)
    return "amid" if amid else "between"


def changed_source(bench: Bench, station: Station, rng: random.Random) -> str:
    """The store that is read is exchanged for one of another version or of another scene between two runs."""
    source = bench.place / station.reads
    if not source.is_dir():
        return other_version(bench, station, rng)
    other = bench.place / "other"
    at = rng.randint(1, bench.expected[station.name].operations)
    bench.end(bench.child(station, dies(at, signal.SIGKILL)), bench.ends(station), f"SIGKILL at {at}")
    os.rename(source, other)
    try:
        result = bench.end(bench.child(station), (2, 3), "without its store")
        need(source.name in result.stderr, f"does not name {source.name}: {result.stderr}")
    finally:
        os.rename(other, source)
    bench.again(station)
    return "store gone"


def two_writers(bench: Bench, station: Station, rng: random.Random) -> str:
    """A second writer, while the first stands still in its middle."""
    at = rng.randint(1, bench.expected[station.name].operations)
    first = bench.child(station, dies(at, signal.SIGSTOP))
    if not first.stopped(HANG):
        bench.end(first, (0,), "never stopped")
        return "too late"
    second = bench.end(bench.child(station), (0, 3), "second writer")
    if second.code == 3:
        need("another process is writing" in second.stderr, f"does not say why: {second.stderr}")
    else:
        bench.need_right(station, "second writer")
    first.signal(signal.SIGCONT)
    first.started = time.monotonic()
    bench.end(first, (0, 3) if second.code == 0 else (0,), "first writer")
    bench.again(station)
    return "refused" if second.code == 3 else "both whole"


def other_version(bench: Bench, station: Station, rng: random.Random) -> str:
    """A store of an older or newer format, or unfinished work of another program."""
    if not station.is_store:
        station = BY_NAME[rng.choice([s.name for s in bench.stations if s.is_store])]
    partial = bench.out / f"{station.writes[0]}.partial"
    version = rng.choice([0, 2, 99, "1", None, "program"])
    if version == "program":
        total = bench.expected[station.name].operations
        bench.end(bench.child(station, dies(rng.randint(total // 2, total), signal.SIGKILL)), (0, -9), "SIGKILL")
        if not (partial / "zarr.json").exists():
            return "too late"
        harness.rewrite_header(partial, program="relightcli 0.0.1")
        result = bench.end(bench.child(station), (0, 3), "another program's work")
        if result.code == 3:
            need("program" in result.stderr and "--overwrite" in result.stderr, result.stderr)
            bench.end(bench.child(station, overwrite=True), (0,), "--overwrite")
        bench.need_right(station, "another program's work")
        return "program"
    store = bench.out / station.writes[0]
    shutil.copytree(bench.place / station.writes[0], store)
    document = json.loads((store / "zarr.json").read_text())
    document["attributes"]["relight"]["format"] = version
    (store / "zarr.json").write_bytes(dump(document))
    for child in (bench.child(station), Child(bench.place, ["inspect", str(store)], watched=bench.out)):
        result = bench.end(child, (3,), f"format {version}")
        need("format" in result.stderr, f"does not name the version: {result.stderr}")
    bench.end(bench.child(station, overwrite=True), (0,), "--overwrite")
    bench.need_right(station, "--overwrite")
    return f"format {version}"


def other_order(bench: Bench, station: Station, rng: random.Random) -> str:
    """Undisturbed, with 1, 2 or 4 workers or threads and the blocks in any order: the same bytes."""
    workers, seed = rng.choice((1, 2, 4)), rng.random()

    def shuffled(words: list[str]) -> None:
        from relightcli.cli.main import main
        from relightcli.run import blocks

        known = blocks.run_blocks

        def run_blocks(job, todo, ledger, **options):  # type: ignore[no-untyped-def]
            todo = list(todo)
            random.Random(seed).shuffle(todo)
            known(job, todo, ledger, **options)

        blocks.run_blocks = run_blocks
        main(words)

    child = Child(bench.place, station.command(workers=workers), run=shuffled, watched=bench.out)
    bench.end(child, (0,), f"{workers} workers")
    bench.need_right(station, f"{workers} workers")
    return f"{workers} workers"


# Fault and weight.
CONFUSED: tuple[tuple[Fault, float], ...] = (
    (changed_input, 3),
    (two_writers, 2),
    (other_version, 2),
    (other_order, 3),
)
