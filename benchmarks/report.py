"""What a benchmark found, as text, Markdown and JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

Cell = str | int | float


@dataclass(frozen=True)
class Row:
    """One measured number.

    work: what was done; measured, unit: the number; against: the ceiling or peer with its number, from the same run;
    ratio: how many times better than `against` (or the share of a ceiling that is reached); target: what it must
    reach, as text, and whether it did. None or "" where there is none.
    """

    work: str
    measured: float
    unit: str
    against: str = ""
    ratio: float | None = None
    target: str = ""
    met: bool | None = None


@dataclass(frozen=True)
class Table:
    """Numbers that only speak side by side."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


@dataclass
class Report:
    """All that one benchmark has to say. `skipped` tells why it, or a part of it, could not run."""

    about: str
    rows: list[Row] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def at_most(work: str, measured: float, unit: str, limit: float) -> Row:
    """A row whose number must not exceed `limit`; the ratio is limit / measured."""
    ratio = limit / measured if measured > 0 else math.inf
    return Row(work, measured, unit, ratio=ratio, target=f"<= {limit:g} {unit}", met=measured <= limit)


def faster(work: str, measured: float, unit: str, against: str, ratio: float, target: float) -> Row:
    """A row that must be `target` times better than what it is held against."""
    return Row(work, measured, unit, against, ratio, f">= {target:g}x", ratio >= target)


HEAD = ("work", "measured", "ceiling or peer", "ratio", "target", "met")


def text(name: str, report: dict[str, Any]) -> str:
    """A report (as JSON) as plain text."""
    lines = [f"== {name}: {report['about']}"]
    if report["rows"]:
        lines += _columns([HEAD, *(_cells(row) for row in report["rows"])])
    for table in report["tables"]:
        lines += ["", table["title"]]
        lines += _columns([tuple(table["columns"]), *(tuple(_number(c) for c in row) for row in table["rows"])])
    lines += [f"skipped: {why}" for why in report["skipped"]]
    return "\n".join(lines)


def markdown(document: dict[str, Any]) -> str:
    """Everything that a JSON document of results holds, as Markdown tables."""
    machine = document["machine"]
    lines = [f"{machine['cores']} cores, {machine['cpu']}, Python {machine['python']}", ""]
    for name, run in document["runs"].items():
        report = run["report"]
        size = " (small sizes: `--quick`)" if run["quick"] else ""
        lines += [f"**{name}**{size}: {report['about']}", ""]
        if report["rows"]:
            lines += [*_pipes(HEAD, [_cells(row) for row in report["rows"]]), ""]
        for table in report["tables"]:
            rows = [[_number(c) for c in row] for row in table["rows"]]
            lines += [table["title"], "", *_pipes(table["columns"], rows), ""]
        lines += [f"Skipped: {why}\n" for why in report["skipped"]]
    return "\n".join(lines).rstrip()


BEGIN, END = "<!-- ratios: python -m benchmarks --document -->", "<!-- end of ratios -->"


def ratios(document: dict[str, Any]) -> str:
    """Every row of a JSON document of results that has a ratio or a target, as one Markdown table."""
    machine = document["machine"]
    rows = [
        (name, *_cells(row))
        for name, run in document["runs"].items()
        if not run["quick"]
        for row in run["report"]["rows"]
        if row["ratio"] is not None or row["target"]
    ]
    where = f"{machine['cores']} cores, {machine['cpu']}, Python {machine['python']}"
    return "\n".join([where, "", *_pipes(("benchmark", *HEAD), rows)])


def put_ratios(page: str, document: dict[str, Any]) -> str:
    """A page with the table of ratios between its two marks. Raises ValueError for a page without them."""
    if page.count(BEGIN) != 1 or page.count(END) != 1 or page.index(BEGIN) > page.index(END):
        raise ValueError(f"expected {BEGIN} and, after it, {END} once each")
    return f"{page[: page.index(BEGIN)]}{BEGIN}\n{ratios(document)}\n{page[page.index(END) :]}"


def aligned(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as plain text."""
    return "\n".join(_columns([head, *rows]))


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    ratio = "" if row["ratio"] is None else _number(row["ratio"])
    met = {None: "", True: "yes", False: "NO"}[row["met"]]
    return row["work"], f"{_number(row['measured'])} {row['unit']}", row["against"], ratio, row["target"], met


def _number(value: Cell) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, int):
        return f"{value:,}"
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _columns(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    return [lines[0], "-" * len(lines[0]), *lines[1:]]


def _pipes(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    table = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(cell.replace("|", "/") for cell in row) + " |" for row in table]
