"""Arrays of one store in another, as they are."""

from __future__ import annotations

from typing import Any

import relight_formats as formats


def make_like(store: formats.Store, writer: formats.Writer, name: str) -> Any:
    """An array of that name, empty, as the store has it."""
    layout = store.layouts[name]
    codec: Any = layout.codec
    source: Any = store.array(name)
    attributes = dict(source.attrs)
    units = attributes.pop("units")
    return writer.array(
        name,
        shape=layout.shape,
        dtype=layout.data_type,
        chunks=layout.chunks,
        dims=layout.dims,
        units=None if units == "1" else units,
        attrs=attributes,
        codec=codec,
    )


def copy_arrays(store: formats.Store, writer: formats.Writer, names: list[str]) -> None:
    """Copies arrays as they are, a range of chunks at a time."""
    for name in names:
        source: Any = store.array(name)
        layout, target = store.layouts[name], make_like(store, writer, name)
        if f"copy/{name}" in writer.done:
            continue
        step = max(1, layout.chunks[0]) if layout.shape else 1
        for start in range(0, layout.shape[0] if layout.shape else 1, step):
            rows = slice(start, start + step) if layout.shape else ...
            target[rows] = source[rows]
        writer.record(f"copy/{name}", {})
