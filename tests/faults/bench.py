"""A place where one command after another is harmed, and the judge of what is left: what an undisturbed run writes."""

from __future__ import annotations

import contextlib
import io
import os
import random
import shutil
import signal
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from tests.faults.children import Child, Result
from tests.faults.stations import OUT, STATIONS, Station, clear, content, make_workplace
from tests.faults.sweep_in_forks import sweep

HANG = 60.0  # seconds; a command takes about one
WAYS_OUT = ("--overwrite", "same command", "again", "delete it", "move it", "Wait for it to end", "another output")


class Violation(Exception):
    """What must not happen did."""


def need(condition: bool, message: str) -> None:
    if not condition:
        raise Violation(message)


@dataclass
class Expected:
    """What an undisturbed run wrote, how many file operations and seconds it took."""

    content: dict[str, dict[str, str]]
    operations: int
    seconds: float


@dataclass
class Bench:
    """Where the commands run. `prepare` comes first; `patience` is how many seconds one of them may take."""

    place: Path
    stations: tuple[Station, ...]
    expected: dict[str, Expected] = field(default_factory=dict)
    patience: float = HANG

    def prepare(self) -> None:
        """Runs every station once in this process, so that forks find everything loaded; keeps what they wrote."""
        from relightcli.cli.main import run

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

    def ends(self, station: Station, number: int = signal.SIGKILL) -> tuple[int, ...]:
        """Exit codes of a command that had a signal, or of a sweep of which one command had it."""
        codes = (0, -number) if number == signal.SIGKILL else (0, 130, -number)
        return (*codes, 5) if station.name == "tradeoff" else codes

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


# Harms a command and judges what comes of it; tells what happened in a word or two. Raises Violation.
Fault = Callable[[Bench, Station, random.Random], str]
