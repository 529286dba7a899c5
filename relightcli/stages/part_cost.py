"""Costs of a stage predicted from parts of its work, as its dry run does them in a folder that is thrown away."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import relight_formats as formats
from relightcli import __version__
from relightcli.run.accounting import Account, Meter, children_seconds
from relightcli.stages.copying import copy_arrays, make_like

SMALL = 1 << 22  # bytes of arrays that are copied whole


@dataclass
class Costs:
    """seconds of the clock and of all processors, and bytes as stored."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    bytes: float = 0.0

    def add(self, other: Costs, times: float = 1.0) -> None:
        self.seconds += times * other.seconds
        self.cpu_seconds += times * other.cpu_seconds
        self.bytes += times * other.bytes

    @contextmanager
    def timed(self, times: float = 1.0) -> Iterator[None]:
        """Adds what is done inside, as if it were done so many times."""
        meter, before = Meter(), children_seconds()
        yield
        found = meter.read()
        cpu_seconds = found["cpu_seconds"] + children_seconds() - before
        self.add(Costs(found["seconds"], cpu_seconds), times)

    def as_json(self, account: Account) -> dict[str, Any]:
        """With the steps that were done already, as every run does them."""
        whole = Costs(bytes=self.bytes)
        for step in account.steps.values():
            whole.add(Costs(step["seconds"], step["cpu_seconds"]))
        whole.add(Costs(self.seconds, self.cpu_seconds))
        return {"seconds": whole.seconds, "cpu_seconds": whole.cpu_seconds, "bytes": int(whole.bytes)}


@contextmanager
def scratch(kind: str, settings: dict[str, Any], attrs: dict[str, Any]) -> Iterator[formats.Writer]:
    """A store that is never finished."""
    program = f"relightcli {__version__}"
    with tempfile.TemporaryDirectory(prefix="relightcli-") as folder:
        store = Path(folder) / "pilot.zarr"
        with formats.begin(store, kind, settings=settings, inputs={}, program=program) as writer:  # type: ignore[union-attr]
            writer.set_attrs(attrs)
            yield writer


def stored_bytes(writer: formats.Writer, group: str) -> int:
    """Of the chunks of arrays below a group of an unfinished store."""
    folder = writer.partial_path / group
    return sum(f.stat().st_size for f in folder.rglob("c*") if f.is_file() and f.name.split(".")[0] == "c")


def grown(part: Callable[[int], Costs], sizes: tuple[int, int], whole: int) -> Costs:
    """Costs of work on `whole` pieces. part: does it on some, a smaller and a larger number of them that `sizes` has,
    first of all the smaller one twice, as what the first run takes more is taken once; it goes with their number from
    there."""
    small, large = sizes
    first = part(small)
    if large <= small or whole <= small:
        return first
    again, more = part(small), part(large)
    out = Costs()
    out.add(first)
    slope = (whole - small) / (large - small)
    for key in ("seconds", "cpu_seconds", "bytes"):
        grows = max(0.0, getattr(more, key) - getattr(again, key))
        setattr(out, key, getattr(out, key) + slope * grows)
    return out


def copying(store: formats.Store, names: list[str], writer: formats.Writer) -> Costs:
    """Costs of copying those arrays: small ones are copied, of large ones a chunk of the largest."""
    out, sizes = Costs(), store.sizes()
    small = [name for name in names if sizes[name].raw <= SMALL]
    with out.timed():
        copy_arrays(store, writer, small)
    large = sorted(set(names) - set(small), key=lambda name: sizes[name].raw)
    if large:
        source: Any = store.array(large[-1])
        target, rows = make_like(store, writer, large[-1]), slice(0, store.layouts[large[-1]].chunks[0])
        part = sizes[large[-1]].raw * min(1.0, rows.stop / store.layouts[large[-1]].shape[0])
        with out.timed(sum(sizes[name].raw for name in large) / part):
            target[rows] = source[rows]
    out.bytes += sum(sizes[name].stored for name in names)
    return out
