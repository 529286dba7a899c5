"""Damaged: the store that is read, the finished output, unfinished work. Faults as in `kills`."""

from __future__ import annotations

import random
import shutil
import signal
from pathlib import Path

from tests.faults.bench import WAYS_OUT, Bench, Fault, need
from tests.faults.children import Child, dies
from tests.faults.damage import HARMS, damage, files_of
from tests.faults.stations import BY_NAME, Station


def damaged_source(bench: Bench, station: Station, rng: random.Random) -> str:
    """A file of the store that is read is damaged: found and named, or never needed."""
    store = bench.place / station.reads
    if store.suffix != ".zarr":
        return damaged_output(bench, station, rng)
    path = rng.choice(files_of(store))
    original = path.read_bytes()
    harm = rng.choice(HARMS)
    try:
        if not damage(path, harm, rng):
            return "no change"
        relative = path.relative_to(store)
        _need_found(bench, store, relative)
        result = bench.end(bench.child(station), (0, 3), f"{store.name}/{relative} {harm}")
        if result.code == 3:
            _need_named(bench, result.stderr, store, relative)
    finally:
        path.write_bytes(original)
    bench.need_right(station, f"{relative} {harm}", partly=result.code == 3)
    bench.again(station)
    return harm


def _need_found(bench: Bench, store: Path, relative: Path) -> None:
    if relative.name == "zarr.json" and relative.parent == Path():
        return  # an additional byte after the root document is no damage, but `inspect --verify` names it
    words = ["inspect", str(store), "--verify"]
    bench.end(Child(bench.place, words, watched=bench.out), (3,), f"inspect --verify, {relative}")


def _need_named(bench: Bench, stderr: str, store: Path, relative: Path) -> None:
    names = (relative.as_posix(), relative.parent.as_posix() if relative.parent != Path() else relative.name)
    need(any(name in stderr for name in names), f"does not name {relative}: {stderr}")
    need(any(way in stderr for way in WAYS_OUT), f"names no way out: {stderr}")


def damaged_output(bench: Bench, station: Station, rng: random.Random) -> str:
    """The finished store itself: --verify finds it, the command does not take it for good work of another kind."""
    if not station.is_store:
        station = BY_NAME[rng.choice([s.name for s in bench.stations if s.is_store])]
    store = bench.out / station.writes[0]
    shutil.copytree(bench.place / station.writes[0], store)
    path = rng.choice(files_of(store))
    harm = rng.choice(HARMS)
    if not damage(path, harm, rng):
        return "no change"
    relative = path.relative_to(store)
    _need_found(bench, store, relative)
    result = bench.end(bench.child(station), (0, 3), f"{relative} {harm}")
    if result.code == 3:
        need(any(way in result.stderr for way in WAYS_OUT), f"names no way out: {result.stderr}")
    if path.name == "zarr.json" and path.parent == store and harm in ("deleted", "emptied"):
        need(result.code == 3, "a folder without a root document passes for a store")
        return harm  # no store any more: it is never touched, the user moves it away
    bench.end(bench.child(station, overwrite=True), (0, 3), "--overwrite")
    return harm


def damaged_partial(bench: Bench, station: Station, rng: random.Random) -> str:
    """Unfinished work is damaged: the rerun mends it, or refuses and tells the way out."""
    if not station.resumes:
        return damaged_source(bench, station, rng)
    at = rng.randint(2, bench.expected[station.name].operations)
    bench.end(bench.child(station, dies(at, signal.SIGKILL)), bench.ends(station), f"SIGKILL at {at}")
    found = files_of(bench.out)
    if not found:
        return "nothing there"
    path = rng.choice(found)
    harm = rng.choice(HARMS)
    if path.name.endswith(".lock") or not damage(path, harm, rng):
        return "no change"
    relative = path.relative_to(bench.out)
    result = bench.end(bench.child(station), (0, 2, 3) if station.name == "tradeoff" else (0, 3), f"{relative} {harm}")
    if result.code == 0:
        if not _lost_name(bench, station, relative):
            bench.need_right(station, f"{relative} {harm}, taken up")
        return harm
    need(relative.name in result.stderr or relative.parent.name in result.stderr, f"{relative}: {result.stderr}")
    need(any(way in result.stderr for way in WAYS_OUT), f"{relative}: names no way out: {result.stderr}")
    if "--overwrite" in result.stderr:
        bench.end(bench.child(station, overwrite=True), (0,), "--overwrite")
        bench.need_right(station, "--overwrite")
    return harm


def _lost_name(bench: Bench, station: Station, relative: Path) -> bool:
    """Whether the damage hit a finished output, which a rerun does not read through (`--verify` does)."""
    return relative.parts[0] in station.writes


# Fault and weight.
CORRUPTIONS: tuple[tuple[Fault, float], ...] = (
    (damaged_source, 4),
    (damaged_output, 2),
    (damaged_partial, 4),
)
