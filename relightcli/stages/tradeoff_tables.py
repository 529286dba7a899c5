"""A sweep's result as tables: CSV with all digits, and columns of text for a terminal."""

from __future__ import annotations

import csv
import io

from relightcli.stages.tradeoff_result import AXES, Result

COLUMNS = (
    "point",
    "error",
    "error_noise",
    "flip",
    "worst_error",
    "worst_view",
    "seconds",
    "seconds_spread",
    "cpu_seconds",
    "picture_seconds",
    "frame_seconds",
    "frame_spread",
    "bytes",
    "peak_bytes",
    "repeats",
    "front",
    "dominated_by",
    "traced_seconds",
    "ahead_from_pictures",
)


def points_csv(result: Result) -> str:
    """One row a point: `COLUMNS`, then the error of each layer (own: of the layer, share: of the picture). Numbers have
    all their digits; what is not known is empty."""
    layers = list(dict.fromkeys(name for p in result.points for name in p.error.share))
    stream = io.StringIO()
    out = csv.writer(stream, lineterminator="\n")
    out.writerow([*COLUMNS, *(f"own_{n}" for n in layers), *(f"share_{n}" for n in layers)])
    for row in result.to_json()["points"]:
        named = {
            **row,
            "point": row["label"],
            "error_noise": row["noise"],
            "worst_error": row["worst"],
            "front": " ".join(row["front"]),
        }
        cells = [named[c] for c in COLUMNS]
        out.writerow([*cells, *(row["own"].get(n) for n in layers), *(row["share"].get(n) for n in layers)])
    return stream.getvalue()


def traced_csv(result: Result) -> str:
    stream = io.StringIO()
    out = csv.writer(stream, lineterminator="\n")
    out.writerow(["spp", "seconds", "error"])
    out.writerows([t.spp, t.seconds, t.error] for t in result.traced)
    return stream.getvalue()


# Columns of the table and how their numbers are written.
HEADER = {
    "#": "d",
    "point": "",
    "error %": ".2f",
    "±": ".2f",
    "FLIP": ".3f",
    "simulate s": ".1f",
    "frame s": ".2f",
    "MB": ".1f",
    "memory MB": ".0f",
    "front": "",
    "dominated by": "",
}


def rows(result: Result) -> list[list[str | int | float]]:
    """The table, in the order of HEADER, not rounded."""
    fronts, by = result.fronts(), result.dominated_by()
    return [
        [
            *(k + 1, p.label, 100 * p.error.error, 100 * p.error.noise, p.error.flip, p.seconds, p.frame_seconds),
            *(p.bytes / 1e6, p.peak_bytes / 1e6),
            " ".join(AXES[a] for a in AXES if k in fronts[a]) or "-",
            "-" if by[k] is None else f"#{(by[k] or 0) + 1}",
        ]
        for k, p in enumerate(result.points)
    ]


def table_text(result: Result) -> str:
    """The table for a terminal; numbers to the right."""
    texts = [[f"{cell:{form}}" for cell, form in zip(row, HEADER.values(), strict=True)] for row in rows(result)]
    cells = [list(HEADER), *texts]
    width = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = []
    for row in cells:
        set_in = zip(row, width, HEADER.values(), strict=True)
        lines.append("  ".join(text.rjust(w) if form else text.ljust(w) for text, w, form in set_in).rstrip())
    return "\n".join(lines)
