"""Runs the benchmarks: `python -m benchmarks [NAME ...] [--all] [--quick] [--accept] [--markdown | --document]`."""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from benchmarks import compare, report

# Ceilings, peers and whole stages: the short ones.
SHORT = (
    *("visibility", "picture", "mitsuba", "sh_transfer", "sky_matrix", "tensors", "wavelets", "store", "scheduler"),
    "asset",
)
LONG = (
    "growth",
    "accuracy",
    "interreflections",
    "brdf",
    "asset_growth",
    "direct",
    "clusters",
    "pose",
    "fields",
    "planner",
    "promise",
    "field_stores",
    "moving",
)
NAMES = (*SHORT, *LONG)
PACKAGES = ("relightcli", "numpy", "numba", "zarr", "embreex", "mitsuba", "pyradiance", "tensorly", "PyWavelets")
RESULTS = Path("build/bench.json")
LAST = Path("build/bench/last.json")
DOCUMENT = Path(__file__).parents[1] / "docs" / "performance.md"


def machine() -> dict[str, Any]:
    """What the numbers were taken on."""
    versions: dict[str, str | None] = {}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = None
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        models = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        cpu = models[0] if models else cpu
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"cores": cores, "cpu": cpu, "python": platform.python_version(), "packages": versions}


def load(path: Path) -> dict[str, Any] | None:
    if not path.exists():
        return None
    document: dict[str, Any] = json.loads(path.read_text())
    return document


def run(names: list[str], quick: bool, output: Path, last: Path, accept: bool) -> int:
    """Runs the named benchmarks one after another, each in its own process; results join those in `output`.

    Full runs are held against `last`, which then takes the new results: unless ratios were lost and `accept` is not
    given, so that the next run is held against the better ones again. Returns 1 where that or a benchmark failed.
    """
    output.parent.mkdir(parents=True, exist_ok=True)
    failed, changes, here = [], [], machine()
    with tempfile.TemporaryDirectory(prefix="bench-", dir=output.parent) as work:
        for name in names:
            result = Path(work) / f"{name}.json"
            started = time.perf_counter()
            # Its own process: a peer may end it, and memory it has used would count into what it starts.
            command = [sys.executable, "-m", "benchmarks.child", name, work, "quick" if quick else "full", str(result)]
            code = subprocess.run(command).returncode
            if code != 0:
                failed.append(name)
                print(f"== {name}: failed with {code}\n", file=sys.stderr, flush=True)
                continue
            found = json.loads(result.read_text())
            seconds = time.perf_counter() - started
            _join(output, name, {"quick": quick, "seconds": seconds, "report": found}, here)
            print(f"{report.text(name, found)}\n({seconds:.0f} s)\n", flush=True)
            if not quick:
                changes += hold(name, found, seconds, here, last, accept)
    if changes:
        print(report.aligned(compare.HEAD, [compare.cells(change) for change in changes]), flush=True)
    lost = [change for change in changes if change.lost]
    for change in lost:
        print(
            f"lost: {change.benchmark}: {change.work}: ratio {change.last:.3g}, now {change.now:.3g}", file=sys.stderr
        )
    if lost and not accept:
        print(f"more than {compare.LOSS:.0%} lost; {last} keeps the old ratios (--accept takes these)", file=sys.stderr)
    return 1 if failed or (lost and not accept) else 0


def hold(
    name: str, found: dict[str, Any], seconds: float, here: dict[str, Any], last: Path, accept: bool
) -> list[compare.Change]:
    """Compares with the last full run of a benchmark; becomes it, if nothing is lost or `accept` is given."""
    kept = ((load(last) or {}).get("runs") or {}).get(name)
    changes: list[compare.Change] = []
    if kept is not None:
        changes = compare.compare(name, found, kept["report"], compare.of_one_machine(here, kept["machine"]))
    if accept or not any(change.lost for change in changes):
        last.parent.mkdir(parents=True, exist_ok=True)
        _join(last, name, {"quick": False, "seconds": seconds, "report": found, "machine": here}, here)
    return changes


def _join(path: Path, name: str, result: dict[str, Any], here: dict[str, Any]) -> None:
    document: dict[str, Any] = {"format": 1, "runs": {}} | (load(path) or {}) | {"machine": here}
    document["runs"][name] = result
    path.write_text(json.dumps(document, indent=1))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"which: {', '.join(NAMES)} (default: {', '.join(SHORT)})"
    )
    parser.add_argument("--all", action="store_true", help="all of them, which takes hours")
    parser.add_argument("--quick", action="store_true", help="small sizes: that it runs, not how fast it is")
    parser.add_argument("--accept", action="store_true", help="what this run measures is held against from now on")
    parser.add_argument("--markdown", action="store_true", help="print the last results as Markdown; run nothing")
    parser.add_argument("--document", action="store_true", help=f"write the ratios into {DOCUMENT.name}; run nothing")
    parser.add_argument("--output", type=Path, default=RESULTS, help=f"JSON with all results (default: {RESULTS})")
    parser.add_argument("--last", type=Path, default=LAST, help=f"JSON of the last full runs (default: {LAST})")
    options = parser.parse_args()
    unknown = sorted(set(options.names) - set(NAMES))
    if unknown:
        parser.error(f"no benchmark named {', '.join(unknown)}; there are {', '.join(NAMES)}")
    if options.markdown or options.document:
        document = load(options.output)
        if document is None:
            parser.error(f"{options.output} does not exist; run the benchmarks first")
        if options.document:
            DOCUMENT.write_text(report.put_ratios(DOCUMENT.read_text(), document))
        else:
            print(report.markdown(document))
        return 0
    names = NAMES if options.all else options.names or SHORT
    return run([name for name in NAMES if name in names], options.quick, options.output, options.last, options.accept)


if __name__ == "__main__":
    sys.exit(main())
