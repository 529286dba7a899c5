"""Plots of error against cost, as PNG and SVG. Matplotlib, without a display, and only loaded here."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

_SIZE = (5.6, 4.2)  # inches
_DPI = 130


@dataclass(frozen=True)
class Curve:
    """A second set of marks with a line through them and a name, e.g. another method."""

    name: str
    x: Sequence[float]
    y: Sequence[float]


def scatter(
    title: str,
    x_name: str,
    y_name: str,
    x: Sequence[float],
    y: Sequence[float],
    front: Sequence[int],
    curve: Curve | None = None,
    level: tuple[str, float] | None = None,
) -> dict[str, bytes]:
    """Numbered points (from 1) on logarithmic axes, those of `front` filled and joined by steps.

    x, y: positive, finite; front: indices in ascending x; level: a horizontal line and its name.
    Returns the file's bytes by suffix, "png" and "svg"; the same data give the same bytes.
    """
    import matplotlib

    with matplotlib.rc_context({"svg.hashsalt": "relightcli", "font.size": 10}):
        figure = _figure(title, x_name, y_name)
        axes = figure.axes[0]
        axes.set_xlim(*_limits([*x, *(curve.x if curve else [])]))
        axes.set_ylim(*_limits([*y, *(curve.y if curve else []), *([level[1]] if level else [])]))
        other = [k for k in range(len(x)) if k not in front]
        axes.step(
            [x[k] for k in front], [y[k] for k in front], where="post", color="#1f5fa8", linewidth=1.2, label="front"
        )
        axes.scatter([x[k] for k in front], [y[k] for k in front], s=170, color="#1f5fa8", zorder=3)
        axes.scatter([x[k] for k in other], [y[k] for k in other], s=170, color="white", edgecolor="#888888", zorder=2)
        for k in range(len(x)):
            colour = "white" if k in front else "#555555"
            axes.annotate(str(k + 1), (x[k], y[k]), color=colour, ha="center", va="center", fontsize=8, zorder=4)
        if curve is not None:
            axes.plot(curve.x, curve.y, "x--", color="#b5432a", label=curve.name)
        if level is not None:
            axes.axhline(level[1], color="#3a8a4d", linewidth=1, linestyle=":", label=level[0])
        axes.legend(frameon=False, fontsize=9)
        return _bytes(figure)


def _limits(values: Sequence[float]) -> tuple[float, float]:
    """Room around the values on a logarithmic axis, also where they are all one."""
    return min(values) / 1.4, max(values) * 1.4


def bars(
    title: str,
    y_name: str,
    names: Sequence[str],
    parts: Mapping[str, Sequence[float]],
    spreads: Mapping[str, Sequence[float]] | None = None,
    x_name: str = "",
) -> dict[str, bytes]:
    """A group of bars per name, one bar per part; spreads: how far lines over the bars reach up and down.

    Returns the file's bytes by suffix.
    """
    import matplotlib

    with matplotlib.rc_context({"svg.hashsalt": "relightcli", "font.size": 10}):
        figure = _figure(title, x_name, y_name, logarithmic=False)
        axes = figure.axes[0]
        width = 0.8 / max(1, len(parts))
        for k, (part, values) in enumerate(parts.items()):
            places = [i + (k - (len(parts) - 1) / 2) * width for i in range(len(names))]
            above = None if spreads is None else spreads[part]
            axes.bar(places, values, width, label=part, yerr=above, error_kw={"linewidth": 0.8})
        axes.set_xticks(range(len(names)), names)
        axes.legend(frameon=False, fontsize=9)
        return _bytes(figure)


def curves(title: str, x_name: str, y_name: str, lines: Mapping[str, Sequence[float]]) -> dict[str, bytes]:
    """Lines over 1, 2, 3, ... from 0 up. Returns the file's bytes by suffix."""
    import matplotlib

    with matplotlib.rc_context({"svg.hashsalt": "relightcli", "font.size": 10}):
        figure = _figure(title, x_name, y_name, logarithmic=False)
        axes = figure.axes[0]
        for name, values in lines.items():
            axes.plot(range(1, len(values) + 1), values, linewidth=1.2, label=name)
        axes.set_ylim(bottom=0.0)
        axes.legend(frameon=False, fontsize=9)
        return _bytes(figure)


def _figure(title: str, x_name: str, y_name: str, logarithmic: bool = True) -> Any:
    # The object interface: no state of pyplot, no window system.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE, dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_title(title)
    axes.set_xlabel(x_name)
    axes.set_ylabel(y_name)
    if logarithmic:
        axes.set_xscale("log")
        axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis):
            _plain_numbers(axis)
    axes.grid(True, which="both", color="#dddddd", linewidth=0.5)
    axes.set_axisbelow(True)
    return figure


def _plain_numbers(axis: Any) -> None:
    """Ticks at 1, 2, 5, 10, ... with 0.5 or 20 beside them instead of powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _bytes(figure: Any) -> dict[str, bytes]:
    found = {}
    for suffix, metadata in (("png", {"Software": None}), ("svg", {"Date": None, "Creator": None})):
        stream = io.BytesIO()
        figure.savefig(stream, format=suffix, metadata=metadata)
        found[suffix] = stream.getvalue()
    return found
