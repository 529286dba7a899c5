"""One benchmark in a process of its own: `python -m benchmarks.child NAME WORK QUICK OUT.json`."""

from __future__ import annotations

import json
import sys
from importlib import import_module
from pathlib import Path

from benchmarks.scenes import Setting


def main() -> None:
    name, work, quick, out = sys.argv[1:]
    setting = Setting(Path(work), quick == "quick")
    report = import_module(f"benchmarks.{name}").measure(setting)
    Path(out).write_text(json.dumps(report.to_json()))


if __name__ == "__main__":
    main()
