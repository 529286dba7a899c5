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
import json
import os
import random
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.faults.bench import HANG, Bench, Fault, Violation
from tests.faults.children import one_thread
from tests.faults.confused import CONFUSED, other_order, two_writers
from tests.faults.corruptions import CORRUPTIONS
from tests.faults.kills import KILLS, program_killed
from tests.faults.starved import STARVED, small_disk
from tests.faults.stations import BY_NAME, STATIONS, clear

GROUPS: dict[str, tuple[tuple[Fault, float], ...]] = {
    "kills": KILLS,
    "corruptions": CORRUPTIONS,
    "others": (*STARVED, *CONFUSED),
}
Row = dict[str, str | float]


def trial(bench: Bench, group: str, number: int, seed: int) -> Row:
    """One fault on one command, both picked by the group, the number and the seed; what came of it."""
    rng = random.Random(f"{seed}/{group}/{number}")
    station = bench.stations[number % len(bench.stations)]
    if station.name == "tradeoff" and (number // len(bench.stations)) % 5:  # a sweep is many commands
        station = bench.stations[(number + 1) % len(bench.stations)]
    bench.patience = HANG + 20.0 * bench.expected[station.name].seconds
    fault = rng.choices(*zip(*GROUPS[group], strict=True))[0]
    if station.name == "tradeoff" and fault in (program_killed, small_disk, two_writers, other_order):
        fault = GROUPS[group][0][0]
    clear(bench.place)
    clock = time.monotonic()
    try:
        outcome, problem = fault(bench, station, rng), ""
    except Violation as error:
        outcome, problem = "VIOLATION", str(error)
    row = {"group": group, "number": number, "station": station.name, "fault": fault.__name__, "outcome": outcome}
    return {**row, "problem": problem, "seconds": round(time.monotonic() - clock, 3)}


def table(rows: list[Row]) -> str:
    """Trials by station and fault, and violations beside them."""
    faults = [fault.__name__ for group in GROUPS.values() for fault, _ in group]
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
    known: list[Row] = []
    if asked.results and asked.results.exists():
        # The last line may have been cut off; nothing is appended to half a line.
        lines = [line for line in asked.results.read_text().splitlines(keepends=True) if line.endswith("}\n")]
        asked.results.write_text("".join(lines))
        known = [json.loads(line) for line in lines]
    done = {(row["group"], row["number"]) for row in known}
    todo = [(g, k) for g in GROUPS for k in range(getattr(asked, g)) if (g, k) not in done]
    todo.sort(key=lambda one: one[1] / getattr(asked, one[0]))  # the groups side by side
    started = time.monotonic()
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as folder:
        bench = Bench(Path(folder) / "w", stations)
        results = asked.results.absolute() if asked.results else Path(folder) / "results.jsonl"
        results.parent.mkdir(parents=True, exist_ok=True)
        if todo:
            bench.prepare()
        with open(results, "a") as file:
            for group, number in todo:
                row = trial(bench, group, number, asked.seed)
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
