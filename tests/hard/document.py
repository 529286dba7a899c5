"""Writes docs/hard-cases.md from a run of its tests: `python -m tests.hard.document [--only PART] [--from FILE.json]`.

What stands between the two marks of a section is replaced; the rest of the page is left alone. Tests that were not run
keep what the page says of them. Figures of `make faults` and `make fuzz` are taken from their last runs, where there
are any.
"""

from __future__ import annotations

import argparse
import json
import re
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
FAULTS = ROOT / "build" / "faults"  # a file for every seed
ROW = r"^\| [^|]*\| `(\S+)` \| ([^|]*?) ?\| ([^|]*?) ?\|$"  # test, outcome, figure
FUZZ = ROOT / "build" / "fuzz.json"


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


def table(rows: list[dict[str, Any]], page: str = "") -> str:
    """The cases with what their tests measured, as Markdown; of tests that were not run, what `page` says."""
    known = {test: (outcome, figure) for test, outcome, figure in re.findall(ROW, page, re.MULTILINE)}
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
                outcome, figure = (_outcome(found), _closest(found)) if found else known.get(test, ("not run", ""))
                lines.append(f"| {'' if k else case} | `{test}` | {outcome} | {figure} |")
        lines.append("")
    return "\n".join(lines)


def _outcome(rows: list[dict[str, Any]]) -> str:
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


def faults() -> str:
    """Trials of `make faults` by command and fault, of all seeds, from its results so far."""
    from tests.faults.campaign import GROUPS
    from tests.faults.campaign import table as trials

    lines = [line for path in sorted(FAULTS.glob("seed-*.jsonl")) for line in path.read_text().splitlines()]
    rows = [json.loads(line) for line in lines if line.endswith("}")]
    groups = ", ".join(f"{sum(r['group'] == group for r in rows)} {group}" for group in GROUPS)
    wrong = sum(bool(r["problem"]) for r in rows)
    return f"{len(rows):,} trials: {groups}; {wrong} violations.\n\n{trials(rows)}"


def strangers() -> str:
    """Files that `make fuzz` has given to every parser, from its last run."""
    found = json.loads(FUZZ.read_text())
    count, problems = found["files"], found["problems"]
    lines = ["| parser | files | problems |", "| --- | ---: | ---: |"]
    lines += [f"| {name} | {n:,} | {sum(p.startswith(f'{name} ') for p in problems)} |" for name, n in count.items()]
    lines.append(f"| all, in {found['minutes']:g} minutes | {sum(count.values()):,} | {len(problems)} |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.hard.document", description=__doc__)
    parser.add_argument("--from", dest="source", type=Path, help="figures of a run that is over; runs nothing")
    parser.add_argument("--only", default="", help="tests whose names hold this, and no numerics")
    options = parser.parse_args()
    code = 0
    if options.source is None:
        tests = [test for test in files_and_names(nodes()) if options.only in test]
        command = [sys.executable, "-m", "pytest", "-q", "--figures", str(FIGURES), *tests]
        code = subprocess.run(command, cwd=ROOT).returncode
        if not options.only:
            code = subprocess.run([sys.executable, "-m", "benchmarks.numerics"], cwd=ROOT).returncode or code
    page = PAGE.read_text()
    page = replace(page, "cases", table(json.loads((options.source or FIGURES).read_text()), page))
    if DIGITS.exists():
        page = replace(page, "digits", digits())
    for source, name, section in ((FAULTS, "faults", faults), (FUZZ, "fuzz", strangers)):
        if source.exists():  # long runs: what the page says of the last one stays until there is another
            page = replace(page, name, section())
    PAGE.write_text(page)
    return code


if __name__ == "__main__":
    sys.exit(main())
