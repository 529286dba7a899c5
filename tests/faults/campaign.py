"""The long run: every command that writes is killed, starved, damaged and confused, again and again.

    python -m tests.faults.campaign --kills 500 --corruptions 500 --others 300 --seed 0

After each fault, what is on disk is judged: a command that ends well has written what an undisturbed run writes, byte
for byte; one that refuses has exit code 3 or 5, names a file and says what to do, and does no harm; the same command
run again (with --overwrite where it asks for that) comes out with the same bytes. A traceback, a hang, an internal
error, a process or a file left over is a violation; the exit code is then 1. Results are kept line by line, so that a
run that was cut off goes on where it stopped.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import io
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from relight_formats.header import dump
from tests.faults import harness
from tests.faults.children import Child, Result, calls, dies, fails, one_thread
from tests.faults.damage import HARMS, damage, files_of
from tests.faults.stations import BY_NAME, OUT, STATIONS, Station, clear, content, make_workplace
from tests.faults.sweep_in_forks import sweep

HANG = 60.0  # seconds; a command takes about one
SIGNALS = {"SIGKILL": signal.SIGKILL, "SIGINT": signal.SIGINT, "SIGTERM": signal.SIGTERM}
WAYS_OUT = ("--overwrite", "same command", "again", "delete it", "move it", "Wait for it to end", "another output")


class Violation(Exception):
    """What must not happen did."""


@dataclass
class Expected:
    """What an undisturbed run wrote, how many file operations and seconds it took."""

    content: dict[str, dict[str, str]]
    operations: int
    seconds: float


@dataclass
class Campaign:
    place: Path
    stations: tuple[Station, ...]
    expected: dict[str, Expected] = field(default_factory=dict)
    patience: float = HANG

    # Preparation

    def prepare(self) -> None:
        """Runs every station once in this process, so that forks find everything loaded; keeps what they wrote."""
        from relightcli.adapters.oiio import load_oiio
        from relightcli.cli.main import run

        load_oiio().attribute("exr_threads", -1)  # threads of a pool do not come along into a fork
        make_workplace(self.place)
        os.chdir(self.place)
        handler = signal.getsignal(signal.SIGTERM)
        for station in self._with_sources():
            with contextlib.redirect_stdout(io.StringIO()):
                if station.name != "tradeoff" and run([*station.command(), "--json"]) != 0:
                    raise SystemExit(f"{station.name}: fails undisturbed")
            if station in self.stations:
                clear(self.place)
                result = self.child(station).finish(HANG)
                if result.code != 0:
                    raise SystemExit(f"{station.name}: fails in a fork, {result}")
                written = {name: content(self.out / name) for name in station.writes}
                self.expected[station.name] = Expected(written, result.operations, result.seconds)
            for name in station.writes:
                shutil.move(self.out / name, self.place / name)
            clear(self.place)
        signal.signal(signal.SIGTERM, handler)  # the program has set its own

    def _with_sources(self) -> list[Station]:
        wanted = set(self.stations)
        while True:
            sources = {s for s in STATIONS if any(set(s.writes) & set(w.words) for w in wanted)}
            if sources <= wanted:
                return [s for s in STATIONS if s in wanted]
            wanted |= sources

    @property
    def out(self) -> Path:
        return self.place / OUT

    # One command

    def child(
        self,
        station: Station,
        act: Callable[[int, str, str], None] | None = None,
        *,
        overwrite: bool = False,
        before: Callable[[], None] | None = None,
        watched: Path | None = None,
    ) -> Child:
        run = sweep if station.name == "tradeoff" else None
        words = station.command(overwrite=overwrite)
        return Child(self.place, words, act=act, watched=watched or self.out, before=before, run=run)

    def end(self, child: Child, codes: tuple[int, ...], what: str) -> Result:
        result = child.finish(self.patience)
        need(result.code is not None, f"{what}: hangs")
        need("Traceback" not in result.stderr, f"{what}: traceback:\n{result.stderr}")
        need("internal error" not in result.stderr, f"{what}: {result.stderr}")
        need(result.code in codes, f"{what}: exit code {result.code}, expected {codes}: {result.stderr}")
        if result.code == 5 and what.startswith("SIG"):  # of a sweep: one of its commands was killed
            need("was ended by signal" in result.stderr, f"{what}: {result.stderr}")
        if result.code in (3, 5) and not what.startswith("inspect --verify"):  # that one tells on stdout
            need(bool(result.stderr.strip()), f"{what}: refuses without a word")
        return result

    def need_right(self, station: Station, what: str, *, partly: bool = False) -> None:
        """What stands under the final names is what an undisturbed run writes; `partly`: or is not there."""
        for name in station.writes:
            path = self.out / name
            if partly and (not path.exists() or station.name == "tradeoff"):
                continue
            need(path.exists(), f"{what}: {name} is not there")
            found, right = content(path), self.expected[station.name].content[name]
            wrong = sorted(k for k in {*found, *right} if found.get(k) != right.get(k))
            need(not wrong, f"{what}: {name} differs in {wrong[:5]}")

    def need_clean(self, station: Station, what: str) -> None:
        left = sorted(p.name for p in self.out.iterdir() if p.name not in station.writes)
        need(not left, f"{what}: leaves {left}")

    def again(self, station: Station, *, refused: bool = False) -> None:
        """The same command, undisturbed, comes to the right end; where it may refuse, with --overwrite."""
        result = self.end(self.child(station), (0, 3) if refused else (0,), "run again")
        if result.code == 3:
            need(any(way in result.stderr for way in WAYS_OUT), f"run again: names no way out: {result.stderr}")
            need("--overwrite" in result.stderr, f"run again: does not speak of --overwrite: {result.stderr}")
            self.end(self.child(station, overwrite=True), (0,), "run again with --overwrite")
        self.need_right(station, "run again")
        self.need_clean(station, "run again")

    # Faults. Each starts with nothing written and returns what happened, in a word or two.

    def killed_at_an_operation(self, station: Station, rng: random.Random) -> str:
        name = rng.choice(tuple(SIGNALS))
        total = self.expected[station.name].operations
        # Half of them where a store or file takes its name, among the last operations.
        at = rng.randint(max(1, total - 8), total) if rng.random() < 0.4 else rng.randint(1, total)
        result = self.end(
            self.child(station, dies(at, SIGNALS[name])), self._ends(station, SIGNALS[name]), f"{name} at {at}"
        )
        self._after_signal(station, name, result)
        return name

    def killed_at_a_time(self, station: Station, rng: random.Random) -> str:
        name = rng.choice(tuple(SIGNALS))
        child = self.child(station)
        time.sleep(rng.uniform(0.0, 1.0) * self.expected[station.name].seconds)
        child.signal(SIGNALS[name])
        result = self.end(child, (0, 130, -SIGNALS[name]), name)
        self._after_signal(station, name, result)
        return name

    def _ends(self, station: Station, number: int = signal.SIGKILL) -> tuple[int, ...]:
        """Exit codes of a command that had a signal, or of a sweep of which one command had it."""
        codes = (0, -number) if number == signal.SIGKILL else (0, 130, -number)
        return (*codes, 5) if station.name == "tradeoff" else codes

    def _after_signal(self, station: Station, name: str, result: Result) -> None:
        if result.code == 130:
            need("run the same command again" in result.stderr, f"{name}: does not say how to go on: {result.stderr}")
        self.need_right(station, f"after {name}", partly=True)
        self.again(station)

    def killed_twice(self, station: Station, rng: random.Random) -> str:
        total = self.expected[station.name].operations
        for at in (rng.randint(1, total), rng.randint(1, total)):
            self.end(self.child(station, dies(at, signal.SIGKILL)), self._ends(station), f"SIGKILL at {at}")
        self.again(station)
        return "SIGKILL"

    def killed_while_replacing(self, station: Station, rng: random.Random) -> str:
        """With --overwrite over the finished output: the old one or the new one is there, whole, at any time."""
        for name in station.writes:
            source, target = self.place / name, self.out / name
            shutil.copytree(source, target) if source.is_dir() else shutil.copy(source, target)
        overwrite = station.name != "diff"
        at = rng.randint(1, self.expected[station.name].operations + 6)
        self.end(
            self.child(station, dies(at, signal.SIGKILL), overwrite=overwrite), self._ends(station), f"SIGKILL at {at}"
        )
        replaced = self.out / f"{station.writes[0]}.replaced"
        if station.is_store and not (self.out / station.writes[0]).exists():
            need(replaced.exists(), "between two names: neither the old store nor the new one is there")
        else:
            self.need_right(station, "after SIGKILL", partly=station.name == "tradeoff")
        self.again(station)
        return "SIGKILL"

    def program_killed(self, station: Station, rng: random.Random) -> str:
        """The real program with two workers; all of it or its parent alone."""
        name = rng.choice(tuple(SIGNALS))
        process = harness.start(self.place, *station.command(workers=2))
        try:
            time.sleep(rng.uniform(0.3, 1.0) * (2.0 + 2.0 * self.expected[station.name].seconds))
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
        self.need_right(station, f"after {name}", partly=True)
        self.again(station)
        return name

    def disk_full(self, station: Station, rng: random.Random) -> str:
        at = rng.randint(1, self.expected[station.name].operations)
        result = self.end(self.child(station, fails(at, errno.ENOSPC)), (0, 5), f"disk full at {at}")
        self._after_refusal(station, result, "No space left")
        return "ENOSPC"

    def file_too_large(self, station: Station, rng: random.Random) -> str:
        # The limit holds for the answers that a sweep gets from its commands too.
        limit = int(10 ** rng.uniform(3.5 if station.name == "tradeoff" else 1.0, 5.0))
        result = self.end(self.child(station, before=harness.limit_file_size(limit)), (0, 5), f"limit of {limit} bytes")
        self._after_refusal(station, result, "too large")
        return "EFBIG"

    def read_only(self, station: Station, rng: random.Random) -> str:
        at = rng.randint(1, self.expected[station.name].operations)
        result = self.end(self.child(station, fails(at, errno.EROFS)), (0, 5), f"read-only at {at}")
        self._after_refusal(station, result, "Read-only")
        return "EROFS"

    def _after_refusal(self, station: Station, result: Result, why: str) -> None:
        if result.code == 5:
            need(why in result.stderr, f"does not say why: {result.stderr}")
            need(OUT in result.stderr or station.writes[0] in result.stderr, f"names no file: {result.stderr}")
        self.need_right(station, "after the refusal", partly=True)
        self.again(station)

    def small_disk(self, station: Station, rng: random.Random) -> str:
        """A real file system without room: a tmpfs of a few pages, then the same with more."""
        pages = rng.randint(2, 60)

        def supervise(words: list[str]) -> None:
            harness.mount_small(self.out, 4096 * pages)
            result = self.end(self.child(station), (0, 5), f"disk of {4 * pages} kB")
            if result.code == 5:
                need("No space left" in result.stderr, f"does not say why: {result.stderr}")
            self.need_right(station, "after the refusal", partly=True)
            harness.grow(self.out, 1 << 30)
            self.again(station)

        result = Child(self.place, [], run=supervise, watched=self.out).finish(3 * HANG)
        if result.code == 98:
            return "not possible here"
        need(result.code == 0, f"disk of {4 * pages} kB: {result.stderr}")
        return "tmpfs"

    def no_permission(self, station: Station, rng: random.Random) -> str:
        """The output folder may not be written, or a file that is read may not be read."""
        source = self.place / station.reads
        readable = [source] if source.is_file() else files_of(source)
        locked = rng.choice([self.out, rng.choice(readable)])
        mode = locked.stat().st_mode
        locked.chmod(0o555 if locked == self.out else 0)
        try:
            child = self.child(station, before=harness.drop_root_powers)
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
        self.need_right(station, "after the refusal", partly=True)
        self.again(station)
        return "EACCES"

    def damaged_source(self, station: Station, rng: random.Random) -> str:
        """A file of the store that is read is damaged: found and named, or never needed."""
        store = self.place / station.reads
        if store.suffix != ".zarr":
            return self.damaged_output(station, rng)
        path = rng.choice(files_of(store))
        original = path.read_bytes()
        harm = rng.choice(HARMS)
        try:
            if not damage(path, harm, rng):
                return "no change"
            relative = path.relative_to(store)
            self._need_found(store, relative)
            result = self.end(self.child(station), (0, 3), f"{store.name}/{relative} {harm}")
            if result.code == 3:
                self._need_named(result.stderr, store, relative)
        finally:
            path.write_bytes(original)
        self.need_right(station, f"{relative} {harm}", partly=result.code == 3)
        self.again(station)
        return harm

    def _need_found(self, store: Path, relative: Path) -> None:
        if relative.name == "zarr.json" and relative.parent == Path():
            return  # an additional byte after the root document is no damage, but `inspect --verify` names it
        words = ["inspect", str(store), "--verify"]
        self.end(Child(self.place, words, watched=self.out), (3,), f"inspect --verify, {relative}")

    def _need_named(self, stderr: str, store: Path, relative: Path) -> None:
        names = (relative.as_posix(), relative.parent.as_posix() if relative.parent != Path() else relative.name)
        need(any(name in stderr for name in names), f"does not name {relative}: {stderr}")
        need(any(way in stderr for way in WAYS_OUT), f"names no way out: {stderr}")

    def damaged_output(self, station: Station, rng: random.Random) -> str:
        """The finished store itself: --verify finds it, the command does not take it for good work of another kind."""
        if not station.is_store:
            station = BY_NAME[rng.choice([s.name for s in self.stations if s.is_store])]
        store = self.out / station.writes[0]
        shutil.copytree(self.place / station.writes[0], store)
        path = rng.choice(files_of(store))
        harm = rng.choice(HARMS)
        if not damage(path, harm, rng):
            return "no change"
        relative = path.relative_to(store)
        self._need_found(store, relative)
        result = self.end(self.child(station), (0, 3), f"{relative} {harm}")
        if result.code == 3:
            need(any(way in result.stderr for way in WAYS_OUT), f"names no way out: {result.stderr}")
        if path.name == "zarr.json" and path.parent == store and harm in ("deleted", "emptied"):
            need(result.code == 3, "a folder without a root document passes for a store")
            return harm  # no store any more: it is never touched, the user moves it away
        self.end(self.child(station, overwrite=True), (0, 3), "--overwrite")
        return harm

    def damaged_partial(self, station: Station, rng: random.Random) -> str:
        """Unfinished work is damaged: the rerun mends it, or refuses and tells the way out."""
        if not station.resumes:
            return self.damaged_source(station, rng)
        at = rng.randint(2, self.expected[station.name].operations)
        self.end(self.child(station, dies(at, signal.SIGKILL)), self._ends(station), f"SIGKILL at {at}")
        found = files_of(self.out)
        if not found:
            return "nothing there"
        path = rng.choice(found)
        harm = rng.choice(HARMS)
        if path.name.endswith(".lock") or not damage(path, harm, rng):
            return "no change"
        relative = path.relative_to(self.out)
        result = self.end(
            self.child(station), (0, 2, 3) if station.name == "tradeoff" else (0, 3), f"{relative} {harm}"
        )
        if result.code == 0:
            if not self._lost_name(station, relative):
                self.need_right(station, f"{relative} {harm}, taken up")
            return harm
        need(relative.name in result.stderr or relative.parent.name in result.stderr, f"{relative}: {result.stderr}")
        need(any(way in result.stderr for way in WAYS_OUT), f"{relative}: names no way out: {result.stderr}")
        if "--overwrite" in result.stderr:
            self.end(self.child(station, overwrite=True), (0,), "--overwrite")
            self.need_right(station, "--overwrite")
        return harm

    def _lost_name(self, station: Station, relative: Path) -> bool:
        """Whether the damage hit a finished output, which a rerun does not read through (`--verify` does)."""
        return relative.parts[0] in station.writes

    def changed_input(self, station: Station, rng: random.Random) -> str:
        """An input changes between an interrupted run and the next one, or amid one."""
        if not station.inputs:
            return self.changed_source(station, rng)
        path = self.place / rng.choice(station.inputs)
        original = path.read_bytes()

        def change() -> None:
            with open(path, "ab") as file:
                file.write(b" ")

        at = rng.randint(1, self.expected[station.name].operations)
        amid = rng.random() < 0.5
        try:
            if amid:
                result = self.end(self.child(station, calls(at, change)), (0, 2, 3), f"{path.name} changed at {at}")
                self.need_right(station, "changed amid", partly=True)
            else:
                self.end(self.child(station, dies(at, signal.SIGKILL)), self._ends(station), f"SIGKILL at {at}")
                change()
            result = self.end(self.child(station), (0, 2, 3), "with a changed input")
            if result.code == 3:
                need(
                    path.name in result.stderr or "input" in result.stderr, f"does not name the input: {result.stderr}"
                )
                need("--overwrite" in result.stderr or "another" in result.stderr, f"no way out: {result.stderr}")
        finally:
            path.write_bytes(original)
        if result.code != 3:  # what was made from the other file is another store
            clear(self.place)
        self.again(station, refused=True)
        return "amid" if amid else "between"

    def changed_source(self, station: Station, rng: random.Random) -> str:
        """The store that is read is exchanged for one of another version or of another scene between two runs."""
        source = self.place / station.reads
        if not source.is_dir():
            return self.other_version(station, rng)
        other = self.place / "other"
        at = rng.randint(1, self.expected[station.name].operations)
        self.end(self.child(station, dies(at, signal.SIGKILL)), self._ends(station), f"SIGKILL at {at}")
        os.rename(source, other)
        try:
            result = self.end(self.child(station), (2, 3), "without its store")
            need(source.name in result.stderr, f"does not name {source.name}: {result.stderr}")
        finally:
            os.rename(other, source)
        self.again(station)
        return "store gone"

    def two_writers(self, station: Station, rng: random.Random) -> str:
        """A second writer, while the first stands still in its middle."""
        at = rng.randint(1, self.expected[station.name].operations)
        first = self.child(station, dies(at, signal.SIGSTOP))
        if not first.stopped(HANG):
            self.end(first, (0,), "never stopped")
            return "too late"
        second = self.end(self.child(station), (0, 3), "second writer")
        if second.code == 3:
            need("another process is writing" in second.stderr, f"does not say why: {second.stderr}")
        else:
            self.need_right(station, "second writer")
        first.signal(signal.SIGCONT)
        first.started = time.monotonic()
        self.end(first, (0, 3) if second.code == 0 else (0,), "first writer")
        self.again(station)
        return "refused" if second.code == 3 else "both whole"

    def other_version(self, station: Station, rng: random.Random) -> str:
        """A store of an older or newer format, or unfinished work of another program."""
        if not station.is_store:
            station = BY_NAME[rng.choice([s.name for s in self.stations if s.is_store])]
        partial = self.out / f"{station.writes[0]}.partial"
        version = rng.choice([0, 2, 99, "1", None, "program"])
        if version == "program":
            total = self.expected[station.name].operations
            self.end(self.child(station, dies(rng.randint(total // 2, total), signal.SIGKILL)), (0, -9), "SIGKILL")
            if not (partial / "zarr.json").exists():
                return "too late"
            harness.rewrite_header(partial, program="relightcli 0.0.1")
            result = self.end(self.child(station), (0, 3), "another program's work")
            if result.code == 3:
                need("program" in result.stderr and "--overwrite" in result.stderr, result.stderr)
                self.end(self.child(station, overwrite=True), (0,), "--overwrite")
            self.need_right(station, "another program's work")
            return "program"
        store = self.out / station.writes[0]
        shutil.copytree(self.place / station.writes[0], store)
        document = json.loads((store / "zarr.json").read_text())
        document["attributes"]["relight"]["format"] = version
        (store / "zarr.json").write_bytes(dump(document))
        for child in (self.child(station), Child(self.place, ["inspect", str(store)], watched=self.out)):
            result = self.end(child, (3,), f"format {version}")
            need("format" in result.stderr, f"does not name the version: {result.stderr}")
        self.end(self.child(station, overwrite=True), (0,), "--overwrite")
        self.need_right(station, "--overwrite")
        return f"format {version}"

    def other_order(self, station: Station, rng: random.Random) -> str:
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

        child = Child(self.place, station.command(workers=workers), run=shuffled, watched=self.out)
        self.end(child, (0,), f"{workers} workers")
        self.need_right(station, f"{workers} workers")
        return f"{workers} workers"

    # The run

    def trial(self, group: str, number: int, seed: int) -> dict[str, str | float]:
        rng = random.Random(f"{seed}/{group}/{number}")
        station = self.stations[number % len(self.stations)]
        if station.name == "tradeoff" and (number // len(self.stations)) % 5:  # a sweep is many commands
            station = self.stations[(number + 1) % len(self.stations)]
        self.patience = HANG + 20.0 * self.expected[station.name].seconds
        fault = rng.choices(*zip(*GROUPS[group], strict=True))[0]
        if station.name == "tradeoff" and fault in ("program_killed", "small_disk", "two_writers", "other_order"):
            fault = GROUPS[group][0][0]
        clear(self.place)
        clock = time.monotonic()
        try:
            outcome, problem = getattr(self, fault)(station, rng), ""
        except Violation as error:
            outcome, problem = "VIOLATION", str(error)
        row = {"group": group, "number": number, "station": station.name, "fault": fault, "outcome": outcome}
        return {**row, "problem": problem, "seconds": round(time.monotonic() - clock, 3)}


# Method and weight.
GROUPS: dict[str, list[tuple[str, float]]] = {
    "kills": [
        ("killed_at_an_operation", 10),
        ("killed_at_a_time", 5),
        ("killed_twice", 2),
        ("killed_while_replacing", 2),
        ("program_killed", 1),
    ],
    "corruptions": [("damaged_source", 4), ("damaged_output", 2), ("damaged_partial", 4)],
    "others": [
        ("disk_full", 4),
        ("file_too_large", 2),
        ("small_disk", 1),
        ("read_only", 2),
        ("no_permission", 2),
        ("changed_input", 3),
        ("two_writers", 2),
        ("other_version", 2),
        ("other_order", 3),
    ],
}


def need(condition: bool, message: str) -> None:
    if not condition:
        raise Violation(message)


def table(rows: list[dict[str, str | float]]) -> str:
    """Trials by station and fault, and violations beside them."""
    faults = [name for group in GROUPS.values() for name, _ in group]
    count = Counter((row["station"], row["fault"]) for row in rows)
    bad = Counter((row["station"], row["fault"]) for row in rows if row["problem"])
    lines = ["| command | " + " | ".join(f.replace("_", " ") for f in faults) + " | all |"]
    lines.append("|---|" + "---:|" * (len(faults) + 1))
    for station in (*(s.name for s in STATIONS), "all"):
        own = [(s, f) for s, f in count if station in (s, "all")]
        if not own:
            continue
        cells = []
        for fault in (*faults, None):
            keys = [k for k in own if fault in (k[1], None)]
            n, wrong = sum(count[k] for k in keys), sum(bad[k] for k in keys)
            cells.append(f"{n} ({wrong} WRONG)" if wrong else str(n or ""))
        lines.append(f"| {station} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="tests.faults.campaign")
    for group in GROUPS:
        parser.add_argument(f"--{group}", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stations", default="", help="names, comma between; default: all")
    parser.add_argument("--results", type=Path, help="file of results, taken up where it is there")
    asked = parser.parse_args(arguments)
    names = asked.stations.split(",") if asked.stations else list(BY_NAME)
    stations = tuple(BY_NAME[name] for name in names)
    known: list[dict[str, str | float]] = []
    if asked.results and asked.results.exists():
        # The last line may have been cut off; nothing is appended to half a line.
        lines = [line for line in asked.results.read_text().splitlines(keepends=True) if line.endswith("}\n")]
        asked.results.write_text("".join(lines))
        known = [json.loads(line) for line in lines]
    done = {(row["group"], row["number"]) for row in known}
    todo = [(g, k) for g in GROUPS for k in range(getattr(asked, g)) if (g, k) not in done]
    todo.sort(key=lambda trial: trial[1] / getattr(asked, trial[0]))  # the groups side by side
    started = time.monotonic()
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as folder:
        campaign = Campaign(Path(folder) / "w", stations)
        results = asked.results.absolute() if asked.results else Path(folder) / "results.jsonl"
        results.parent.mkdir(parents=True, exist_ok=True)
        if todo:
            campaign.prepare()
        with open(results, "a") as file:
            for group, number in todo:
                row = campaign.trial(group, number, asked.seed)
                known.append(row)
                file.write(json.dumps(row) + "\n")
                file.flush()
                if row["problem"]:
                    print(f"{group} {number}: {row['station']}, {row['fault']}: {row['problem']}", flush=True)
        if todo:
            os.chdir("/")
    wrong = sum(bool(row["problem"]) for row in known)
    print(table(known))
    print(f"{len(known)} trials, {wrong} violations, seed {asked.seed}, {time.monotonic() - started:.0f} s")
    return 1 if wrong else 0


if __name__ == "__main__":
    one_thread("tests.faults.campaign")
    code = main()
    sys.stdout.flush()
    os._exit(code)
