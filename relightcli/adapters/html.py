"""One self-contained HTML page: headings, text, pictures in a grid, tables. No scripts, no other files."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

_STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 0 auto; padding: 1rem; }
h1, h2 { line-height: 1.2; }
.pictures { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 20rem), 1fr)); gap: 1rem; }
figure { margin: 0; }
img { width: 100%; height: auto; background: #777; }
figcaption { font-size: 0.9rem; }
.table { overflow-x: auto; }
table { border-collapse: collapse; margin: 1rem 0; }
th, td { padding: 0.25rem 0.75rem; border-bottom: 1px solid #8886; text-align: left; overflow-wrap: anywhere; }
th { overflow-wrap: normal; }
td:not(.number) { min-width: 6rem; }
td.number { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
"""


@dataclass(frozen=True)
class Picture:
    """One picture of a grid. `uri` from `png_data_uri`, or a relative path beside the page."""

    uri: str
    caption: str


@dataclass(frozen=True)
class Table:
    """Rows of text; cells that are numbers are set to the right."""

    header: Sequence[str]
    rows: Sequence[Sequence[str | int | float]]


@dataclass(frozen=True)
class Section:
    """A heading with, in this order, text, pictures and tables. Empty parts are left out."""

    title: str
    text: str = ""
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()


def page(title: str, intro: str, sections: Sequence[Section]) -> str:
    """The page as a string. All texts are escaped; blank lines part paragraphs."""
    body = [f"<h1>{escape(title)}</h1>", _paragraphs(intro)]
    for section in sections:
        body.append(f"<h2>{escape(section.title)}</h2>")
        body.append(_paragraphs(section.text))
        if section.pictures:
            body.append('<div class="pictures">')
            body += [_figure(picture) for picture in section.pictures]
            body.append("</div>")
        body += [_table(table) for table in section.tables]
    head = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
    )
    return head + "\n".join(part for part in body if part) + "\n</body>\n</html>\n"


def data_uri(data: bytes, kind: str) -> str:
    """A file inside the page. kind: its media type, e.g. image/svg+xml."""
    return f"data:{kind};base64," + base64.b64encode(data).decode("ascii")


def png_data_uri(display: NDArray[np.uint8]) -> str:
    """A PNG inside the page. display (H, W, 3) or (H, W, 4) uint8, sRGB."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(display)).save(stream, "PNG")
    return data_uri(stream.getvalue(), "image/png")


def _paragraphs(text: str) -> str:
    return "\n".join(f"<p>{escape(part.strip())}</p>" for part in text.split("\n\n") if part.strip())


def _figure(picture: Picture) -> str:
    caption = escape(picture.caption)
    return f'<figure><img src="{escape(picture.uri)}" alt="{caption}"><figcaption>{caption}</figcaption></figure>'


def _table(table: Table) -> str:
    lines = ['<div class="table"><table>']
    if table.header:
        lines.append("<tr>" + "".join(f"<th>{escape(cell)}</th>" for cell in table.header) + "</tr>")
    lines += ["<tr>" + "".join(map(_cell, row)) + "</tr>" for row in table.rows]
    return "\n".join([*lines, "</table></div>"])


def _cell(value: str | int | float) -> str:
    if isinstance(value, str):
        return f"<td>{escape(value)}</td>"
    text = str(value) if isinstance(value, int) else f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"
    return f'<td class="number">{text}</td>'
