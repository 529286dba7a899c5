"""Prints what a sweep found, and fails if its best point is too far off: check.py RESULT.json LIMIT."""

from __future__ import annotations

import json
import sys
from pathlib import Path

result = json.loads(Path(sys.argv[1]).read_text())
limit = float(sys.argv[2])
for point in result["points"]:
    print(f"{point['error']:8.2%} {point['seconds']:8.1f} s {point['bytes'] / 1e6:8.1f} MB  {point['label']}")
print("\n".join([*result["remarks"], *result["undecided"]]))
best = min(result["points"], key=lambda p: p["error"])
if best["error"] > limit:
    sys.exit(f"failed: the least error is {best['error']:.2%} ({best['label']}), more than {limit:.2%}")
if best["ahead_from_pictures"] is None:
    sys.exit(f"failed: a frame of {best['label']} takes longer than path tracing to its error")
print("passed")
