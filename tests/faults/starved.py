"""No room, no permission. Faults as in `kills`."""

from __future__ import annotations

import errno
import random

from tests.faults import harness
from tests.faults.bench import HANG, Bench, Fault, need
from tests.faults.children import Child, Result, fails
from tests.faults.damage import files_of
from tests.faults.stations import OUT, Station


def disk_full(bench: Bench, station: Station, rng: random.Random) -> str:
    at = rng.randint(1, bench.expected[station.name].operations)
    result = bench.end(bench.child(station, fails(at, errno.ENOSPC)), (0, 5), f"disk full at {at}")
    _after_refusal(bench, station, result, "No space left")
    return "ENOSPC"


def file_too_large(bench: Bench, station: Station, rng: random.Random) -> str:
    # The limit holds for the answers that a sweep gets from its commands too.
    limit = int(10 ** rng.uniform(3.5 if station.name == "tradeoff" else 1.0, 5.0))
    result = bench.end(bench.child(station, before=harness.limit_file_size(limit)), (0, 5), f"limit of {limit} bytes")
    _after_refusal(bench, station, result, "too large")
    return "EFBIG"


def read_only(bench: Bench, station: Station, rng: random.Random) -> str:
    at = rng.randint(1, bench.expected[station.name].operations)
    result = bench.end(bench.child(station, fails(at, errno.EROFS)), (0, 5), f"read-only at {at}")
    _after_refusal(bench, station, result, "Read-only")
    return "EROFS"


def _after_refusal(bench: Bench, station: Station, result: Result, why: str) -> None:
    if result.code == 5:
        need(why in result.stderr, f"does not say why: {result.stderr}")
        need(OUT in result.stderr or station.writes[0] in result.stderr, f"names no file: {result.stderr}")
    bench.need_right(station, "after the refusal", partly=True)
    bench.again(station)


def small_disk(bench: Bench, station: Station, rng: random.Random) -> str:
    """A real file system without room: a tmpfs of a few pages, then the same with more."""
    pages = rng.randint(2, 60)

    def supervise(words: list[str]) -> None:
        harness.mount_small(bench.out, 4096 * pages)
        result = bench.end(bench.child(station), (0, 5), f"disk of {4 * pages} kB")
        if result.code == 5:
            need("No space left" in result.stderr, f"does not say why: {result.stderr}")
        bench.need_right(station, "after the refusal", partly=True)
        harness.grow(bench.out, 1 << 30)
        bench.again(station)

    result = Child(bench.place, [], run=supervise, watched=bench.out).finish(3 * HANG)
    if result.code == 98:
        return "not possible here"
    need(result.code == 0, f"disk of {4 * pages} kB: {result.stderr}")
    return "tmpfs"


def no_permission(bench: Bench, station: Station, rng: random.Random) -> str:
    """The output folder may not be written, or a file that is read may not be read."""
    source = bench.place / station.reads
    readable = [source] if source.is_file() else files_of(source)
    locked = rng.choice([bench.out, rng.choice(readable)])
    mode = locked.stat().st_mode
    locked.chmod(0o555 if locked == bench.out else 0)
    try:
        child = bench.child(station, before=harness.drop_root_powers)
        result = child.finish(HANG)
    finally:
        locked.chmod(mode)
    if result.code == 99:
        return "not possible here"
    need(result.code in (0, 5), f"{locked}: exit code {result.code}: {result.stderr}")
    need("Traceback" not in result.stderr and "internal" not in result.stderr, result.stderr)
    if result.code == 5:
        need("ermission denied" in result.stderr, f"does not say why: {result.stderr}")
        need(locked.name in result.stderr, f"does not name {locked}: {result.stderr}")
    bench.need_right(station, "after the refusal", partly=True)
    bench.again(station)
    return "EACCES"


# Fault and weight.
STARVED: tuple[tuple[Fault, float], ...] = (
    (disk_full, 4),
    (file_too_large, 2),
    (small_disk, 1),
    (read_only, 2),
    (no_permission, 2),
)
