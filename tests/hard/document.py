"""Writes docs/hard-cases.md from a run of its tests: `python -m tests.hard.document [--from FIGURES.json]`.

What stands between the two marks of a section is replaced; the rest of the page is left alone.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.hard.cases import CASES, nodes

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "hard-cases.md"
FIGURES = ROOT / "build" / "hard-cases.json"
DIGITS = ROOT / "build" / "numerics.json"


def files_and_names(tests: Sequence[str]) -> list[str]:
    """Arguments of pytest: whole files where a test's name ends in *, else the tests."""
    return sorted({test.split("::")[0] if test.endswith("*") else test for test in tests})


def replace(page: str, name: str, body: str) -> str:
    """The page with what is between `<!-- NAME: begin -->` and `<!-- NAME: end -->` exchanged."""
    begin, end = f"<!-- {name}: begin -->\n", f"<!-- {name}: end -->"
    before, found, rest = page.partition(begin)
    inside, closed, after = rest.partition(end)
    if not found or not closed:
        raise ValueError(f"{PAGE}: expected the lines {begin.strip()} and {end}")
    del inside
    return f"{before}{begin}{body.strip()}\n{end}{after}"


def table(rows: list[dict[str, Any]]) -> str:
    """The cases with what their tests measured, as Markdown."""
    by_test: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        by_test.setdefault(row["node"].split("[")[0], []).append(row)
    lines = []
    for section, cases in CASES.items():
        lines += [
            f"### {section}",
            "",
            "| case | test | variants | closest to its bound |",
            "| --- | --- | --- | --- |",
        ]
        for case, tests in cases:
            for k, test in enumerate(tests):
                stem = test.removesuffix("*")
                found = [r for name, own in by_test.items() if name.startswith(stem) for r in own]
                if not test.endswith("*"):
                    found = by_test.get(test, [])
                lines.append(f"| {'' if k else case} | `{test}` | {_outcome(found)} | {_closest(found)} |")
        lines.append("")
    return "\n".join(lines)


def _outcome(rows: list[dict[str, Any]]) -> str:
    if not rows:
        return "not run"
    count = {kind: sum(r["outcome"] == kind for r in rows) for kind in ("passed", "failed", "skipped")}
    parts = [f"{count['passed']} passed"] if count["passed"] else []
    parts += [f"{count['failed']} FAILED"] if count["failed"] else []
    parts += [f"{count['skipped']} do not apply"] if count["skipped"] else []
    return ", ".join(parts)


def _closest(rows: list[dict[str, Any]]) -> str:
    """The figure that is nearest to its bound."""
    figures = [f for r in rows for f in r["figures"]]
    if not figures:
        return ""
    what, measured, bound = max(figures, key=lambda f: f[1] / f[2] if f[2] else (0.0 if f[1] <= 0 else float("inf")))
    return f"{what}: {measured:.2g}, at most {bound:.2g}"


def digits() -> str:
    """The table of `make numerics`, from its last run."""
    from benchmarks.numerics.case import Loss
    from benchmarks.numerics.table import markdown

    rows = json.loads(DIGITS.read_text())["rows"]
    return markdown([Loss(**{key: value for key, value in row.items() if key != "met"}) for row in rows])


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.hard.document", description=__doc__)
    parser.add_argument("--from", dest="source", type=Path, help="figures of a run that is over; runs nothing")
    options = parser.parse_args()
    code = 0
    if options.source is None:
        command = [sys.executable, "-m", "pytest", "-q", "--figures", str(FIGURES), *files_and_names(nodes())]
        code = subprocess.run(command, cwd=ROOT).returncode
        code = subprocess.run([sys.executable, "-m", "benchmarks.numerics"], cwd=ROOT).returncode or code
    page = replace(PAGE.read_text(), "cases", table(json.loads((options.source or FIGURES).read_text())))
    PAGE.write_text(replace(page, "digits", digits()))
    return code


if __name__ == "__main__":
    sys.exit(main())
