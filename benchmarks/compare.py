"""This run against the last one: ratios, not seconds, and what has lost too much of them.

A row's ratio says how many times better than its ceiling or peer, or than its limit, a number is. Ratios to a peer of
the same run, and ratios of sizes, mean the same on a busy machine as on a quiet one: they are judged. A ratio of a time
to a fixed limit is a time in disguise: it is told beside them.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass
from typing import Any

LOSS = 0.20  # of a ratio, from which on a run fails
TIMES = ("s", "ms", "frames/s", "Hz", "sensors/s", "receivers/s", "Mray/s", "MB/s", "pictures")
_NUMBER = re.compile(r"\d[\d,]*(\.\d+)?(e[+-]?\d+)?", re.IGNORECASE)


@dataclass(frozen=True)
class Change:
    """A ratio of the last run and of this one; None where a run has no such row. judged: whether a loss counts."""

    benchmark: str
    work: str
    last: float | None
    now: float | None
    judged: bool

    @property
    def lost(self) -> bool:
        return self.judged and self.last is not None and self.now is not None and self.now < (1.0 - LOSS) * self.last


def ratios(report: dict[str, Any]) -> dict[str, tuple[str, str, float, bool]]:
    """Of every row with a ratio: its key, then its words, its peer, its ratio, and whether it can be judged.

    The key is the words with their numbers masked, as many of these are measured, and which one of the rows with these
    words it is. report: as JSON. A ratio that is not finite (of nothing to something) is left out.
    """
    seen: Counter[str] = Counter()
    out = {}
    for row in report["rows"]:
        masked = _NUMBER.sub("#", row["work"])
        seen[masked] += 1
        if row["ratio"] is not None and math.isfinite(row["ratio"]):
            timed = row["unit"] in TIMES and not row["against"]
            out[f"{masked} {seen[masked]}"] = (row["work"], _NUMBER.sub("#", row["against"]), row["ratio"], not timed)
    return out


def compare(name: str, now: dict[str, Any], last: dict[str, Any], same_machine: bool) -> list[Change]:
    """Every ratio of the benchmark `name` in this run's report and in the last one's, both as JSON.

    What is held against another peer than last time, or was measured on another scene or machine, is told and not
    judged.
    """
    new, old = ratios(now), ratios(last)
    fits = same_machine and _NUMBER.sub("#", now["about"]) == _NUMBER.sub("#", last["about"])
    out = []
    for key in [*new, *(key for key in old if key not in new)]:
        work, peer, ratio, fit = new.get(key, ("", "", None, False))
        before = old.get(key)
        if before is None:
            out.append(Change(name, work, None, ratio, False))
        else:
            judged = fits and fit and before[3] and peer == before[1]
            out.append(Change(name, work or before[0], before[2], ratio, judged))
    return out


def of_one_machine(a: dict[str, Any], b: dict[str, Any]) -> bool:
    """Whether two results come from machines with the same processor and as many cores."""
    return all(a.get(key) == b.get(key) for key in ("cpu", "cores"))


HEAD = ("benchmark", "work", "ratio, last", "now", "change", "")


def cells(change: Change) -> tuple[str, ...]:
    """A change as a row of a table."""
    both = change.last is not None and change.now is not None and change.last != 0
    share = f"{100 * (change.now / change.last - 1):+.0f} %" if both else ""  # type: ignore[operator]
    said = "LOST" if change.lost else "" if change.judged else "told only"
    if change.now is None:
        said = "not measured now"
    elif change.last is None:
        said = "new"
    return change.benchmark, change.work, _told(change.last), _told(change.now), share, said


def _told(ratio: float | None) -> str:
    return "" if ratio is None else f"{ratio:,.3g}" if abs(ratio) < 1000 else f"{ratio:,.0f}"
