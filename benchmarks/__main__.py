"""Runs the benchmarks: `python -m benchmarks [NAME ...] [--quick] [--markdown] [--output FILE]`."""

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

from benchmarks import report

NAMES = (
    "visibility",
    "picture",
    "mitsuba",
    "sh_transfer",
    "sky_matrix",
    "store",
    "scheduler",
    "growth",
    "accuracy",
    "interreflections",
    "brdf",
    "asset",
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
PACKAGES = ("relightcli", "numpy", "numba", "zarr", "embreex", "mitsuba", "pyradiance")
RESULTS = Path("build/bench.json")


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


def run(names: list[str], quick: bool, output: Path) -> int:
    """Runs the named benchmarks one after another, each in its own process; results join those in `output`."""
    output.parent.mkdir(parents=True, exist_ok=True)
    failed = []
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
            document: dict[str, Any] = {"format": 1, "runs": {}} | (load(output) or {}) | {"machine": machine()}
            document["runs"][name] = {"quick": quick, "seconds": seconds, "report": found}
            output.write_text(json.dumps(document, indent=1))
            print(f"{report.text(name, found)}\n({seconds:.0f} s)\n", flush=True)
    return 1 if failed else 0


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"which: {', '.join(NAMES)} (default: all)")
    parser.add_argument("--quick", action="store_true", help="small sizes: that it runs, not how fast it is")
    parser.add_argument("--markdown", action="store_true", help="print the last results as Markdown; run nothing")
    parser.add_argument("--output", type=Path, default=RESULTS, help=f"JSON with all results (default: {RESULTS})")
    options = parser.parse_args()
    unknown = sorted(set(options.names) - set(NAMES))
    if unknown:
        parser.error(f"no benchmark named {', '.join(unknown)}; there are {', '.join(NAMES)}")
    if options.markdown:
        document = load(options.output)
        if document is None:
            parser.error(f"{options.output} does not exist; run the benchmarks first")
        print(report.markdown(document))
        return 0
    return run([name for name in NAMES if name in (options.names or NAMES)], options.quick, options.output)


if __name__ == "__main__":
    sys.exit(main())
