"""Prints what every kernel loses: `python -m benchmarks.numerics [--output FILE]`. Exit code 1: a bound is broken."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from benchmarks.numerics.table import losses, markdown

RESULTS = Path("build/numerics.json")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.numerics", description=__doc__)
    parser.add_argument("--output", type=Path, default=RESULTS, help=f"JSON of all rows (default: {RESULTS})")
    options = parser.parse_args()
    rows = losses()
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps({"format": 1, "rows": [row.to_json() for row in rows]}, indent=1) + "\n")
    print(markdown(rows))
    broken = [row.kernel for row in rows if not row.met]
    if broken:
        print(f"beyond their bound: {', '.join(broken)}", file=sys.stderr)
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
